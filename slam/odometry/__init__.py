"""Filters between the wheels and a backend (paper C), and what lasts of the wheels' errors.

``filters`` is what the environment puts in; ``differential_transform``, ``riccati`` and ``transform_filter`` are
the mathematics behind it. ``lasting`` learns for ``graph-slam`` what the wheels are off by, and where the frame of the
poses sits.
"""
