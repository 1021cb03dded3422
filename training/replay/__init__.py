"""``mecanum replay``: a backend on the recorded log of a real robot.

``run`` steps through the log, ``scans`` measures, ``report`` and ``picture`` are what it leaves behind.
"""
