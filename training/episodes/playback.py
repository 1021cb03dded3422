"""An episode's recording played back, for the files it is exported to: maps, dead reckoning, ellipses."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from slam.grids.occupancy import UNKNOWN
from slam.motion import move
from slam.types import Array
from training.episodes.recording import Recording

__all__ = ["dead_reckoned", "ellipses", "map_origin", "maps"]

Classes = NDArray[np.int8]

_MAP_EVERY_S = 1.0


def maps(recording: Recording) -> Iterator[tuple[int, Classes]]:
    """Return the map each time it had changed: the step, and the classes ``(rows, cols)``.

    Every map covers :meth:`Recording.bounds`, row 0 at the lowest y. Two of them are at least a second
    apart, except that the last one is always given.
    """
    row0, col0, row1, col1 = recording.bounds()
    classes = np.full((row1 - row0, col1 - col0), UNKNOWN, np.int8)
    changes = recording.map_changes
    due_s = -np.inf
    for k, (step, cells) in enumerate(changes.items()):
        classes[cells[:, 0] - row0, cells[:, 1] - col0] = cells[:, 2]
        time_s = float(recording.times[step])
        # Half a step's grace: times are sums of steps that binary numbers do not hold exactly.
        if time_s > due_s - 0.5 * recording.step_s or k + 1 == len(changes.values):
            due_s = time_s + _MAP_EVERY_S
            yield step, classes.copy()


def map_origin(recording: Recording) -> tuple[float, float]:
    """Return x and y [m] of the lower left corner of the maps that :func:`maps` gives."""
    row0, col0, _, _ = recording.bounds()
    return col0 * recording.resolution, row0 * recording.resolution


def dead_reckoned(recording: Recording) -> Array:
    """Return the poses ``(n, 3)`` that the odometry alone leads to, from the origin of its own frame."""
    poses = np.zeros((len(recording.times), 3))
    for k in range(1, len(poses)):
        poses[k] = move(poses[k - 1], recording.twists[k], recording.step_s)
    return poses


def ellipses(landmarks: NDArray[np.float32], sigmas: float = 3.0) -> tuple[Array, Array]:
    """Return the covariance ellipses of landmarks ``(m, 5)``: half axes ``(m, 2)`` [m], the longer first.

    And the direction of the longer one ``(m,)`` [rad].
    """
    rows = landmarks.astype(np.float64)
    cov = rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    variances, axes = np.linalg.eigh(cov)  # ascending
    half_axes = sigmas * np.sqrt(np.maximum(variances[:, ::-1], 0.0))
    return half_axes, np.arctan2(axes[:, 1, 1], axes[:, 0, 1])
