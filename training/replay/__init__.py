"""``mecanum replay``: a backend on the recorded log of a real robot.

``run`` steps through the log, ``scans`` measures, ``matched`` how exact the reference is, ``report`` and
``picture`` are what it leaves behind.
"""
