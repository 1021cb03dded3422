"""Occupancy grids, and scans held against them.

``occupancy`` is the grid of every belief, ``free_space`` and ``scan_drawing`` draw a scan into it, ``key_scans``
redraw what a correction moved; ``scan_matching`` and its ``match_kernels`` say where a scan fits,
``flat_walls`` which of its ends say how far along a wall, ``scan_odometry`` makes
odometry of it; ``picture`` is what a notebook shows.
"""
