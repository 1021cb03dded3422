"""``mecanum play``: a person drives.

``session`` is what is played, ``team_session`` with other robots, ``controls`` what keys mean, ``picture`` what is
shown, ``game`` the window and the pace.
"""
