"""Exact surfaces, and the raster, of a union of axis-aligned rectangles of free space."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.types import Array, Flags, Indices

__all__ = ["raster", "surfaces"]


def raster(rectangles: ArrayLike, size: tuple[int, int]) -> Flags:
    """Return which cells of a raster of ``size`` columns and rows lie in a rectangle ``(n, 4)`` [cells]."""
    free = np.zeros(size[::-1], np.bool_)
    for x0, y0, x1, y1 in np.asarray(rectangles):
        free[y0:y1, x0:x1] = True
    return free


def surfaces(rectangles: ArrayLike) -> Array:
    """Return the boundary ``(w, 4)`` of a union of rectangles, free space on the left of every segment.

    The plane is cut along every side of every rectangle; the cells so made are free or solid, and the walls are
    the longest straight runs of edges between the two. Coordinates come out as they went in, bit for bit.

    Parameters
    ----------
    rectangles
        Free rectangles ``(n, 4)``: x_min, y_min, x_max, y_max; they may touch and overlap.
    """
    rectangles = np.asarray(rectangles, np.float64).reshape(-1, 4)
    xs, ys = np.unique(rectangles[:, [0, 2]]), np.unique(rectangles[:, [1, 3]])
    # One solid cell all round, so that every free cell has a neighbour on every side.
    free = np.zeros((len(xs) + 1, len(ys) + 1), np.int8)
    x_index = np.searchsorted(xs, rectangles[:, [0, 2]])
    y_index = np.searchsorted(ys, rectangles[:, [1, 3]])
    for (i0, i1), (j0, j1) in zip(x_index, y_index, strict=True):
        free[i0 + 1 : i1 + 1, j0 + 1 : j1 + 1] = 1
    line, low, high, sign = _runs(np.diff(free, axis=0)[:, 1:-1])
    # Free to the right of a vertical line (sign +1): walk it downwards, and free space is on the left.
    down = sign > 0
    upright = np.stack([xs[line], ys[np.where(down, high, low)], xs[line], ys[np.where(down, low, high)]], axis=1)
    line, low, high, sign = _runs(np.diff(free, axis=1)[1:-1].T)
    # Free above a horizontal line (sign +1): walk it to the right.
    right = sign > 0
    level = np.stack([xs[np.where(right, low, high)], ys[line], xs[np.where(right, high, low)], ys[line]], axis=1)
    return np.ascontiguousarray(np.vstack([upright, level]))


def _runs(
    steps: NDArray[np.int8],
) -> tuple[Indices, Indices, Indices, NDArray[np.int8]]:
    """Return line, first and last lattice index, and sign of each run of equal non-zero steps along rows."""
    padded = np.zeros((steps.shape[0], steps.shape[1] + 2), np.int8)
    padded[:, 1:-1] = steps
    change = padded[:, 1:] != padded[:, :-1]
    starts = np.argwhere(change & (padded[:, 1:] != 0))
    ends = np.argwhere(change & (padded[:, :-1] != 0))
    line, low, high = starts[:, 0], starts[:, 1], ends[:, 1]
    return line, low, high, steps[line, low]
