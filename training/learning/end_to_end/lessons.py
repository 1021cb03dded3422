"""Lessons of the end-to-end policy: what maps mean to a planner, and what its path follower would send.

The heuristic agents' machinery is the teacher, asked in whatever situation the student gets itself into (DAgger:
Ross, Gordon and Bagnell, AISTATS 2011). The student's map network learns prices and distances from their planning
grid and goals from the frontiers that they hold worth a visit; its control network learns what their path follower
would send on the way that the student itself has planned.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Agent
from agents.driving.control import ControlConfig, PathFollower
from agents.explorer import Candidates, Explorer
from agents.learned.drive_memory import CELL_M, CHANNELS, draw_memory
from agents.learned.drive_plan import distances, node_prices
from agents.ways.cost_map import CostMap, PlannerConfig, position_sigma, tight_clearance
from mecanum_env.config import RobotConfig
from mecanum_env.env import ExploreEnv
from slam import geometry
from slam.belief import Belief
from slam.grids.occupancy import FREE, UNKNOWN, OccupancyGrid
from slam.types import Array, Floats

__all__ = ["LOG_PRICE", "NO_WAY", "SIZE", "FollowingTeacher", "map_lessons"]

LOG_PRICE = 70.0
"""A log price of 1 in the bytes that labels are kept in."""
NO_WAY = 6e4
"""Travel cost from which on a label says nothing."""
_NEAR_UNKNOWN, _UNKNOWN, _WALL = 3.0, 6.0, 30.0  # prices of a metre: what is not known yet may well be free
_BACK_OFF_M_S = 0.15
SIZE = 64
"""Pixels a side of the part of the map that a lesson is on."""

_ROWS, _COLS = np.meshgrid(np.arange(SIZE), np.arange(SIZE), indexing="ij")


class FollowingTeacher:
    """Says which action a path follower would send along a given path, whoever drove so far."""

    def __init__(self, env: ExploreEnv) -> None:
        config = env.config
        robot = config.robot
        self._limits = np.array([robot.max_speed_m_s, robot.max_speed_m_s, robot.max_turn_rate_rad_s])
        self._step_s = config.step_s
        self._follower = PathFollower(ControlConfig(), robot=robot, lidar=config.lidar, step_s=config.step_s)

    def __call__(self, path: Array, executed: Floats, observation: dict[str, Any], belief: Belief) -> Floats:
        """Return the action ``(3,)``.

        Parameters
        ----------
        path : Array
            ``(n, 2)`` [m], ahead and to the left of the robot.
        executed : Array
            The action ``(3,)`` before this one, which it goes on from.
        """
        follower, pose = self._follower, np.asarray(belief.pose, dtype=np.float64)
        sent = np.asarray(executed) * self._limits
        follower._velocity = geometry.rotation(pose[2] - 0.5 * sent[2] * self._step_s) @ sent[:2]
        follower._turn = float(sent[2])
        follower.set_path(pose[:2] + path @ geometry.rotation(pose[2]).T, None)
        twist = follower.follow(observation, belief)
        if follower.blocked:
            twist = self._to_where_there_is_room(pose, observation, belief)
        return np.asarray(np.clip(twist / self._limits, -1.0, 1.0), dtype=np.float32)

    def _to_where_there_is_room(self, pose: Array, observation: dict[str, Any], belief: Belief) -> Array:
        """Return the twist ``(3,)`` that backs off, turning a little, as the heuristics do when stuck."""
        angles = np.arange(16) * (math.pi / 8.0)
        away = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        room = self._follower.room(belief, pose[:2] + 0.3 * away)
        return self._follower.drive(_BACK_OFF_M_S * away[int(np.argmax(room))], 0.4, observation, belief)


def map_lessons(teacher: Agent, env: ExploreEnv, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Return what to learn from two parts of the map, by the teacher's planning grid and what it would go to.

    One part is about the robot, the other anywhere beside the unknown. ``map`` (CHANNELS, n, n) uint8;
    ``price`` (n, n) uint8 :data:`LOG_PRICE` × log price of a metre; ``goal``, packed bits of the pixels that hold
    frontier worth a visit; ``start`` (2,) the pixel from which ``travel`` (n, n) float16 is the cost of the way
    within the part [m].
    """
    assert isinstance(teacher, Explorer)
    belief, grid = env.belief, env.belief.grid
    found = teacher._candidates(belief)
    prices = _prices(found.cost_map, env.config.robot, belief, teacher.config.planner)
    block = max(round(CELL_M / grid.resolution), 1)
    maps = draw_memory(grid, block)
    goals = _goals(found)
    lessons = []
    for middle in (belief.pose[:2], _anywhere(found, goals, rng)):
        centre = (middle - grid.origin) / CELL_M + rng.uniform(-16.0, 16.0, 2)
        corner = np.round(centre).astype(np.int64) - SIZE // 2
        places = np.asarray(grid.origin) + CELL_M * (np.stack([_COLS, _ROWS], axis=-1) + corner + 0.5)
        price = _sample(prices, found.cost_map, places, _UNKNOWN)
        lessons.append(
            {
                "map": _cut(maps, corner),
                "price": np.clip(np.round(np.log(price) * LOG_PRICE), 0, 255).astype(np.uint8),
                "goal": _marked(np.floor((goals - grid.origin) / CELL_M - corner)[:, ::-1]),
            }
            | _ways(price, middle, corner, grid)
        )
    return lessons


def _anywhere(found: Candidates, goals: Array, rng: np.random.Generator) -> Array:
    """Return a place (2,) at some frontier, rather one worth a visit."""
    points = goals if len(goals) and rng.random() < 0.7 else found.frontiers.points
    cells = np.argwhere(found.cost_map.weight > 0.0)
    if not len(points):
        points = found.cost_map.to_points(cells)
    return np.asarray(points[rng.integers(len(points))])


def _ways(price: Floats, middle: Array, corner: NDArray[np.int64], grid: OccupancyGrid) -> dict[str, Any]:
    """Return where ways within a part start, at the cheapest pixel near its ``middle``, and what they cost."""
    at = np.floor((middle - grid.origin) / CELL_M).astype(np.int64) - corner
    far = np.hypot(_COLS - at[0], _ROWS - at[1])
    start = np.unravel_index(int(np.argmin(price + 0.1 * far)), price.shape)
    ends = np.full(price.shape, 1e6, np.float32)
    ends[start] = 0.0
    travel = distances(node_prices(price, CELL_M), ends)[0]
    return {"start": np.array(start, np.int64), "travel": np.minimum(travel, NO_WAY).astype(np.float16)}


def _cut(maps: NDArray[np.uint8], corner: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return a part of the map; beyond its rim nothing is known."""
    out = np.zeros((CHANNELS, SIZE, SIZE), np.uint8)
    out[0] = 128
    rows, cols = maps.shape[1:]
    c0, r0 = np.clip(-corner, 0, SIZE)
    c1, r1 = np.clip(np.array([cols, rows]) - corner, 0, SIZE)
    if r1 > r0 and c1 > c0:
        out[:, r0:r1, c0:c1] = maps[:, corner[1] + r0 : corner[1] + r1, corner[0] + c0 : corner[0] + c1]
    return out


def _prices(cost_map: CostMap, robot: RobotConfig, belief: Belief, planner: PlannerConfig) -> Floats:
    """Return what a metre costs in each cell; nothing is forbidden, so that there is always a way down."""
    clear = cost_map.clearance >= tight_clearance(planner, robot, position_sigma(belief.pose_cov))
    prices = np.full(cost_map.classes.shape, _WALL, np.float32)
    prices[clear & (cost_map.classes == UNKNOWN)] = _UNKNOWN
    prices[clear & (cost_map.classes == FREE)] = _NEAR_UNKNOWN
    return np.asarray(np.where(cost_map.weight > 0.0, cost_map.weight, prices))


def _goals(found: Candidates) -> Array:
    """Return the frontier points ``(n, 2)`` of all clusters in which something is worth a visit."""
    frontiers = found.frontiers
    wanted = np.unique(frontiers.target_labels[np.isfinite(found.costs)])
    return np.asarray(frontiers.points[np.isin(frontiers.labels, wanted)])


def _sample(values: Floats, cost_map: CostMap, points: Array, outside: float) -> Floats:
    cells = np.floor((points - np.asarray(cost_map.origin)) / cost_map.resolution).astype(np.int64)[..., ::-1]
    inside = ((cells >= 0) & (cells < values.shape)).all(axis=-1)
    out = np.full(points.shape[:-1], outside, np.float32)
    out[inside] = values[cells[inside, 0], cells[inside, 1]]
    return out


def _marked(cells: Array) -> NDArray[np.uint8]:
    """Return the packed bits of a part of the map with these pixels ``(n, 2)``, row and column, set."""
    out = np.zeros((SIZE, SIZE), np.bool_)
    inside = cells[((cells >= 0) & (cells < SIZE)).all(axis=1)].astype(np.int64)
    out[inside[:, 0], inside[:, 1]] = True
    return np.packbits(out, axis=-1)
