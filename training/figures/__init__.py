"""Figures, and how they look.

``statistics`` are means with intervals, ``consistency`` is NEES over runs, ``tables`` are for terminals and pages,
``charts`` and ``page_style`` the style of both, ``page`` the frame of a page and the policy that it is held to.
"""
