"""The planning layer of the end-to-end policy: distances over a learned price of each step, and the way down them.

A value iteration network (Tamar et al., 2016) in its shortest-path form: what convolutions make of the maps is
the price of every step between neighbouring pixels and of ending at any of them, and the distances follow from

    D(p) = min(goal(p), min over the eight neighbours q of D(q) + price(p, q)).

The minimum has a gradient, that of the steps it is made of (``gradient``): prices are learned from distances.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.planning import D_COL, D_ROW
from slam.types import Floats, Indices

__all__ = ["EDGES", "descend", "distances", "gradient", "node_prices"]

EDGES = ((0, 1), (1, 1), (1, 0), (1, -1))
"""Row and column offsets of the four steps that each pixel owns; the other four are its neighbours'."""

_ROOT2 = math.sqrt(2.0)
_NOWHERE = 1e30


@njit(cache=True, nogil=True, error_model="numpy")
def distances(prices: Floats, goal: Floats) -> tuple[Floats, NDArray[np.int8]]:
    """Return the distances ``(n, m)`` and each pixel's direction to the next one, −1 where it is an end itself.

    ``prices`` is ``(4, n, m)``, in the order of :data:`EDGES`, all above 0; ``goal`` ``(n, m)``. Sweeps down and
    up the rows in turn, until two of them change nothing.
    """
    rows, cols = goal.shape
    # A rim that nothing comes from, in place of asking at each pixel whether it has all its neighbours.
    best = np.full((rows + 2, cols + 2), np.float32(_NOWHERE))
    best[1:-1, 1:-1] = goal
    price = np.full((4, rows + 2, cols + 2), np.float32(_NOWHERE))
    price[:, 1:-1, 1:-1] = prices
    quiet, down = 0, True
    while quiet < 2:
        changed = False
        for a in range(1, rows + 1):
            if down:
                here, near = best[a], best[a - 1]
                left, middle, right = price[1, a - 1, :-2], price[2, a - 1, 1:-1], price[3, a - 1, 2:]
            else:
                here, near = best[rows + 1 - a], best[rows + 2 - a]
                at = rows + 1 - a
                left, middle, right = price[3, at, 1:-1], price[2, at, 1:-1], price[1, at, 1:-1]
            changed |= _relax_row(here, near, left, middle, right, price[0, a if down else rows + 1 - a])
        quiet = 0 if changed else quiet + 1
        down = not down
    return best[1:-1, 1:-1].copy(), _directions(best, price, goal)


@njit(cache=True, nogil=True, error_model="numpy")
def _relax_row(here: Floats, near: Floats, left: Floats, middle: Floats, right: Floats, along: Floats) -> bool:
    """Lower a row's distances by those of the row before it, then along itself; return whether any fell."""
    n = here.shape[0] - 2
    fell = False
    for c in range(n):  # vectorises
        lowest = min(min(near[c] + left[c], near[c + 1] + middle[c]), near[c + 2] + right[c])
        fell |= lowest < here[c + 1]
        here[c + 1] = min(here[c + 1], lowest)
    for c in range(2, n + 1):
        new = here[c - 1] + along[c - 1]
        if new < here[c]:
            here[c], fell = new, True
    for c in range(n - 1, 0, -1):
        new = here[c + 1] + along[c]
        if new < here[c]:
            here[c], fell = new, True
    return fell


@njit(cache=True, nogil=True, error_model="numpy")
def _directions(best: Floats, price: Floats, goal: Floats) -> NDArray[np.int8]:
    rows, cols = goal.shape
    parent = np.full((rows, cols), -1, np.int8)
    for r in range(1, rows + 1):
        for c in range(1, cols + 1):
            value = best[r, c]
            if value == goal[r - 1, c - 1]:
                continue
            for k in range(8):
                i, j = r + D_ROW[k], c + D_COL[k]
                # The very sum that the distance was.
                if best[i, j] + (price[k, r, c] if k < 4 else price[k - 4, i, j]) == value:
                    parent[r - 1, c - 1] = k
                    break
    return parent


@njit(cache=True, nogil=True)
def gradient(best: Floats, parent: NDArray[np.int8], upstream: Floats) -> tuple[Floats, Floats]:
    """Return the gradients by prices ``(4, n, m)`` and by goals ``(n, m)`` of Σ upstream · distance."""
    rows, cols = best.shape
    by_price, by_goal = np.zeros((4, rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    flow = upstream.copy()
    for flat in np.argsort(-best.ravel()):
        r, c = flat // cols, flat % cols
        amount, k = flow[r, c], parent[r, c]
        if amount == 0.0:
            continue
        if k < 0:
            by_goal[r, c] += amount
            continue
        i, j = r + D_ROW[k], c + D_COL[k]
        if k < 4:
            by_price[k, r, c] += amount
        else:
            by_price[k - 4, i, j] += amount
        flow[i, j] += amount
    return by_price, by_goal


@njit(cache=True, nogil=True)
def node_prices(price: Floats, length: float) -> Floats:
    """Return the steps' prices ``(4, n, m)`` where each pixel ``(n, m)``, ``length`` wide, has one a length."""
    rows, cols = price.shape
    out = np.full((4, rows, cols), np.float32(1e6))
    for k in range(4):
        size = np.float32(0.5 * length * (_ROOT2 if k % 2 else 1.0))
        for r in range(rows):
            for c in range(cols):
                i, j = r + D_ROW[k], c + D_COL[k]
                if 0 <= i < rows and 0 <= j < cols:
                    out[k, r, c] = size * (price[r, c] + price[i, j])
    return out


@njit(cache=True, nogil=True)
def descend(parent: NDArray[np.int8], row: int, col: int) -> Indices:
    """Return the pixels ``(n, 2)`` from one to the end that its distance is to."""
    rows, cols = parent.shape
    way = np.empty((rows * cols, 2), np.int64)
    way[0] = row, col
    n = 1
    while parent[row, col] >= 0 and n < rows * cols:
        k = parent[row, col]
        row, col = row + D_ROW[k], col + D_COL[k]
        way[n] = row, col
        n += 1
    return way[:n].copy()
