"""A soak: environments that live for hours, reset over mixed rooms, and what memory and handles do.

``part`` is the campaign's part, all of it.
"""
