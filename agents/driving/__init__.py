"""Driving along a way: from a path to the next twist.

``control`` follows with ``follow``'s kernels, ``safety`` has the last word on a twist, ``grip`` learns how gently
to drive.
"""
