"""Frontiers: where free space borders on the unknown, and from where to look beyond (Yamauchi, 1997)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.cost_map import CostMap
from agents.planning import TravelCosts
from slam.occupancy import FREE, OCCUPIED, UNKNOWN
from slam.settings import require

__all__ = ["FrontierConfig", "Frontiers", "ViewPoints", "find", "frontier_mask", "view_points"]

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrontierConfig:
    """What counts as a frontier, and from where one is looked at."""

    min_extent_m: float = 0.3  # longer side of a cluster's bounding box
    min_unknown_m2: float = 0.05  # smaller unknown pockets hold nothing to find
    min_clearance_m: float = 0.1  # of a frontier cell: gaps in the drawing of a wall are no openings
    spacing_m: float = 0.6  # a long cluster is looked at in pieces of about this size
    view_range_m: float = 0.8  # farthest place to look from; never beyond 0.8 of the lidar's range
    beyond_m: float = 0.3  # how far behind the frontier a view point must see

    def __post_init__(self) -> None:
        for name in ("min_extent_m", "min_unknown_m2", "min_clearance_m", "beyond_m"):
            value = getattr(self, name)
            require(math.isfinite(value) and value >= 0, f"FrontierConfig.{name} must be ≥ 0, got {value}")
        for name in ("spacing_m", "view_range_m"):
            value = getattr(self, name)
            require(math.isfinite(value) and value > 0, f"FrontierConfig.{name} must be > 0, got {value}")


@dataclass(frozen=True, eq=False)
class Frontiers:
    """Frontier cells in clusters, and the pieces that the clusters are looked at in."""

    points: Array  # (n, 2) centres of the frontier cells [m]
    labels: NDArray[np.int64]  # (n,) cluster of each, 0 … clusters − 1
    extents: Array  # (clusters,) longer side of the bounding box [m]
    targets: Array  # (m, 2) one frontier cell's centre per piece [m]
    target_labels: NDArray[np.int64]  # (m,) cluster of each piece
    sizes: NDArray[np.int64]  # (m,) frontier cells in each piece
    normals: Array  # (m, 2) unit vectors from free towards unknown; zero where they cancel


@dataclass(frozen=True, eq=False)
class ViewPoints:
    """For each piece of frontier, the cheapest reachable place to look beyond it from."""

    cells: NDArray[np.int64]  # (m, 2) row, column of the planning grid; −1 where there is none
    costs: Array  # (m,) travel cost, inf where there is none


def frontier_mask(classes: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return the FREE cells with an UNKNOWN 8-neighbour ``(rows, cols)``; outside the grid counts as unknown."""
    unknown = (classes == UNKNOWN).view(np.uint8)
    kernel = np.ones((3, 3), dtype=np.uint8)
    near = cv2.dilate(unknown, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    return np.asarray((classes == FREE) & (near != 0))


def find(cost_map: CostMap, config: FrontierConfig) -> Frontiers:
    """Return the frontiers of a planning grid, small clusters and small unknown pockets left out."""
    classes, resolution = cost_map.classes, cost_map.resolution
    mask = frontier_mask(classes) & (cost_map.clearance >= np.float32(config.min_clearance_m))
    mask &= _borders_a_large_pocket(classes, resolution, config.min_unknown_m2)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    extent = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) * resolution
    large = extent >= config.min_extent_m - 1e-9
    large[0] = False
    renumber = np.full(count, -1, dtype=np.int64)
    renumber[large] = np.arange(int(large.sum()))
    cells = np.argwhere(mask)
    own = renumber[labels[cells[:, 0], cells[:, 1]]]
    cells, own = cells[own >= 0], own[own >= 0]
    chosen, sizes = _pieces(cells, own, max(1, round(config.spacing_m / resolution)))
    normals = _normals(classes, cells[chosen]) if chosen.size else np.zeros((0, 2))
    points = cost_map.to_points(cells)
    return Frontiers(points, own, extent[large], points[chosen], own[chosen], sizes, normals)


def view_points(
    cost_map: CostMap,
    travel: TravelCosts,
    frontiers: Frontiers,
    config: FrontierConfig,
    *,
    range_m: float,
    shares: Array | None = None,
) -> ViewPoints:
    """Return, for each piece of frontier, the cheapest cell from which what lies behind it is in sight.

    Sight lines are walked backwards from a point ``beyond_m`` behind the frontier. Where no reachable cell sees
    that point, one near the frontier that sees the frontier itself will do: it is the last that can be tried.
    ``shares`` ``(m,)`` shorten the view range of single pieces: those that a look from afar did not settle.
    """
    limit = min(config.view_range_m, 0.8 * range_m) / cost_map.resolution
    reach = limit * (np.ones(len(frontiers.targets)) if shares is None else shares)
    start = (frontiers.targets - np.asarray(cost_map.origin)) / cost_map.resolution
    cells = np.full((len(start), 2), -1, dtype=np.int64)
    costs = np.full(len(start), np.inf)
    beyond = config.beyond_m / cost_map.resolution
    _look(cost_map.classes, travel.cost, start, frontiers.normals, reach, beyond, cells, costs)
    return ViewPoints(cells, costs)


def _borders_a_large_pocket(classes: NDArray[np.int8], resolution: float, min_area: float) -> NDArray[np.bool_]:
    unknown = (classes == UNKNOWN).view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(unknown, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] * resolution**2 >= min_area
    large[0] = False
    pockets = large[labels].astype(np.uint8)
    kernel = np.ones((3, 3), dtype=np.uint8)
    near: NDArray[np.bool_] = cv2.dilate(pockets, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=1) != 0
    return near


def _pieces(
    cells: NDArray[np.int64], labels: NDArray[np.int64], span: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split clusters along a lattice of ``span`` cells; return the middle cell's index and size of each piece."""
    if not len(cells):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    block = cells // span
    key = (labels * (block[:, 0].max() + 1) + block[:, 0]) * (block[:, 1].max() + 1) + block[:, 1]
    _, piece, sizes = np.unique(key, return_inverse=True, return_counts=True)
    mean = np.stack([np.bincount(piece, cells[:, axis]) for axis in (0, 1)], axis=1) / sizes[:, None]
    away = np.sum((cells - mean[piece]) ** 2, axis=1)
    order = np.lexsort((away, piece))
    chosen = order[np.concatenate([[0], np.cumsum(sizes)[:-1]])]
    # Crumbs that the lattice cuts off a cluster are seen along with its other pieces.
    largest = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    np.maximum.at(largest, labels[chosen], sizes)
    keep = (sizes >= min(3, span)) | (sizes == largest[labels[chosen]])
    return chosen[keep], sizes[keep]


def _normals(classes: NDArray[np.int8], cells: NDArray[np.int64]) -> Array:
    """Return unit vectors ``(m, 2)`` (x, y) from each cell towards the unknown cells within two cells of it."""
    rows, cols = classes.shape
    shift_r, shift_c = (v.ravel() for v in np.mgrid[-2:3, -2:3])
    r, c = cells[:, :1] + shift_r, cells[:, 1:] + shift_c
    unknown = classes[np.clip(r, 0, rows - 1), np.clip(c, 0, cols - 1)] == UNKNOWN
    vector = np.stack([unknown @ shift_c, unknown @ shift_r], axis=1).astype(np.float64)
    norm = np.hypot(vector[:, 0], vector[:, 1])
    return vector / np.where(norm > 0, norm, 1.0)[:, None]


@njit(cache=True, nogil=True)
def _look(
    classes: NDArray[np.int8],
    cost: NDArray[np.float32],
    targets: Array,
    normals: Array,
    reach: Array,
    beyond: float,
    cells: NDArray[np.int64],
    costs: Array,
) -> None:
    """Find the cheapest cell in sight of each target; positions in cells, x first."""
    for i in range(targets.shape[0]):
        x, y = targets[i, 0], targets[i, 1]
        push = beyond
        while push > 0.0 and _at(classes, x + push * normals[i, 0], y + push * normals[i, 1]) == OCCUPIED:
            push -= 1.0
        push = max(push, 0.0)
        from_x, from_y = x + push * normals[i, 0], y + push * normals[i, 1]
        _sweep(classes, cost, from_x, from_y, reach[i] + push, push + 2.0, i, cells, costs)
        if costs[i] == np.inf:
            _sweep(classes, cost, x, y, 0.5 * reach[i], 1.0, i, cells, costs)


@njit(cache=True, nogil=True)
def _at(classes: NDArray[np.int8], x: float, y: float) -> int:
    row, col = math.floor(y), math.floor(x)
    if row < 0 or col < 0 or row >= classes.shape[0] or col >= classes.shape[1]:
        return UNKNOWN
    return int(classes[row, col])


@njit(cache=True, nogil=True)
def _sweep(
    classes: NDArray[np.int8],
    cost: NDArray[np.float32],
    x: float,
    y: float,
    reach: float,
    blind: float,
    index: int,
    cells: NDArray[np.int64],
    costs: Array,
) -> None:
    """Walk sight lines from (x, y): through anything but walls for ``blind`` cells, then through free ones."""
    directions = 96
    for k in range(directions):
        angle = 2.0 * math.pi * k / directions
        dx, dy = math.cos(angle), math.sin(angle)
        away = 0.0
        while away <= reach:
            px, py = x + away * dx, y + away * dy
            kind = _at(classes, px, py)
            if kind == OCCUPIED or (kind == UNKNOWN and away > blind):
                break
            if kind == FREE:
                row, col = math.floor(py), math.floor(px)
                if cost[row, col] < costs[index]:
                    costs[index] = cost[row, col]
                    cells[index, 0], cells[index, 1] = row, col
            away += 0.7  # less than a cell: no wall is stepped over, diagonal ones included
