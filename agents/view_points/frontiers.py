"""Frontiers: where free space borders on the unknown (Yamauchi, 1997)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.view_points.sight import Watch, in_good_sight
from agents.ways.cost_map import CostMap
from slam.grids.occupancy import FREE, UNKNOWN
from slam.settings import Config, Count, Gap, Length, NotNegative, Within
from slam.types import Array, Bytes, Cells, Flags, Floats, Indices

__all__ = ["FrontierConfig", "Frontiers", "find", "frontier_cells"]


@dataclass(frozen=True, kw_only=True)
class FrontierConfig(Config):
    """What counts as a frontier, and from where one is looked at."""

    min_extent_m: Gap = 0.4  # longer side of a cluster's bounding box; at most the body's width
    far_extent_m: Gap = 0.7  # the same at a travel cost of far_m and beyond; at most twice the body's width
    far_m: Length = 6.0  # [weighted m]; up to there in proportion
    remote_m: Length = 30.0  # [weighted m]; what is farther off must show, or it is not worth the way, …
    remote_m2_m: NotNegative = 0.05  # … so much of the unknown for each metre beyond
    opening_m2: NotNegative = 2.0  # unknown in view from one that is smaller, for it to be gone to at last
    min_unknown_m2: NotNegative = 0.05  # smaller unknown pockets hold nothing to find
    min_unknown_width_m: Gap = 0.3  # thinner ones are the insides of walls
    min_clearance_m: Gap = 0.1  # of a frontier cell: gaps in the drawing of a wall are no openings
    joined_cells: Count = 1  # frontier cells no farther apart than so many are of one cluster
    # A long cluster is looked at in pieces of about this size.
    spacing_m: Annotated[float, Within("[0.05, 1000]")] = 0.6
    # Farthest place to look from, squarely; never beyond 0.8 of the lidar's range.
    view_range_m: Annotated[float, Within("[0.05, 1000]")] = 4.0
    beyond_m: Gap = 0.3  # how far behind the frontier a view point must see

    def for_body(self, width_m: float) -> FrontierConfig:
        """Return the same for a body of this width [m]: where a small one could pass is worth a look."""
        return replace(
            self, min_extent_m=min(self.min_extent_m, width_m), far_extent_m=min(self.far_extent_m, 2.0 * width_m)
        )

    def finest(self, resolution_m: float) -> FrontierConfig:
        """Return the same for whatever is larger than a cell of this size [m]."""
        least = 2.0 * resolution_m
        return replace(
            self, min_extent_m=least, min_unknown_m2=resolution_m**2, min_unknown_width_m=resolution_m,
            min_clearance_m=0.0,
        )  # fmt: skip

    def wanted_extent(self, costs: Array) -> Array:
        """Return the extent [m] that makes a cluster worth going to at these travel costs ``(m,)``."""
        share = np.minimum(costs / self.far_m, 1.0)
        return np.asarray(self.min_extent_m + share * (self.far_extent_m - self.min_extent_m))


@dataclass(frozen=True, eq=False)
class Frontiers:
    """Frontier cells in clusters, and the pieces that the clusters are looked at in."""

    points: Array  # (n, 2) centres of the frontier cells [m]
    labels: Indices  # (n,) cluster of each, 0 … clusters − 1
    extents: Array  # (clusters,) longer side of the bounding box [m]
    targets: Array  # (m, 2) one frontier cell's centre per piece [m]
    target_labels: Indices  # (m,) cluster of each piece
    sizes: Indices  # (m,) frontier cells in each piece
    normals: Array  # (m, 2) unit vectors from free towards unknown; zero where they cancel


@njit(cache=True, nogil=True)
def frontier_cells(classes: NDArray[np.int8]) -> int:
    """Return how many FREE cells, those on the raster's rim left out, have an UNKNOWN 8-neighbour."""
    count = 0
    for row in range(1, classes.shape[0] - 1):
        for col in range(1, classes.shape[1] - 1):
            if classes[row, col] == FREE:
                count += _touches(classes, row, col, UNKNOWN)
    return count


@njit(cache=True, nogil=True)
def _touches(classes: NDArray[np.int8], row: int, col: int, kind: int) -> bool:
    """Whether a cell or one of its 8 neighbours is of this class."""
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            if classes[r, c] == kind:
                return True
    return False


def find(cost_map: CostMap, config: FrontierConfig, watch: Watch | None = None) -> Frontiers:
    """Return the frontiers of a planning grid, small clusters and small unknown pockets left out.

    With a ``watch``, so are the cells that were in good sight already and did not yield.
    """
    classes, resolution = cost_map.classes, cost_map.resolution
    near = _borders_a_large_pocket(cost_map, config)
    least = float(np.float32(config.min_clearance_m))
    cells = _bordering(classes, cost_map.clearance, cost_map.suspect, near, least)
    normals = _normals(classes, cells)
    if watch is not None:
        seen = in_good_sight(cost_map, cells, normals, watch)
        cells, normals = cells[~seen], normals[~seen]
    own, boxes = _clusters(cells, classes.shape, config.joined_cells)
    extent = boxes.max(axis=1, initial=0) * resolution
    large = extent >= config.min_extent_m - 1e-9
    renumber = np.where(large, np.cumsum(large) - 1, -1)
    own = renumber[own]
    kept = own >= 0
    cells, own, normals = cells[kept], own[kept], normals[kept]
    chosen, sizes = _pieces(cells, own, max(1, round(config.spacing_m / resolution)))
    points = cost_map.to_points(cells)
    return Frontiers(points, own, extent[large], points[chosen], own[chosen], sizes, normals[chosen])


def _borders_a_large_pocket(cost_map: CostMap, config: FrontierConfig) -> Bytes:
    """Return, not 0, the cells beside unknown regions that are neither thin (inside a wall) nor small."""
    unknown = ((cost_map.classes == UNKNOWN) & ~cost_map.suspect).view(np.uint8)
    # Odd, or the opening would shift what it opens.
    span = max(1, (round(config.min_unknown_width_m / cost_map.resolution) - 1) | 1)
    # Beyond the grid all is unknown: with a rim of that, what reaches its edge is as thick as it is there.
    padded = cv2.copyMakeBorder(unknown, span, span, span, span, cv2.BORDER_CONSTANT, value=1)
    opening = np.ones((span, span), dtype=np.uint8)
    thick = cv2.morphologyEx(padded, cv2.MORPH_OPEN, opening)
    # What is left holds a whole square of the opening each.
    if span**2 * cost_map.resolution**2 >= config.min_unknown_m2:
        pockets = thick
    else:
        _, labels, stats, _ = cv2.connectedComponentsWithStats(thick, connectivity=4)
        large = stats[:, cv2.CC_STAT_AREA] * cost_map.resolution**2 >= config.min_unknown_m2
        large[0] = False
        pockets = large[labels].astype(np.uint8)
    near = np.asarray(cv2.dilate(pockets, np.ones((3, 3), dtype=np.uint8)), dtype=np.uint8)
    return near[span:-span, span:-span]


def _clusters(cells: Cells, shape: tuple[int, ...], reach: int) -> tuple[Indices, Indices]:
    """Return each cell's cluster ``(n,)`` and the clusters' height and width ``(clusters, 2)``.

    With a ``reach`` of 1 they are 8-connected.
    Clusters are numbered in the order in which blocks of 2 × 2 cells meet them, row by row: OpenCV's order. The
    few cells of a frontier are joined in a fraction of the time that OpenCV takes to look all over a large grid.
    """
    labels = np.empty(len(cells), dtype=np.int64)
    boxes = np.empty((len(cells), 2), dtype=np.int64)
    order = np.lexsort((cells[:, 1] // 2, cells[:, 0] // 2))
    count = _join(cells, order, np.zeros(shape, dtype=np.int32), reach, labels, boxes)
    return labels, boxes[:count]


def _pieces(cells: Cells, labels: Indices, span: int) -> tuple[Indices, Indices]:
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


def _normals(classes: NDArray[np.int8], cells: Cells) -> Array:
    """Return unit vectors ``(m, 2)`` (x, y) from each cell towards the unknown cells within two cells of it."""
    vector = np.zeros((len(cells), 2))
    _towards_unknown(classes, cells, vector)
    norm = np.hypot(vector[:, 0], vector[:, 1])
    return vector / np.where(norm > 0, norm, 1.0)[:, None]


@njit(cache=True, nogil=True)
def _towards_unknown(classes: NDArray[np.int8], cells: Cells, vector: Array) -> None:
    """Add up the steps (x, y) to unknown cells; beyond the grid all is as on its rim."""
    rows, cols = classes.shape
    for i in range(len(cells)):
        for down in range(-2, 3):
            row = min(max(cells[i, 0] + down, 0), rows - 1)
            for along in range(-2, 3):
                if classes[row, min(max(cells[i, 1] + along, 0), cols - 1)] == UNKNOWN:
                    vector[i, 0] += along
                    vector[i, 1] += down


@njit(cache=True, nogil=True)
def _bordering(
    classes: NDArray[np.int8], clearance: Floats, suspect: Flags, near: Bytes, min_clearance: float
) -> Indices:
    """Return the FREE, unsuspected cells ``(n, 2)`` near the unknown that are no gaps in a wall, row by row."""
    cells = np.empty((1024, 2), dtype=np.int64)
    count = 0
    for row in range(classes.shape[0]):
        for col in range(classes.shape[1]):
            if near[row, col] == 0 or classes[row, col] != FREE or suspect[row, col]:
                continue
            if clearance[row, col] >= min_clearance:
                if count == len(cells):
                    cells = np.concatenate((cells, np.empty_like(cells)))
                cells[count, 0], cells[count, 1] = row, col
                count += 1
    return cells[:count]


@njit(cache=True, nogil=True)
def _join(
    cells: Cells, order: Indices, index: NDArray[np.int32], reach: int, labels: Indices, boxes: Indices
) -> int:
    """Flood each cluster from its first cell in ``order``; ``index`` ``(rows, cols)`` is 0 all over."""
    rows, cols = index.shape
    for i in range(len(cells)):
        index[cells[i, 0], cells[i, 1]] = i + 1
    labels[:] = -1
    stack = np.empty(len(cells), dtype=np.int64)
    count = 0
    for first in order:
        if labels[first] >= 0:
            continue
        labels[first] = count
        stack[0] = first
        height = 1
        low_r = high_r = cells[first, 0]
        low_c = high_c = cells[first, 1]
        while height > 0:
            height -= 1
            row, col = cells[stack[height]]
            low_r, high_r = min(low_r, row), max(high_r, row)
            low_c, high_c = min(low_c, col), max(high_c, col)
            for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
                for c in range(max(col - reach, 0), min(col + reach + 1, cols)):
                    other = index[r, c] - 1
                    if other >= 0 and labels[other] < 0:
                        labels[other] = count
                        stack[height] = other
                        height += 1
        boxes[count, 0], boxes[count, 1] = high_r - low_r + 1, high_c - low_c + 1
        count += 1
    return count
