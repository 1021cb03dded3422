"""Estimators: what the robot believes, from odometry, scans and landmark observations.

Nothing here knows of a simulator: the same backends run on the logs of real robots. ::

    backend = slam.make("ekf")
    backend.reset(pose=(0, 0, 0))
    backend.predict(Odometry(twist=(0.4, 0.0, 0.1), dt=0.1))
    backend.update(Scan(ranges, angle_min=-np.pi, angle_increment=np.pi / 180, range_max=8.0))
    backend.belief.pose
"""

from slam.backend import Backend, BackendConfig
from slam.belief import Belief
from slam.registry import config_type, make, names, register
from slam.types import CONCAVE, CONVEX, LINE, Observations, Odometry, Scan

__all__ = [
    "CONCAVE",
    "CONVEX",
    "LINE",
    "Backend",
    "BackendConfig",
    "Belief",
    "Observations",
    "Odometry",
    "Scan",
    "config_type",
    "make",
    "names",
    "register",
]
