"""Particles: what FastSLAM and DP-SLAM stand on.

``filter``, ``gate``, ``resampling`` and ``maps`` carry FastSLAM's particles; ``ancestry``, ``shared_grid``,
``grids``, ``match`` and ``paths`` those of DP-SLAM. ``inherited`` and ``map_error`` are the covariances of what
either have from ancestors.
"""
