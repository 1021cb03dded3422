"""From a smooth field to smooth walls: its zero line as straight pieces too short to show a corner.

The lidar and the physics know straight surfaces and circles. A curved wall is therefore a chain of pieces, cut
where its direction has turned by a few degrees: many in a tight bend, few along a gentle one.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from mecanum_env.rooms.outlines.outline import trace
from slam.types import Array, Flags, Indices

__all__ = ["MOST_TURN_DEG", "bends_deg", "facets", "level_loops", "rasterise", "signed_area"]

MOST_TURN_DEG = 4.8
"""Largest bend [°] from one piece to the next: a plan's list of corners begins at 5°."""

_PIECE_TURN_DEG = 4.5  # turned along a piece; the bend to the next is about the same, and rarely larger
_SAGITTA_M = 0.005  # a piece is about this far from its arc at most, well within the lidar's noise
_STEP_M = 0.01  # points along the line before it is cut into pieces


def level_loops(field: Array, cell_m: float, *, smooth_m: float) -> list[Array]:
    """Return the closed lines ``(k, 2)`` [m] on which a field ``(rows, cols)`` is zero, 1 cm from point to point.

    The field is given at the centres of cells whose lattice begins at the origin; it must be negative along the
    border. Where it is positive is on a line's left. Each line is smoothed by a Gaussian of standard deviation
    ``smooth_m`` [m] along its length.
    """
    corners, first = trace(field > 0)
    loops = []
    for begin, end in itertools.pairwise(first.tolist()):
        points = _crossings(field, corners[begin:end]) * cell_m
        loops.append(_smooth(_resample(points), smooth_m))
    return loops


def _crossings(field: Array, corners: Array) -> Array:
    """Points ``(n, 2)`` [cells] where a field changes its sign, one for each cell's edge along a loop of edges."""
    along = np.roll(corners, -1, axis=0) - corners
    count = np.abs(along).sum(axis=1).astype(np.int64)
    ahead = np.repeat(along / count[:, None], count, axis=0)
    number = np.arange(len(ahead)) - np.repeat(np.cumsum(count) - count, count)
    middle = np.repeat(corners, count, axis=0) + (number + 0.5)[:, None] * ahead
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
    inside, outside = middle + 0.5 * left, middle - 0.5 * left
    high, low = (field[p[:, 1].astype(np.int64), p[:, 0].astype(np.int64)] for p in (inside, outside))
    share = high / (high - low)
    return np.asarray(inside - share[:, None] * left)


def _resample(points: Array) -> Array:
    """Return points at equal distances along a closed line."""
    closed = np.vstack([points, points[:1]])
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    places = np.linspace(0.0, at[-1], max(16, math.ceil(at[-1] / _STEP_M)), endpoint=False)
    return np.stack([np.interp(places, at, closed[:, k]) for k in (0, 1)], axis=1)


def _smooth(points: Array, sigma_m: float) -> Array:
    """Return a closed line of equidistant points, smoothed by a Gaussian along its length."""
    length = float(np.hypot(*(np.roll(points, -1, axis=0) - points).T).sum())
    spectrum = np.fft.rfft(points, axis=0)
    frequency = np.arange(len(spectrum)) / length
    spectrum *= np.exp(-2.0 * (math.pi * sigma_m * frequency) ** 2)[:, None]
    return np.asarray(np.fft.irfft(spectrum, len(points), axis=0))


def facets(points: Array) -> Array:
    """Return vertices ``(m, 2)`` along a closed smooth line ``(k, 2)`` [m] whose pieces bend by less than 5°.

    Where the line itself turns faster than that within 1 cm, so do they.
    """
    keep = _cut(points)
    while True:
        vertices = points[keep]
        sharp = np.flatnonzero(bends_deg(vertices) > MOST_TURN_DEG)
        # Split the longer of the two pieces that meet there.
        gaps = np.append(np.diff(keep), keep[0] + len(points) - keep[-1])
        longer = np.where(gaps[sharp] >= gaps[sharp - 1], sharp, sharp - 1)
        halves = (keep[longer] + gaps[longer] // 2) % len(points)
        refined = np.union1d(keep, halves)
        if len(refined) == len(keep):
            return vertices
        keep = refined


def bends_deg(vertices: Array) -> Array:
    """Return by how much a closed line ``(m, 2)`` bends at each vertex ``(m,)`` [°], either way."""
    ahead = np.roll(vertices, -1, axis=0) - vertices
    heading = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.asarray(np.abs((heading - np.roll(heading, 1) + 180.0) % 360.0 - 180.0))


def _cut(points: Array) -> Indices:
    """Return where to cut a closed line so that no piece turns much, nor lies far from its chord."""
    ahead = np.roll(points, -1, axis=0) - points
    headings = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])).tolist()
    step = float(np.hypot(*ahead.T).mean())
    most = math.radians(_PIECE_TURN_DEG)
    keep, low, high = [0], headings[0], headings[0]
    for i, heading in enumerate(headings):
        low, high = min(low, heading), max(high, heading)
        # An arc of this length and turn rises by length · turn / 8 above its chord.
        if high - low > most or (high - low) * (i + 1 - keep[-1]) * step > 8.0 * _SAGITTA_M:
            # One back: a piece and the next bend by the turn from its first step to the first of the next.
            cut = max(i - 1, keep[-1] + 1)
            keep.append(cut)
            low, high = min(headings[cut], heading), max(headings[cut], heading)
    return np.unique(np.array(keep, np.int64))


def signed_area(line: Array) -> float:
    """Return the area within a closed line of points ``(k, 2)``, negative where it runs clockwise."""
    x, y = line.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def rasterise(walls: Array, size: tuple[int, int], cell_m: float) -> Flags:
    """Return which cells' centres ``(rows, cols)`` closed walls ``(n, 4)`` [m] have within them.

    Parameters
    ----------
    walls
        Segments that form closed loops; what is within an odd number of loops is inside.
    size
        Columns and rows of the raster, whose lower-left corner is the origin.
    cell_m
        Side of a cell [m].
    """
    cols, rows = size
    x0, y0, x1, y1 = (walls / cell_m - 0.5).T
    # The rows whose centres a segment crosses: half-open, so that a vertex counts once.
    first, last = np.ceil(np.minimum(y0, y1)).astype(np.int64), np.ceil(np.maximum(y0, y1)).astype(np.int64)
    count = last - first
    which = np.repeat(np.arange(len(walls)), count)
    row = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + first[which]
    share = (row - y0[which]) / (y1[which] - y0[which])
    col = np.ceil(x0[which] + share * (x1[which] - x0[which])).astype(np.int64)
    crossed = np.zeros((rows, cols + 1), np.int64)
    np.add.at(crossed, (row, np.clip(col, 0, cols)), 1)
    return np.asarray(np.cumsum(crossed, axis=1)[:, :cols] % 2 == 1, np.bool_)
