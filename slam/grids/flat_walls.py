"""Walls that a scan sees flat: far off, its beams end on them a decimetre or a metre apart.

Such ends say where a wall is, and nothing of where along it. One by one they are a row of dots that travels with
the robot, and the next scan, whose dots stand alike, fits best where the robot has not moved at all. So what lies
between the ends on a wall is filled in, and ends too far apart for that are not matched.
"""

from __future__ import annotations

import numpy as np

from slam.grids.scan_matching import MatchConfig
from slam.types import Array, Flags

__all__ = ["along_walls"]

_GAP_M = 0.6  # between two ends, that is filled in at most: less than a door
_OFF_M = 0.05  # on a wall an end is off the line of its neighbours at most …
_TURN = 0.94  # … and by this cosine the line turns there
_FEWEST = 3  # gaps in a row along one line: a wall
_BEYOND = 0.5  # of its last gap a wall goes on where no end shows it, in the mean


def along_walls(points: Array, config: MatchConfig) -> tuple[Array, Array]:
    """Return of a scan's ends ``(n, 2)`` [m], in the order of beams, what to match and what to draw ``(m, 2)``.

    What is drawn has an end in every cell along walls. Ends within ``smooth_m`` of each other are matched on
    whatever they are.
    """
    if len(points) <= _FEWEST:
        return points, points
    way = np.diff(points, axis=0)
    gap = np.hypot(way[:, 0], way[:, 1])
    way /= np.maximum(gap, 1e-9)[:, None]
    wall = _on_walls(points, way)
    filled, near = wall & (gap <= _GAP_M), gap <= config.smooth_m
    joined, alone = filled | near, wall & (gap > _GAP_M)
    matched = points[_either_end(joined) | ~_either_end(alone)]
    drawn = [matched]
    last, first = ~np.append(joined[1:], False), ~np.insert(joined[:-1], 0, False)
    for k in np.flatnonzero(filled):
        before = _BEYOND * gap[k] if first[k] else 0.0
        beyond = _BEYOND * gap[k] if last[k] else 0.0
        drawn.append(points[k] + np.arange(-before, gap[k] + beyond, config.cell_m)[:, None] * way[k])
    return matched, np.vstack(drawn)


def _on_walls(points: Array, way: Array) -> Flags:
    """Tell which gaps ``(n - 1,)`` are one of several in a row along one line; ``way`` are their directions."""
    chord, step = points[2:] - points[:-2], points[1:-1] - points[:-2]
    area = np.abs(chord[:, 0] * step[:, 1] - chord[:, 1] * step[:, 0])
    off = area / np.maximum(np.hypot(chord[:, 0], chord[:, 1]), 1e-9)
    bends = (off > _OFF_M) | (np.sum(way[1:] * way[:-1], axis=1) < _TURN)
    row = np.cumsum(np.insert(bends, 0, False))
    flags: Flags = np.bincount(row)[row] >= _FEWEST
    return flags


def _either_end(gaps: Flags) -> Flags:
    """Tell which ends ``(n,)`` are one of those of such a gap."""
    return np.append(gaps, False) | np.insert(gaps, 0, False)
