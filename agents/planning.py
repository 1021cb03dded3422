"""Travel costs from the robot to everywhere at once, and the smooth path to one place.

The costs come from Dijkstra's algorithm over the 8-connected planning grid with Dial's bucket queue: no edge is
cheaper than one bucket is wide, so the nodes of the lowest bucket are final in any order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.cost_map import CostMap

__all__ = ["TravelCosts", "resample", "shortest_path", "travel_costs"]

Array = NDArray[np.float64]

# Neighbours, even ones straight and odd ones diagonal; the opposite of k is (k + 4) % 8.
_D_ROW = np.array([0, 1, 1, 1, 0, -1, -1, -1])
_D_COL = np.array([1, 1, 0, -1, -1, -1, 0, 1])


@dataclass(frozen=True, eq=False)
class TravelCosts:
    """Cost of the cheapest way from the robot to each cell, and the step that way ends with."""

    cost: NDArray[np.float32]  # (rows, cols) weighted metres, inf where it cannot get
    step: NDArray[np.int8]  # (rows, cols) direction 0–7 of the last step, −1 at the start and where inf


def travel_costs(cost_map: CostMap, max_cost_m: float = math.inf) -> TravelCosts:
    """Return the travel costs from the robot's cell; what costs more than ``max_cost_m`` is left at infinity.

    A step costs its length times the mean weight of its two cells. A diagonal step needs both cells beside it
    free, so that no path slips between two walls that touch at a corner.
    """
    shape = cost_map.weight.shape
    cost = np.full(shape, np.inf, dtype=np.float32)
    step = np.full(shape, -1, dtype=np.int8)
    highest = float(cost_map.weight.max())
    buckets = math.ceil(math.sqrt(2.0) * highest) + 3
    _dial(
        cost_map.weight,
        cost_map.start[0],
        cost_map.start[1],
        buckets,
        max_cost_m / cost_map.resolution,
        cost,
        step,
    )
    cost *= np.float32(cost_map.resolution)
    return TravelCosts(cost, step)


def shortest_path(
    cost_map: CostMap, travel: TravelCosts, cell: tuple[int, int], *, start: Array, spacing_m: float = 0.1
) -> Array:
    """Return the way ``(n, 2)`` [m] from ``start``, a point of the robot's cell, to the centre of ``cell``.

    It is cut straight wherever that costs no more and comes no nearer to a wall, then sampled evenly.

    Raises
    ------
    ValueError
        If the cell cannot be reached.
    """
    if not math.isfinite(float(travel.cost[cell])):
        raise ValueError(f"cell {cell} cannot be reached: choose one whose travel cost is finite")
    cells = _chain(travel.step, cell[0], cell[1])
    points = cost_map.to_points(cells)
    points[0] = np.asarray(start, dtype=np.float64)[:2]
    keep = _cut_straight(
        points, cost_map.weight, cost_map.clearance, cost_map.resolution, np.asarray(cost_map.origin)
    )
    return resample(points[keep], spacing_m)


def resample(path: Array, spacing_m: float) -> Array:
    """Return a path ``(m, 2)`` with points at most ``spacing_m`` apart that keeps its ends and corners."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, math.ceil(float(np.hypot(*(b - a))) / spacing_m - 1e-9))
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.vstack(pieces)


@njit(cache=True, nogil=True)
def _dial(
    weight: NDArray[np.float32],
    start_row: int,
    start_col: int,
    buckets: int,
    max_cost: float,
    cost: NDArray[np.float32],
    step: NDArray[np.int8],
) -> None:
    """Fill ``cost`` in cells (not metres): the cheapest edge is 1, the width of a bucket."""
    rows, cols = weight.shape
    diagonal = math.sqrt(2.0)
    head = np.full(buckets, -1, dtype=np.int32)
    # Each bucket is a doubly linked list through these two: a node is in one bucket at most.
    following = np.full(rows * cols, -1, dtype=np.int32)
    previous = np.full(rows * cols, -1, dtype=np.int32)
    done = np.zeros(rows * cols, dtype=np.bool_)
    node = start_row * cols + start_col
    cost[start_row, start_col] = 0.0
    head[0] = node
    waiting = 1
    bucket = 0
    while waiting > 0:
        while head[bucket % buckets] >= 0:
            node = head[bucket % buckets]
            head[bucket % buckets] = following[node]
            if following[node] >= 0:
                previous[following[node]] = -1
            waiting -= 1
            done[node] = True
            row, col = node // cols, node % cols
            for k in range(8):
                r, c = row + _D_ROW[k], col + _D_COL[k]
                other = r * cols + c
                if weight[r, c] <= 0.0 or done[other]:
                    continue
                length = 1.0
                if k % 2 == 1:
                    if weight[r, col] <= 0.0 or weight[row, c] <= 0.0:
                        continue
                    length = diagonal
                total = cost[row, col] + np.float32(length * 0.5 * (weight[row, col] + weight[r, c]))
                if total >= cost[r, c] or total > max_cost:
                    continue
                if cost[r, c] < np.inf:  # take it out of the bucket it waits in
                    if previous[other] >= 0:
                        following[previous[other]] = following[other]
                    else:
                        head[int(cost[r, c]) % buckets] = following[other]
                    if following[other] >= 0:
                        previous[following[other]] = previous[other]
                    waiting -= 1
                cost[r, c] = total
                step[r, c] = k
                place = int(total) % buckets
                following[other] = head[place]
                previous[other] = -1
                if head[place] >= 0:
                    previous[head[place]] = other
                head[place] = other
                waiting += 1
        bucket += 1


@njit(cache=True, nogil=True)
def _chain(step: NDArray[np.int8], row: int, col: int) -> NDArray[np.int64]:
    count = 1
    r, c = row, col
    while step[r, c] >= 0:
        k = step[r, c]
        r, c = r - _D_ROW[k], c - _D_COL[k]
        count += 1
    cells = np.empty((count, 2), dtype=np.int64)
    r, c = row, col
    for i in range(count - 1, -1, -1):
        cells[i, 0], cells[i, 1] = r, c
        k = step[r, c]
        if k >= 0:
            r, c = r - _D_ROW[k], c - _D_COL[k]
    return cells


@njit(cache=True, nogil=True)
def _segment(
    a: Array,
    b: Array,
    weight: NDArray[np.float32],
    wall: NDArray[np.float32],
    resolution: float,
    origin: Array,
) -> tuple[float, float]:
    """Price of the straight line a–b (inf where it leaves passable cells) and its smallest clearance."""
    length = math.hypot(b[0] - a[0], b[1] - a[1])
    count = max(1, math.ceil(length / (0.5 * resolution)))
    total, nearest = 0.0, np.inf
    for i in range(count + 1):
        share = i / count
        col = math.floor((a[0] + share * (b[0] - a[0]) - origin[0]) / resolution)
        row = math.floor((a[1] + share * (b[1] - a[1]) - origin[1]) / resolution)
        if weight[row, col] <= 0.0:
            return np.inf, 0.0
        # Trapezoidal rule: the ends count half.
        total += weight[row, col] * (0.5 if i == 0 or i == count else 1.0)
        nearest = min(nearest, wall[row, col])
    return total * length / count, nearest


@njit(cache=True, nogil=True)
def _cut_straight(
    points: Array,
    weight: NDArray[np.float32],
    wall: NDArray[np.float32],
    resolution: float,
    origin: Array,
) -> NDArray[np.int64]:
    """Return the indices of the points to keep."""
    n = points.shape[0]
    keep = np.empty(n, dtype=np.int64)
    keep[0] = 0
    count = 1
    span = 64  # cells looked ahead: longer straight lines are kept in pieces
    so_far = np.empty(n)
    lowest = np.empty(n)
    i = 0
    while i < n - 1:
        last = min(i + span, n - 1)
        so_far[i], lowest[i] = 0.0, wall[0, 0]
        for j in range(i + 1, last + 1):
            price, nearest = _segment(points[j - 1], points[j], weight, wall, resolution, origin)
            so_far[j] = so_far[j - 1] + price
            lowest[j] = min(nearest, lowest[j - 1])
        j = last
        while j > i + 1:
            price, nearest = _segment(points[i], points[j], weight, wall, resolution, origin)
            if price <= so_far[j] * 1.01 and nearest >= lowest[j] - 0.01:
                break
            j -= 1
        keep[count] = j
        count += 1
        i = j
    return keep[:count]
