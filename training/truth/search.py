"""Sequences of stops that have seen enough of a true map soonest, by simulated annealing.

A way is valued by its cost until enough is seen, and what is seen on the way counts. One value takes some
microseconds, so that many thousand sequences are tried; :mod:`training.truth.rehearsal` then goes on with the time
that the driver takes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.planning import D_COL, D_ROW
from slam.types import Array, Cells
from training.truth.sights import Board, look

__all__ = ["MOST_STOPS", "annealed", "moved"]

MOST_STOPS = 60

_LACKING_M = 600.0  # what all of the map unseen counts as, so that half-way sequences are worth something
_HOT_M, _COLD_M = 1.0, 0.03  # [m] longer that a way may well be to be taken, at first and in the end


def annealed(board: Board, *, share: float, tries: int, rng: np.random.Generator) -> Cells:
    """Return the stops ``(n,)``, the robot's first, whose way is the cheapest found until a share is seen."""
    order, n = np.zeros(MOST_STOPS, dtype=np.int64), 1
    order, n = _anneal(board, order, n, math.ceil(share * board.counted), tries, rng)
    return np.asarray(order[:n])


@njit(cache=True, nogil=True)
def moved(board: Board, order: Cells, n: int, rng: np.random.Generator, new: Cells) -> tuple[int, int]:
    """Write a change of n stops to ``new``; return how many there are now, and the first that is another."""
    new[:] = order
    if len(board.stops) < 2:  # there is nowhere to go
        return n, n
    kind = rng.random()
    if n < 2 or (kind < 0.2 and n < len(order)):  # one more: near another, or anywhere
        k = 1 + int(rng.random() * n)
        stop = order[min(k, n - 1)]
        for _ in range(2):
            stop = board.near[stop, int(rng.random() * board.near.shape[1])]
        if rng.random() < 0.4:
            stop = int(rng.random() * len(board.stops))
        new[k + 1 : n + 1] = order[k:n]
        new[k] = stop
        return n + 1, k
    i, j = 1 + int(rng.random() * (n - 1)), 1 + int(rng.random() * (n - 1))
    if kind < 0.6 or n < 3:  # another one nearby
        new[i] = board.near[order[i], int(rng.random() * board.near.shape[1])]
        return n, i
    if kind < 0.8:  # one or a few less
        less = min(1 if rng.random() < 0.7 else 1 + int(rng.random() * 3), n - i)
        if n - less > 1:
            new[i : n - less] = order[i + less : n]
            return n - less, min(i, n - less - 1)
    low, high = min(i, j), max(i, j)
    if kind < 0.9:  # a piece the other way round
        new[low : high + 1] = order[low : high + 1][::-1]
    elif i < j:  # one later …
        new[i:j] = order[i + 1 : j + 1]
        new[j] = order[i]
    else:  # … or sooner
        new[j + 1 : i + 1] = order[j:i]
        new[j] = order[i]
    return n, low


@njit(cache=True, nogil=True)
def _anneal(
    board: Board, order: Cells, n: int, enough: int, tries: int, rng: np.random.Generator
) -> tuple[Cells, int]:
    # Row k of what is seen, and entry k of ways and counts, are had at stop k: of the sequence that is held, and
    # of the one that is tried.
    words = board.views.shape[1]
    seen, ways = np.zeros((len(order), words), dtype=np.uint64), np.zeros(len(order))
    counts = np.zeros(len(order), dtype=np.int64)
    counts[0] = look(board.views, board.view_of[board.stops[order[0]]], seen[0])
    new, new_seen, new_ways, new_counts = order.copy(), seen.copy(), ways.copy(), counts.copy()
    value, n = _go(board, order, n, 1, enough, seen, ways, counts)
    best, best_n, lowest = order.copy(), n, value
    for t in range(tries):
        heat = _HOT_M * (_COLD_M / _HOT_M) ** (t / tries)
        m, first = moved(board, order, n, rng, new)
        new_seen[first - 1], new_ways[first - 1] = seen[first - 1], ways[first - 1]
        new_counts[first - 1] = counts[first - 1]
        found, m = _go(board, new, m, first, enough, new_seen, new_ways, new_counts)
        if found <= value or rng.random() < math.exp((value - found) / heat):
            for k in range(first, m):
                seen[k], ways[k], counts[k] = new_seen[k], new_ways[k], new_counts[k]
            order[:], n, value = new, m, found
            if value < lowest:
                best[:], best_n, lowest = order, n, value
    return best, best_n


@njit(cache=True, nogil=True)
def _go(
    board: Board,
    order: Cells,
    n: int,
    first: int,
    enough: int,
    seen: NDArray[np.uint64],
    ways: Array,
    counts: Cells,
) -> tuple[float, int]:
    """Go from stop to stop, up to where enough is seen; return what it costs and how many of them it takes."""
    for k in range(first, n):
        seen[k], ways[k], counts[k] = seen[k - 1], ways[k - 1], counts[k - 1]
        # Backwards along the tree of the stop's ways is the way to it.
        cell, end, last = board.stops[order[k - 1]], board.stops[order[k]], -1
        while cell != end and counts[k] < enough:
            step = board.steps[order[k], cell]
            before = cell
            cell -= D_ROW[step] * board.cols + D_COL[step]
            length = 1.0 if step % 2 == 0 else math.sqrt(2.0)
            ways[k] += 0.5 * length * (board.price[before] + board.price[cell])
            view = board.view_of[cell]
            if view != last:
                counts[k] += look(board.views, view, seen[k])
                last = view
        if counts[k] >= enough:
            return ways[k], k + 1
    if counts[n - 1] >= enough:
        return ways[n - 1], n
    return ways[n - 1] + 1.0 + _LACKING_M * (enough - counts[n - 1]) / board.counted, n
