"""Lessons of the end-to-end policy: what maps mean to a planner, and what its path follower would send.

The heuristic agents' machinery is the teacher, asked in whatever situation the student gets itself into (DAgger:
Ross, Gordon and Bagnell, AISTATS 2011). The student's map network learns prices and distances from their planning
grid and goals from the frontiers that they hold worth a visit; its control network learns what their path follower
would send on the way that the student itself has planned.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Agent
from agents.driving.control import ControlConfig, PathFollower
from agents.explorer import Candidates, Explorer
from agents.learned.drive_plan import distances, node_prices
from agents.ways.cost_map import CostMap, PlannerConfig, position_sigma, tight_clearance
from mecanum_env.config import RobotConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.observation import LOCAL_CELL_M, MAP_SIZE, map_frame
from slam import geometry
from slam.belief import Belief
from slam.grids.occupancy import FREE, UNKNOWN
from slam.types import Array, Floats

__all__ = ["LOG_PRICE", "NO_WAY", "FollowingTeacher", "map_lesson"]

LOG_PRICE = 70.0
"""A log price of 1 in the bytes that labels are kept in."""
NO_WAY = 6e4
"""Travel cost from which on a label says nothing."""
_NEAR_UNKNOWN, _UNKNOWN, _WALL = 3.0, 6.0, 30.0  # prices of a metre: what is not known yet may well be free
_RIM = 12  # cells of unknown around what is known

_ROWS, _COLS = np.meshgrid(np.arange(MAP_SIZE), np.arange(MAP_SIZE), indexing="ij")
_MIDDLE = 0.5 * MAP_SIZE - 0.5


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
        wanted = np.clip(follower.follow(observation, belief) / self._limits, -1.0, 1.0)
        return np.asarray(wanted, dtype=np.float32)


def map_lesson(teacher: Agent, env: ExploreEnv) -> dict[str, NDArray[Any]]:
    """Return the labels of both maps, by the teacher's planning grid and what it would go to.

    ``price`` (n, n) uint8 :data:`LOG_PRICE` × log price of a metre, of ``map_local``; ``travel`` (n, n) float16,
    cost of the way from the robot to each pixel of ``map_global`` [m]; ``goal_local`` and ``goal_global``, packed
    bits of the pixels that hold frontier worth a visit; ``pixel``, of ``map_global`` [m].
    """
    assert isinstance(teacher, Explorer)
    belief = env.belief
    found = teacher._candidates(belief)
    cost_map = found.cost_map
    prices = _prices(cost_map, env.config.robot, belief, teacher.config.planner)
    padded = np.pad(prices, _RIM, constant_values=_UNKNOWN)
    start = np.full(padded.shape, 1e6, np.float32)
    start[cost_map.start[0] + _RIM, cost_map.start[1] + _RIM] = 0.0
    travel = distances(node_prices(padded, cost_map.resolution), start)[0][_RIM:-_RIM, _RIM:-_RIM]
    x, y, theta = belief.pose
    body = np.stack([(_MIDDLE - _ROWS) * LOCAL_CELL_M, (_MIDDLE - _COLS) * LOCAL_CELL_M], axis=-1)
    local = _sample(prices, cost_map, body @ geometry.rotation(theta).T + [x, y], _UNKNOWN)
    centre_x, centre_y, half = map_frame(env.backend.grid)
    pixel = 2.0 * half / MAP_SIZE
    places = np.stack([centre_x + (_COLS - _MIDDLE) * pixel, centre_y + (_MIDDLE - _ROWS) * pixel], axis=-1)
    ways = np.minimum(_sample(travel, cost_map, places, np.inf), NO_WAY)
    goals = _goals(found)
    offsets = (goals - [x, y]) @ geometry.rotation(theta) / LOCAL_CELL_M
    # A planning cell covers more than one pixel where the map is turned.
    spread = np.array([(a, b) for a in (-0.35, 0.35) for b in (-0.35, 0.35)])
    return {
        "price": np.clip(np.round(np.log(local) * LOG_PRICE), 0, 255).astype(np.uint8),
        "travel": ways.astype(np.float16),
        "goal_local": _marked((_MIDDLE - offsets[:, None] + spread).reshape(-1, 2)),
        "goal_global": _marked(
            np.stack([_MIDDLE - (goals[:, 1] - centre_y) / pixel, _MIDDLE + (goals[:, 0] - centre_x) / pixel], 1)
        ),
        "pixel": np.float32(pixel),  # type: ignore[dict-item]
    }


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


def _marked(pixels: Array) -> NDArray[np.uint8]:
    """Return the packed bits of a map with these pixels ``(n, 2)``, rounded, set."""
    out = np.zeros((MAP_SIZE, MAP_SIZE), np.bool_)
    cells = np.round(pixels).astype(np.int64)
    cells = cells[((cells >= 0) & (cells < MAP_SIZE)).all(axis=1)]
    out[cells[:, 0], cells[:, 1]] = True
    return np.packbits(out, axis=-1)
