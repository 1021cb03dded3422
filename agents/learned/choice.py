"""What a learned policy sees of the choice before it: candidates as rows of numbers, patches and distances.

Everything is relative to the robot or to the frontier itself, so that a turned or shifted room looks the same, and
the rows carry no order: what is learned on few candidates goes for many.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.explorer import Candidates
from agents.view_points.anchoring import marks_of
from agents.view_points.gain import expected_area
from agents.view_points.sightings import SensorModel, expected_sightings
from agents.ways.cost_map import CostMap
from agents.ways.planning import cell_before
from agents.ways.travel import between
from mecanum_env.config import LidarConfig
from slam.belief import Belief
from slam.grids.occupancy import FREE, OCCUPIED
from slam.settings import Config, Duration, Few, Length, Within
from slam.types import Array, Bytes, Cells, Floats, Indices

__all__ = ["CANDIDATE", "SIDEWAYS", "STATE", "Choice", "ChoiceConfig", "describe", "mirrored"]

_FIRST_LEG_M = 0.5  # of a way: where it turns to first
_SENSOR = SensorModel()

CANDIDATE = (
    "way", "distance", "ahead", "left", "target_ahead", "target_left", "normal_ahead", "normal_left",
    "area_near", "area_far", "extent", "cells", "clearance", "current", "worth", "rank", "turn", "corners",
    "walls", "sigma_left", "pieces", "tour_first", "tour_place", "tour_loss",
)  # fmt: skip
"""Columns of a candidate's row."""

SIDEWAYS = [CANDIDATE.index(name) for name in ("left", "target_left", "normal_left")]
"""Of these, those that change their sign in a mirror."""

_TOUR_LOSS_M = 5.0  # one unit of the column tour_loss [weighted m]

STATE = ("time", "known_m2", "candidates", "sigma_m", "sigma_rad", "share_visited", "area_m2", "nearest")
"""What there is to say about the choice as a whole."""


@dataclass(frozen=True, kw_only=True)
class ChoiceConfig(Config):
    """How much of the choice is shown."""

    most: Few = 24  # candidates: the cheapest to reach
    patch_cells: Annotated[int, Within("[1, 256]")] = 16  # side of a patch
    patch_m: Length = 0.5  # side of one of its cells …
    wide_m: Length = 1.0  # … and of a wider one's
    beyond_m: Length = 2.0  # from the frontier to the patches' middle, into the unknown
    near_m: Length = 2.0  # how far into the unknown an optimist sees …
    far_m: Length = 5.0  # … and a greater one
    horizon_s: Duration = 300.0  # that time counts against
    uncertainty: bool = True  # covariance and landmarks are shown; else 0 stands in their columns


@dataclass(frozen=True, eq=False)
class TourPlan:
    """The best tour found over n view points, and what it takes to begin with another of them."""

    cells: Cells  # (n, 2) row, column of the view points
    order: Indices  # (k,) those on the tour, in its order
    losses_m: Array  # (n,) of beginning with each: how much later all is seen, on average


@dataclass(frozen=True, eq=False)
class Choice:
    """A choice, described: m candidates, cheapest first. Pieces of frontier that share a view point are one."""

    index: Indices  # (m,) of the candidate among all that were found
    candidates: Floats  # (m, CANDIDATE)
    # Share of free and of occupied, then the same in the wider patch, the frontier's normal to the right.
    patches: Bytes  # (m, 4, s, s)
    distances: Floats  # (m, m) travel costs between the view points [10 weighted m]
    state: Floats  # (STATE,)


def describe(
    found: Candidates, belief: Belief, config: ChoiceConfig, *, lidar: LidarConfig, time_s: float, plan: TourPlan
) -> Choice:
    """Return what there is to choose from, described; at least one candidate has a finite cost.

    Parameters
    ----------
    found
        The candidates, as the explorer found them.
    belief
        The belief that they were found on.
    config
        How much is shown.
    lidar
        The sensor; it is counted on to see as far as 0.8 of its range.
    time_s
        Since the episode began.
    plan
        The tour over the candidates' view points.
    """
    index, pieces, views_found = _apart(found, config.most)
    cost_map, cells, costs = found.cost_map, found.cells[index], found.costs[index]
    targets, normals = found.frontiers.targets[index], found.frontiers.normals[index]
    pose = np.asarray(belief.pose, dtype=np.float64)
    views = cost_map.to_points(cells)
    range_m = 0.8 * lidar.range_max_m
    near = expected_area(cost_map, cells, range_m=range_m, depth_m=config.near_m, rays=60)
    far = expected_area(cost_map, cells, range_m=range_m, depth_m=config.far_m, rays=60)
    offset, target_offset = views - pose[:2], targets - pose[:2]
    away = np.hypot(*offset.T)
    rows = np.column_stack([
        costs / 10.0,
        away / 10.0,
        *_direction(offset, pose[2]),
        *_direction(target_offset, pose[2]),
        *_direction(normals, pose[2]),
        np.log1p(near),
        np.log1p(far),
        found.frontiers.extents[found.frontiers.target_labels[index]] / 3.0,
        found.frontiers.sizes[index] / 10.0,
        np.minimum(cost_map.clearance[tuple(cells.T)], 1.0),
        index == (-1 if found.current is None else found.current),
        np.log1p(near) - 0.2 * costs,
        np.arange(len(index)) / 10.0,
        _first_turns(found.travel.step, cells, pose[2], _FIRST_LEG_M / cost_map.resolution) / math.pi,
        *(_landmarks_left(belief, cost_map, views, lidar) if config.uncertainty else np.zeros((3, len(index)))),
        pieces / 3.0,
        *_in_tour(plan, cells),
    ])  # fmt: skip
    patches = np.zeros((len(index), 4, config.patch_cells, config.patch_cells), dtype=np.uint8)
    frame = np.array([*cost_map.origin, cost_map.resolution])
    for first, side_m in ((0, config.patch_m), (2, config.wide_m)):
        _cut_patches(cost_map.classes, frame, targets, normals, side_m, config.beyond_m, pose[:2], patches, first)
    places = np.vstack([np.asarray(cost_map.start)[None], cells])
    distances = between(cost_map, found.travel, places, searched=0)[1:, 1:] / 10.0
    known = float((cost_map.classes == FREE).sum()) * cost_map.resolution**2
    sigmas = _sigmas(np.asarray(belief.pose_cov)) if config.uncertainty else (0.0, 0.0)
    state = np.array([
        time_s / config.horizon_s,
        math.log1p(known) / 5.0,
        len(index) / config.most,
        *sigmas,
        len(index) / views_found,
        math.log1p(float(near.sum())) / 5.0,
        float(costs.min()) / 10.0,
    ])  # fmt: skip
    as_floats = [np.asarray(np.clip(a, -10.0, 10.0), dtype=np.float32) for a in (rows, distances, state)]
    return Choice(index, as_floats[0], patches, as_floats[1], as_floats[2])


def mirrored(choice: Choice) -> Choice:
    """Return the choice as it is seen in a mirror: left is right."""
    rows = choice.candidates.copy()
    rows[:, SIDEWAYS] *= -1.0
    return replace(choice, candidates=rows, patches=np.flip(choice.patches, axis=-2))


def _in_tour(plan: TourPlan, cells: Cells) -> tuple[Array, Array, Array]:
    """Return for each view point ``(m, 2)`` whether the tour begins there, when it comes by, and the loss else.

    Those that the tour was not planned over, the farthest, come last and cost most.
    """
    m, most = len(cells), float(plan.losses_m.max(initial=0.0))
    when, losses = np.full(m, len(plan.order) + 1.0), np.full(m, most)
    place = {(int(row), int(col)): i for i, (row, col) in enumerate(plan.cells)}
    position = {int(i): k for k, i in enumerate(plan.order)}
    for c in range(m):
        i = place.get((int(cells[c, 0]), int(cells[c, 1])))
        if i is not None:
            losses[c] = plan.losses_m[i]
            when[c] = position.get(i, len(plan.order))
    return (when == 0.0).astype(np.float64), when / 10.0, losses / _TOUR_LOSS_M


def _sigmas(cov: Array) -> tuple[float, float]:
    """Return log10 of the position's σ [m] and of the heading's [rad]."""
    position, heading = 0.5 * (cov[0, 0] + cov[1, 1]), cov[2, 2]
    return math.log10(math.sqrt(max(position, 0.0)) + 1e-4), math.log10(math.sqrt(max(heading, 0.0)) + 1e-5)


def _apart(found: Candidates, most: int) -> tuple[Indices, Indices, int]:
    """Return one candidate a view point, cheapest first, and the number of pieces that are seen from each.

    Of several at one view point it is the one that the robot is driving to, or the first. The last number
    returned is that of all view points, before the dearest are left out.
    """
    open_ = np.flatnonzero(np.isfinite(found.costs))
    by_cost = open_[np.lexsort((open_ != (-1 if found.current is None else found.current), found.costs[open_]))]
    _, first, pieces = np.unique(found.cells[by_cost], axis=0, return_index=True, return_counts=True)
    order = np.argsort(first)[:most]
    return by_cost[first[order]], pieces[order], len(first)


def _landmarks_left(
    belief: Belief, cost_map: CostMap, views: Array, lidar: LidarConfig
) -> tuple[Array, Array, Array]:
    """Return how many corners and walls are in sight from each place, and the position's σ that they would leave.

    The last as log10(σ / 1 m + 1e-4), each corner by itself: Σ 1 / (σ² + r²), r that of one sighting.
    """
    marks = marks_of(belief)
    if not len(marks.kinds):
        nothing = np.zeros(len(views))
        return nothing, nothing, nothing
    poses = np.column_stack([views, np.full(len(views), float(belief.pose[2]))])
    seen, cov = expected_sightings(
        cost_map, poses, marks.x[3:].reshape(-1, 2), marks.kinds, marks.ends, lidar=lidar, model=_SENSOR,
        most=len(marks.kinds),
    )  # fmt: skip
    n = len(belief.landmarks)
    known = 0.5 * np.trace(np.asarray(belief.landmark_cov), axis1=1, axis2=2)
    information = np.where(seen[:, :n], 1.0 / (known + cov[:, :n, 0] + 1e-12), 0.0).sum(axis=1)
    sigma = np.where(information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-12)), 1.0)
    corners, walls = seen[:, :n].sum(axis=1), seen[:, n:].sum(axis=1)
    return np.log1p(corners) / 3.0, np.log1p(walls) / 3.0, np.log10(sigma + 1e-4)


@njit(cache=True, nogil=True)
def _first_turns(step: NDArray[np.int8], cells: Cells, heading: float, leg: float) -> Array:
    """Return by how much the way to each cell turns off the heading at its beginning, 0 … π."""
    turns = np.zeros(len(cells))
    for i in range(len(cells)):
        row, col = cells[i]
        # To the start and count, then again as far as the first leg's end.
        length = 0
        while step[row, col] >= 0:
            row, col = cell_before(step, row, col)
            length += 1
        start_r, start_c = row, col
        row, col = cells[i]
        for _ in range(length - int(leg)):
            row, col = cell_before(step, row, col)
        if row == start_r and col == start_c:
            continue
        off = math.atan2(row - start_r, col - start_c) - heading
        turns[i] = abs(math.atan2(math.sin(off), math.cos(off)))
    return turns


def _direction(vectors: Array, heading: float) -> Array:
    """Return the directions ``(2, m)`` of vectors ``(m, 2)``: ahead and to the left, shorter than 1 near by."""
    length = np.maximum(np.hypot(*vectors.T), 0.3)
    c, s = math.cos(heading), math.sin(heading)
    return np.asarray(np.stack([vectors @ np.array([c, s]), vectors @ np.array([-s, c])]) / length)


@njit(cache=True, nogil=True, error_model="numpy")
def _cut_patches(
    classes: NDArray[np.int8], frame: Array, targets: Array, normals: Array, cell_m: float, beyond_m: float,
    robot: Array, out: Bytes, first: int,
) -> None:  # fmt: skip
    """Sample what is around each frontier, its normal along +x of the patch: nine points a cell.

    Free and occupied are written to two of the channels of ``out`` ``(n, channels, size, size)``.
    """
    rows, cols = classes.shape
    size = out.shape[2]
    for i in range(len(targets)):
        nx, ny = normals[i]
        if nx == 0.0 and ny == 0.0:
            nx, ny = targets[i] - robot
        norm = math.hypot(nx, ny)
        nx, ny = (nx / norm, ny / norm) if norm > 0.0 else (1.0, 0.0)
        for r in range(size):
            for c in range(size):
                free = occupied = 0
                for k in range(9):
                    along = beyond_m + (c + 0.5 + (k % 3 - 1) / 3.0 - 0.5 * size) * cell_m
                    across = (r + 0.5 + (k // 3 - 1) / 3.0 - 0.5 * size) * cell_m
                    x = targets[i, 0] + nx * along - ny * across
                    y = targets[i, 1] + ny * along + nx * across
                    row = math.floor((y - frame[1]) / frame[2])
                    col = math.floor((x - frame[0]) / frame[2])
                    if 0 <= row < rows and 0 <= col < cols:
                        free += classes[row, col] == FREE
                        occupied += classes[row, col] == OCCUPIED
                out[i, first, r, c] = free * 28
                out[i, first + 1, r, c] = min(occupied * 85, 255)
