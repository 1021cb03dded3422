"""Travel costs from the robot to everywhere at once, and the smooth path to one place.

The costs come from Dijkstra's algorithm over the 8-connected planning grid with Dial's bucket queue: no edge is
cheaper than one bucket is wide, so the nodes of the lowest bucket are final in any order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.cost_map import CostMap
from slam.types import Array, Bytes, Floats, Indices

__all__ = [
    "D_COL", "D_ROW", "TravelCosts", "cell_before", "resample", "shortest_path", "travel_costs", "way_cells",
]  # fmt: skip

D_ROW, D_COL = np.array([0, 1, 1, 1, 0, -1, -1, -1]), np.array([1, 1, 0, -1, -1, -1, 0, 1])
"""A cell's eight neighbours, even ones straight and odd ones diagonal; the opposite of k is (k + 4) % 8."""

_ALL_BUCKETS = 2**30  # more than there are


@dataclass(frozen=True, eq=False)
class TravelCosts:
    """Cost of the cheapest way from the robot to each cell, and the step that way ends with."""

    cost: Floats  # (rows, cols) weighted metres, inf where it cannot get
    step: NDArray[np.int8]  # (rows, cols) direction 0–7 of the last step, −1 at the start and where none is known
    beyond_m: float = math.inf  # this is the cost of all that costs at least so much: it was not searched for


def travel_costs(cost_map: CostMap, *, within_m: float = math.inf) -> TravelCosts:
    """Return the travel costs from the robot's cell.

    A step costs its length times the mean weight of its two cells. A diagonal step needs both cells beside it
    free, so that no path slips between two walls that touch at a corner.

    With ``within_m``, ways are searched for only as far as they cost about that much [weighted m]: what lies
    within is the same, and where the robot can get at all is known beyond, too.
    """
    shape, resolution = cost_map.weight.shape, np.float32(cost_map.resolution)
    cost = np.full(shape, np.inf, dtype=np.float32)
    step = np.full(shape, -1, dtype=np.int8)
    highest = float(cost_map.weight.max())
    buckets = math.ceil(math.sqrt(2.0) * highest) + 3
    last = math.ceil(min(within_m / cost_map.resolution, _ALL_BUCKETS))
    done = _dial(cost_map.weight, cost_map.start[0], cost_map.start[1], buckets, last, cost, step)
    if done:
        cost *= resolution
        return TravelCosts(cost, step)
    beyond = np.float32(last) * resolution
    # A diagonal step needs the cells beside it: where it can get, it can without any.
    passable = (cost_map.weight > 0.0).view(np.uint8)
    cv2.floodFill(passable, None, cost_map.start[::-1], 2, flags=4)
    _to_metres(cost, resolution, passable, beyond)
    return TravelCosts(cost, step, float(beyond))


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
    cells = way_cells(travel, cell)
    points = cost_map.to_points(cells)
    points[0] = np.asarray(start, dtype=np.float64)[:2]
    keep = _cut_straight(
        points, cost_map.weight, cost_map.clearance, cost_map.resolution, np.asarray(cost_map.origin)
    )
    return resample(points[keep], spacing_m)


def way_cells(travel: TravelCosts, cell: tuple[int, int]) -> Indices:
    """Return the cells ``(n, 2)`` of the cheapest way from the robot to a cell, both included."""
    return np.asarray(_chain(travel.step, int(cell[0]), int(cell[1])))


def resample(path: Array, spacing_m: float) -> Array:
    """Return a path ``(m, 2)`` with points at most ``spacing_m`` apart that keeps its ends and corners."""
    pieces = [path[:1]]
    for a, b in pairwise(path):
        count = max(1, math.ceil(float(np.hypot(*(b - a))) / spacing_m - 1e-9))
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.vstack(pieces)


@njit(cache=True, nogil=True, error_model="numpy")
def _dial(
    weight: Floats, start_row: int, start_col: int, buckets: int, last: int, cost: Floats, step: NDArray[np.int8]
) -> bool:
    """Fill ``cost`` in cells (not metres): the cheapest edge is 1, the width of a bucket.

    Bucket ``last`` and those after it are left; return whether there was none of them.

    Weights are 0 or at least 1, so that nothing taken from a bucket makes another of it cheaper than what left it
    before. Each bucket is a stack, a list linked through ``below``. A node that becomes cheaper is put on a stack
    again and left in the old one, where it is found to be done (or, in the same bucket, done over to no effect).
    Entries taken off are used again, so that the lists stay as short as the front is long, and in the processor's
    cache.
    """
    u = np.uint64  # as indices, others are tested for being negative
    weights, costs, steps = weight.ravel(), cost.ravel(), step.ravel()
    ahead, ahead_count = _ahead()
    offsets, beside, half_lengths = _edges(ahead, weight.shape[1])
    # Each of its eight edges makes a node cheaper once at most. What is never written takes no memory.
    node_of = np.empty(8 * weights.shape[0], dtype=np.int32)
    below = np.empty(8 * weights.shape[0], dtype=np.int32)
    top = np.full(buckets, -1, dtype=np.int32)
    used, spare = 1, np.int32(-1)
    start = start_row * weight.shape[1] + start_col
    costs[start] = 0.0
    node_of[0], below[0], top[0] = start, -1, 0
    waiting = 1
    bucket = place = 0  # place is bucket modulo buckets
    while waiting > 0 and bucket < last:
        while top[u(place)] >= 0:
            entry = u(top[u(place)])
            node = np.int64(node_of[entry])
            top[u(place)] = below[entry]
            below[entry] = spare
            spare = np.int32(entry)
            waiting -= 1
            here = costs[u(node)]
            if int(here) != bucket:  # done, from a lower bucket
                continue
            own = weights[u(node)]
            least = here + np.float32(1.0)
            way = u(steps[u(node)]) if steps[u(node)] >= 0 else u(8)
            for i in range(u(ahead_count[way])):
                other = u(node + offsets[way, i])
                before = costs[other]
                if before <= least:  # most neighbours: settled, at no more than the cheapest edge would make
                    continue
                price = weights[other]
                if price <= 0.0:
                    continue
                total = here + np.float32(half_lengths[way, i] * (own + price))
                if total >= before:
                    continue
                k = ahead[way, i]
                if k & 1:
                    left, right = u(node + beside[way, i, u(0)]), u(node + beside[way, i, u(1)])
                    if weights[left] <= 0.0 or weights[right] <= 0.0:
                        continue
                costs[other] = total
                steps[other] = k
                to = place + int(total) - bucket
                if to >= buckets:
                    to -= buckets
                if spare >= 0:
                    entry = u(spare)
                    spare = below[entry]
                else:
                    entry = u(used)
                    used += 1
                node_of[entry] = np.int32(other)
                below[entry] = top[u(to)]
                top[u(to)] = np.int32(entry)
                waiting += 1
        bucket += 1
        place = place + 1 if place + 1 < buckets else 0
    for rest in top:
        while rest >= 0:
            if costs[node_of[rest]] >= bucket:
                costs[node_of[rest]], steps[node_of[rest]] = np.inf, -1
            rest = below[rest]
    return waiting == 0


@njit(cache=True, nogil=True)
def _to_metres(cost: Floats, resolution: np.float32, reached: Bytes, beyond: np.float32) -> None:
    """Turn cells into metres, and what is unknown into ``beyond`` where it was ``reached``: 2."""
    for row in range(cost.shape[0]):
        for col in range(cost.shape[1]):
            known = cost[row, col] * resolution
            cost[row, col] = beyond if known == np.inf and reached[row, col] == 2 else known


@njit(cache=True, nogil=True)
def _ahead() -> tuple[Indices, Indices]:
    """Return the neighbours to look at after each step ``(9, 8)``, in order, and how many; last the start's.

    Where a step has come from needs no look: the cell itself, and the two on either side of it, which are its
    neighbours, too, and cheaper to reach from there: for all weights, the direct edge costs less than the step and
    a second one, of which one is straight and the other diagonal.
    """
    ahead = np.zeros((9, 8), dtype=np.int64)
    count = np.zeros(9, dtype=np.int64)
    for way in range(9):
        for k in range(8):
            turn = (k - way) % 8
            if way == 8 or turn <= 2 or turn >= 6:
                ahead[way, count[way]] = k
                count[way] += 1
    return ahead, count


@njit(cache=True, nogil=True)
def _edges(ahead: Indices, cols: int) -> tuple[Indices, Indices, Array]:
    """Return where the neighbours lie ``(9, 8)``, and the two cells beside each step ``(9, 8, 2)``, by index.

    And half the length of each step ``(9, 8)``.
    """
    around = D_ROW * cols + D_COL
    offsets, half_lengths = np.zeros((9, 8), dtype=np.int64), np.zeros((9, 8))
    beside = np.zeros((9, 8, 2), dtype=np.int64)
    for way in range(9):
        for i in range(8):
            k = ahead[way, i]
            offsets[way, i] = around[k]
            beside[way, i, 0], beside[way, i, 1] = around[(k - 1) & 7], around[(k + 1) & 7]
            half_lengths[way, i] = 0.5 * math.sqrt(2.0) if k & 1 else 0.5
    return offsets, beside, half_lengths


@njit(cache=True, nogil=True)
def cell_before(step: NDArray[np.int8], row: int, col: int) -> tuple[int, int]:
    """Return the row and column that the last step of the way to a cell, which is not the start, came from."""
    k = step[row, col]
    return row - D_ROW[k], col - D_COL[k]


@njit(cache=True, nogil=True)
def _chain(step: NDArray[np.int8], row: int, col: int) -> Indices:
    cells = [(row, col)]
    while step[row, col] >= 0:
        row, col = cell_before(step, row, col)
        cells.append((row, col))
    return np.array(cells[::-1])


@njit(cache=True, nogil=True)
def _segment(
    a: Array, b: Array, weight: Floats, wall: Floats, resolution: float, origin: Array
) -> tuple[float, float]:
    """Price of the straight line a–b (inf where it leaves passable cells, or the map) and its least clearance."""
    length = math.hypot(b[0] - a[0], b[1] - a[1])
    count = max(1, math.ceil(length / (0.5 * resolution)))
    total, nearest = 0.0, np.inf
    for i in range(count + 1):
        share = i / count
        col = math.floor((a[0] + share * (b[0] - a[0]) - origin[0]) / resolution)
        row = math.floor((a[1] + share * (b[1] - a[1]) - origin[1]) / resolution)
        inside = 0 <= row < weight.shape[0] and 0 <= col < weight.shape[1]
        if not inside or weight[row, col] <= 0.0:
            return np.inf, 0.0
        # Trapezoidal rule: the ends count half.
        total += weight[row, col] * (0.5 if i == 0 or i == count else 1.0)
        nearest = min(nearest, wall[row, col])
    return total * length / count, nearest


@njit(cache=True, nogil=True)
def _cut_straight(points: Array, weight: Floats, wall: Floats, resolution: float, origin: Array) -> Indices:
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
        so_far[i], lowest[i] = 0.0, np.inf
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
