"""Driving along a way: from a path to the next twist.

``control`` follows with ``follow``'s kernels, ``safety`` has the last word on a twist, ``sides`` are what it keeps
to beside other robots, ``grip`` learns how gently to drive.
"""
