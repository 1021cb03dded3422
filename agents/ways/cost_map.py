"""What the belief's grid means to a body of this size: where its centre may be, and at what price.

Planning runs on a coarser grid (about 0.1 m) laid on a fixed lattice of the belief's frame, so that a grid that
grows does not shift it. A coarse cell is occupied if any of its fine cells is, and free only if most of them
are; distances to walls are taken from the fine grid, so that coarsening closes no door.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.ways.boxes import NOTHING, Box
from agents.ways.coarsening import FAR_M, Blocks, to_walls
from agents.ways.keeping import KeptBlocks
from mecanum_env.config import RobotConfig
from slam.belief import Belief
from slam.grids.occupancy import CLASS_OF, FREE, OCCUPIED, UNKNOWN
from slam.settings import Config, Gap, NotNegative, Within
from slam.types import Array, Bytes, Cells, Flags, Floats, Indices

__all__ = [
    "CostMap", "CostMaps", "PlannerConfig", "belief_classes", "build", "clearance", "kind_at", "position_sigma",
]  # fmt: skip

_ALL = slice(None)
_OLD_S = 5.0  # what is older says no longer where a robot is in the way


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(Config):
    """How near to walls the robot's centre may pass, and what nearness costs.

    Clearance is the distance from the robot's centre to the nearest occupied cell's edge. Above the comfortable
    one the robot may turn as it likes; below it, down to the tight one, only while its long side lies along the
    path, which the follower sees to.
    """

    resolution_m: Annotated[float, Within("[0.02, 1]")] = 0.1  # of the planning grid; made finer for a small robot
    # Comfortable: circumscribed radius + margin + 2σ of the position, capped.
    margin_m: Annotated[float, Within("[0, 10]")] = 0.05
    tight_margin_m: Annotated[float, Within("[0, 10]")] = 0.07  # tight: inscribed radius + this + the same
    # Far from the start σ is large, and the walls nearby are no less certain.
    max_sigma_margin_m: Annotated[float, Within("[0, 10]")] = 0.05
    unknown_margin_m: Annotated[float, Within("[0, 10]")] = 0.02  # from what is not known: inscribed radius + this
    # Clearance beyond the comfortable one from which nearness costs nothing.
    preferred_m: Annotated[float, Within("[0.001, 10]")] = 0.2
    near_cost: NotNegative = 1.0  # added to the price of a metre at the comfortable clearance
    tight_cost: NotNegative = 3.0  # added again at the tight clearance
    path_spacing_m: Annotated[float, Within("[0.01, 1000]")] = 0.1
    # Added to the price of a metre where another robot is nearer than would do to pass …
    robot_cost: NotNegative = 6.0
    robot_margin_m: Annotated[float, Within("[0, 10]")] = 0.1  # … which is both bodies' radii and this …
    robots_within_m: Gap = 3.0  # … if it is no farther than this: what is farther off will have moved on


@dataclass(frozen=True, eq=False)
class CostMap:
    """The planning grid. Row = y, column = x; its outermost ring is unknown, so that no walk leaves it."""

    classes: NDArray[np.int8]  # (rows, cols) UNKNOWN, FREE or OCCUPIED
    clearance: Floats  # (rows, cols) [m] from the cell's centre to the nearest occupied edge
    weight: Floats  # (rows, cols) price of a metre here, ≥ 1; 0 where the centre may not be
    resolution: float  # [m]
    origin: tuple[float, float]  # lower-left corner of cell (0, 0) in the belief's frame [m]
    start: tuple[int, int]  # the robot's cell
    suspect: Flags  # (rows, cols) where something was hit that is not settled to be a wall
    plain: Floats  # (rows, cols) the weight as it is for whatever robot: wherever they all stand

    def to_points(self, cells: Cells | Array) -> Array:
        """Return the centres ``(n, 2)`` [m] of cells ``(n, 2)`` (row, column)."""
        cells = np.asarray(cells, dtype=np.float64)
        return np.asarray((cells[:, ::-1] + 0.5) * self.resolution + np.asarray(self.origin))

    def to_cells(self, points: Array) -> Indices:
        """Return the cells ``(n, 2)`` (row, column) of points ``(n, 2)`` [m], held within the grid."""
        index = np.floor(self.in_cells(np.asarray(points))).astype(np.int64)
        limit = np.array(self.classes.shape, dtype=np.int64) - 1
        return np.asarray(np.clip(index[:, ::-1], 0, limit))

    def in_cells(self, points: Array) -> Array:
        """Return points ``(n, 2)`` [m] as x, y in cells from the grid's corner."""
        return np.asarray((points - np.asarray(self.origin)) / self.resolution)


@njit(cache=True, nogil=True)
def kind_at(classes: NDArray[np.int8], row: int, col: int) -> int:
    """Return a cell's class; beyond the grid nothing is known."""
    if row < 0 or col < 0 or row >= classes.shape[0] or col >= classes.shape[1]:
        return UNKNOWN
    return int(classes[row, col])


def belief_classes(belief: Belief, rows: slice = _ALL, cols: slice = _ALL) -> NDArray[np.int8]:
    """Return the grid's classes, all or a window, with what the robot's body has passed over taken for free."""
    log_odds = belief.grid.log_odds[rows, cols]
    classes = np.empty(log_odds.shape, dtype=np.int8)
    _classify(log_odds, belief.grid.visited[rows, cols], CLASS_OF, classes)
    return classes


def clearance(log_odds: NDArray[np.int8], resolution: float) -> Floats:
    """Return each cell's distance [m] ``(rows, cols)`` from its centre to the nearest occupied cell's edge."""
    distance = to_walls(log_odds)
    # Half a cell: from the occupied cell's centre to its edge.
    distance -= np.float32(0.5)
    distance *= np.float32(resolution)
    return np.minimum(distance, np.float32(FAR_M), out=distance)


def build(belief: Belief, config: PlannerConfig, robot: RobotConfig) -> CostMap:
    """Return the planning grid of a belief for a body of this size, made from nothing."""
    return CostMaps(config, robot).of(belief)


class CostMaps:
    """Planning grids of one belief after the other: each costs as much as was drawn since the last."""

    def __init__(self, config: PlannerConfig, robot: RobotConfig) -> None:
        self._config, self._robot = config, robot
        self._kept: KeptBlocks | None = None
        self._box, self._levels = NOTHING, (0.0, 0.0, 0.0)  # of the weights
        self._weight: Floats = np.zeros((0, 0), dtype=np.float32)
        self._passing: list[Box] = []  # where the robot was let out of where it stood, and others made it dearer

    def of(self, belief: Belief, sigma_m: float | None = None) -> CostMap:
        """Return the planning grid of a belief; its arrays are written into when the next is asked for.

        The position counts as known to ``sigma_m`` where that is given, else as the belief says.
        """
        config, robot, grid = self._config, self._robot, belief.grid
        wanted = min(config.resolution_m, robot.circumscribed_radius_m / 3.0)
        factor = max(1, round(wanted / grid.resolution))
        resolution = factor * grid.resolution
        if self._kept is None or self._kept.factor != factor:
            self._kept = KeptBlocks(factor)
        here = np.clip(grid.to_cells(np.asarray(belief.pose)[None, :2])[0], 0, np.array(grid.shape) - 1)
        changed = self._kept.follow(grid, (int(here[0]), int(here[1])))
        blocks = self._kept.blocks
        # Blocks lie on the lattice of the frame, not of the grid's present corner.
        lattice = zip(grid.origin, grid.lattice_origin[::-1], self._kept.corner[::-1], strict=True)
        left, low = (
            begin + (at - first) * grid.resolution - (at % factor + factor) * grid.resolution
            for begin, first, at in lattice
        )
        x, y = float(belief.pose[0]), float(belief.pose[1])
        row = min(max(int((y - low) // resolution), 1), blocks.classes.shape[0] - 2)
        col = min(max(int((x - left) // resolution), 1), blocks.classes.shape[1] - 2)
        sigma_m = position_sigma(belief.pose_cov) if sigma_m is None else sigma_m
        weight = self._weigh(blocks, changed, resolution, sigma_m)
        plain = weight.copy() if belief.teammates else weight
        self._passing = self._beside_others(belief, (left, low), resolution, weight)
        # Wherever the robot stands, it is allowed to stand, and to leave.
        reach = (robot.circumscribed_radius_m + 2.0 * resolution) / resolution
        highest = 2.0 * (1.0 + config.near_cost + config.tight_cost)
        _free_start(
            blocks.classes, blocks.clearance, weight, row, col, reach, robot.circumscribed_radius_m / resolution,
            highest,
        )  # fmt: skip
        self._passing.append(Box(row, col, row + 1, col + 1).grown(math.ceil(reach)))
        return CostMap(
            blocks.classes, blocks.clearance, weight, resolution, (left, low), (row, col), blocks.suspect, plain
        )

    def _beside_others(
        self, belief: Belief, corner: tuple[float, float], resolution: float, weight: Floats
    ) -> list[Box]:
        """Make ways dearer where they lead through other robots; return the boxes of cells in which they do."""
        config, robot = self._config, self._robot
        boxes = []
        for mate in belief.teammates:
            x, y = (float(v) for v in mate.pose[:2])
            away = math.hypot(x - float(belief.pose[0]), y - float(belief.pose[1]))
            if away > config.robots_within_m or mate.age_s > _OLD_S:
                continue
            bodies_m = robot.inscribed_radius_m + robot.circumscribed_radius_m  # a team's robots are alike
            reach = (bodies_m + config.robot_margin_m) / resolution
            at = (y - corner[1]) / resolution, (x - corner[0]) / resolution
            row, col = math.floor(at[0]), math.floor(at[1])
            box = Box(row, col, row + 1, col + 1).grown(math.ceil(reach)).within(Box(0, 0, *weight.shape))
            if not box.empty:
                rows, cols = np.ogrid[box.row0 : box.row1, box.col0 : box.col1]
                near = np.hypot(rows + 0.5 - at[0], cols + 0.5 - at[1]) <= reach
                part = weight[box.slices]
                part[near & (part > 0.0)] += np.float32(config.robot_cost)
                boxes.append(box)
        return boxes

    def _weigh(self, blocks: Blocks, changed: list[Box], resolution: float, sigma_m: float) -> Floats:
        """Return the price of a metre in each block, weighed anew where it may be another."""
        config, robot = self._config, self._robot
        assert self._kept is not None
        tight = tight_clearance(config, robot, sigma_m)
        comfortable = max(comfortable_clearance(config, robot, sigma_m), tight + 1e-3)
        levels = tight, comfortable, comfortable + config.preferred_m
        near = (robot.inscribed_radius_m + config.unknown_margin_m) / resolution + 0.5  # unknown, in blocks
        inside = Box(0, 0, *blocks.classes.shape).grown(-1)
        if self._kept.box != self._box or levels != self._levels:
            self._weight = np.zeros(blocks.classes.shape, dtype=np.float32)
            parts = [inside]
        else:
            parts = [part.grown(math.ceil(near)) for part in changed] + self._passing
        self._box, self._levels = self._kept.box, levels
        for part in parts:
            part = part.within(inside)
            if part.empty:  # of the outermost ring alone, where another robot was beyond the edge
                continue
            _weigh_cells(
                blocks.classes, blocks.clearance, _near_unknown(blocks.classes, part, near), part, levels,
                config.near_cost, config.tight_cost, self._weight,
            )  # fmt: skip
        return self._weight


def comfortable_clearance(config: PlannerConfig, robot: RobotConfig, sigma_m: float) -> float:
    """Return the clearance [m] at which the robot may turn in place, for a position known to ``sigma_m``."""
    return robot.circumscribed_radius_m + config.margin_m + min(2.0 * sigma_m, config.max_sigma_margin_m)


def tight_clearance(config: PlannerConfig, robot: RobotConfig, sigma_m: float) -> float:
    """Return the clearance [m] that the robot needs while its long side lies along the path."""
    return robot.inscribed_radius_m + config.tight_margin_m + min(2.0 * sigma_m, config.max_sigma_margin_m)


def position_sigma(pose_cov: Array) -> float:
    """Largest standard deviation of the position [m]."""
    block = np.asarray(pose_cov)[:2, :2]
    mean = 0.5 * (block[0, 0] + block[1, 1])
    spread = math.hypot(0.5 * (block[0, 0] - block[1, 1]), block[0, 1])
    return math.sqrt(max(float(mean + spread), 0.0))


def _near_unknown(classes: NDArray[np.int8], part: Box, reach: float) -> Bytes:
    """Return, not 0, the cells of a part that are nearer than ``reach`` cells to an unknown one."""
    span = math.ceil(reach)
    apart = np.ones((2 * span + 1, 2 * span + 1), dtype=np.uint8)
    apart[span, span] = 0
    # A disc laid over each unknown cell: cheaper than the distance of every cell, of which none but this is asked.
    disc = (cv2.distanceTransform(apart, cv2.DIST_L2, cv2.DIST_MASK_3) < np.float64(reach)).astype(np.uint8)
    window = part.grown(span).within(Box(0, 0, *classes.shape))
    near = cv2.dilate((classes[window.slices] == UNKNOWN).view(np.uint8), disc)
    return np.ascontiguousarray(near[part.seen_from(window).slices], dtype=np.uint8)


@njit(cache=True, nogil=True)
def _classify(
    log_odds: NDArray[np.int8], visited: Bytes, table: NDArray[np.int8], classes: NDArray[np.int8]
) -> None:
    for row in range(classes.shape[0]):
        for col in range(classes.shape[1]):
            kind = table[np.uint8(log_odds[row, col])]
            classes[row, col] = FREE if kind == UNKNOWN and visited[row, col] != 0 else kind


@njit(cache=True, nogil=True)
def _weigh_cells(
    classes: NDArray[np.int8], wall: Floats, near_unknown: Bytes, part: tuple[int, int, int, int],
    levels: tuple[float, float, float], near_cost: float, tight_cost: float, weight: Floats,
) -> None:  # fmt: skip
    """Weigh a part of the cells; ``near_unknown`` is as large as that."""
    tight, comfortable, preferred = levels
    for row in range(part[0], part[2]):
        for col in range(part[1], part[3]):
            distance = wall[row, col]
            if classes[row, col] != FREE or distance < tight or near_unknown[row - part[0], col - part[1]] != 0:
                weight[row, col] = 0.0
            elif distance >= preferred:
                weight[row, col] = 1.0
            elif distance >= comfortable:
                share = (preferred - distance) / (preferred - comfortable)
                weight[row, col] = 1.0 + near_cost * share * share
            else:
                share = (comfortable - distance) / (comfortable - tight)
                weight[row, col] = 1.0 + near_cost + tight_cost * share


@njit(cache=True, nogil=True)
def _free_start(
    classes: NDArray[np.int8], wall: Floats, weight: Floats, row: int, col: int,
    reach: float, body: float, highest: float,
) -> None:  # fmt: skip
    """Let the robot out of where it stands: cells around it, never occupied ones, at the highest price."""
    here = wall[row, col]
    span = math.ceil(reach)
    for r in range(max(row - span, 1), min(row + span + 1, classes.shape[0] - 1)):
        for c in range(max(col - span, 1), min(col + span + 1, classes.shape[1] - 1)):
            away = math.hypot(r - row, c - col)
            if weight[r, c] > 0.0 or away > reach or classes[r, c] == OCCUPIED:
                continue
            # Beyond the body only what is known; and nowhere nearer to a wall than the robot is already.
            if (away <= body or classes[r, c] == FREE) and wall[r, c] >= here - 0.01:
                weight[r, c] = highest
    weight[row, col] = max(weight[row, col], 1.0)
