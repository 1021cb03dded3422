"""Filters between the wheels and a backend (paper C), and where the wheels' centre is.

``filters`` is what the environment puts in; ``differential_transform``, ``riccati`` and ``transform_filter`` are
the mathematics behind it. ``mount`` learns where the frame of the poses sits on the base.
"""
