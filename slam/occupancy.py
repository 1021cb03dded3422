"""The occupancy grid that every backend draws from its estimated poses.

Cells are log-odds in an ``int8`` (one unit is 0.05 nat). The grid lies on a lattice through the origin of the
belief's frame and grows as scans need it: neither its size nor its origin tells anything about the true plan.
"""

from __future__ import annotations

__all__ = ["FREE", "OCCUPIED", "UNKNOWN", "OccupancyGrid"]

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""Cell classes, with the values of a ROS ``nav_msgs/OccupancyGrid``."""
