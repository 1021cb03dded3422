"""Filters between the wheels and a backend (paper C).

``filters`` is what the environment puts in; ``differential_transform``, ``riccati`` and ``transform_filter`` are
the mathematics behind it.
"""
