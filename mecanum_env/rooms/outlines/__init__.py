"""From cells and rectangles to surfaces: the outlines of free space.

``outline`` and ``smooth_outline`` trace rasters, ``rectilinear`` unions of rectangles; ``corners`` finds where
free space bends, ``distance`` how far a cell is from the nearest wall.
"""
