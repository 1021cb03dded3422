"""What the agents' driver makes of a path over the true map, step by step and without a world."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.driving.control import ControlConfig, PathFollower
from agents.driving.follow import Motors, Pace, aim, send
from agents.driving.safety import Guard, LocalMap
from agents.ways.cost_map import clearance
from mecanum_env.config import LidarConfig, RobotConfig
from slam.types import Array, Cells
from training.truth.places import true_grid
from training.truth.search import MOST_STOPS, moved
from training.truth.sights import Sights, look

__all__ = ["Rehearsal"]

_STEPS = 6000  # of a drive, at most
_STUCK = 20  # steps that it is blocked for
_SIGMA_GAP_M = 0.005  # what the driver keeps more from walls for its position's doubt, typically
_LACKING_S = 800.0  # what all of the map unseen counts as
_HOT_S, _COLD_S = 1.0, 0.05  # longer that a drive may well be to be taken, at first and in the end


class Rehearsal(PathFollower):
    """Follows paths as :class:`PathFollower` does, where the map is true and wheels do as they are told."""

    def __init__(
        self, control: ControlConfig, sights: Sights, *, robot: RobotConfig, lidar: LidarConfig, step_s: float
    ) -> None:
        super().__init__(control, robot=robot, lidar=lidar, step_s=step_s)
        grid = true_grid(sights.ground)
        self._near = LocalMap(clearance(grid.log_odds, grid.resolution), np.array(grid.origin), grid.resolution)
        self._sights = sights

    def poses(self, path: Array) -> Array:
        """Return where the robot is after each step ``(n, 3)``, the start first, until the path's end."""
        self.set_path(path, None)
        gap = self.config.map_gap_m + _SIGMA_GAP_M
        turning_room = self._robot.circumscribed_radius_m + gap
        return np.asarray(_drive(
            self._path, self._arc, self._near, gap, turning_room, self._pace, self._motors, self._guard,
            self._robot.motor_lag_s,
        ))  # fmt: skip

    def seen(self, poses: Array) -> Array:
        """Return the share of the map that has been seen at each of poses ``(n, 3)``, driven in turn."""
        sights, ahead = self._sights, np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
        cells = sights.map.to_cells(poses[:, :2] + self._lidar.offset_m * ahead) @ np.array([sights.board.cols, 1])
        return _seen(sights.eye_of[cells], sights.board.views) / sights.board.counted

    def value(self, order: Cells, share: float) -> float:
        """Return how long [s] it takes past the stops ``(n,)`` until a share of the map is seen."""
        poses = self.poses(self._sights.path(order))
        seen = self.seen(poses)
        if seen[-1] >= share:
            return self._step_s * int(np.argmax(seen >= share))
        return self._step_s * len(poses) + _LACKING_S * (share - float(seen[-1]))

    def refined(self, order: Cells, *, share: float, tries: int, rng: np.random.Generator) -> tuple[Cells, float]:
        """Return the best stops ``(n,)`` found around an order by annealing, and their :meth:`value`."""
        now, new = np.zeros(MOST_STOPS, dtype=np.int64), np.zeros(MOST_STOPS, dtype=np.int64)
        n = len(order)
        now[:n] = order
        value = self.value(order, share)
        best, lowest = order, value
        for t in range(tries):
            heat = _HOT_S * (_COLD_S / _HOT_S) ** (t / tries)
            m, _ = moved(self._sights.board, now, n, rng, new)
            found = self.value(new[:m], share)
            if found <= value or rng.random() < math.exp((value - found) / heat):
                now[:], n, value = new, m, found
                if value < lowest:
                    best, lowest = now[:n].copy(), value
        return best, lowest


@njit(cache=True, nogil=True)
def _seen(looked: NDArray[np.int32], views: NDArray[np.uint64]) -> Cells:
    """Return how many cells have been seen after each of so many looks ``(n,)``, −1 for none."""
    seen, out = np.zeros(views.shape[1], dtype=np.uint64), np.empty(len(looked), dtype=np.int64)
    count, last = 0, -1
    for k in range(len(looked)):
        if looked[k] >= 0 and looked[k] != last:
            last = looked[k]
            count += look(views, last, seen)
        out[k] = count
    return out


@njit(cache=True, nogil=True)
def _drive(
    path: Array, arc: Array, near: LocalMap, gap: float, turning_room: float, pace: Pace, motors: Motors,
    guard: Guard, lag_s: float,
) -> Array:  # fmt: skip
    poses = np.zeros((_STEPS, 3))
    pose, velocity, twist = np.zeros(3), np.zeros(2), np.zeros(3)
    hits, sides, floors = np.zeros((0, 2)), np.zeros((0, 3)), np.full(2, -np.inf)
    index, turn, blocked_for, n, dt = 0, 0.0, 0, 1, motors.step_s
    # A twist that is sent is reached as 1 − e^(−t / lag).
    left = math.exp(-dt / lag_s) if lag_s > 0.0 else 0.0
    left_in_mean = lag_s / dt * (1.0 - left)
    while n < _STEPS and blocked_for < _STUCK:
        speed = math.hypot(velocity[0], velocity[1])
        wanted, wanted_turn, index, _, arrived = aim(
            pose, speed, path, arc, index, math.nan, near, turning_room, pace
        )
        if arrived:
            break
        sent, velocity, blocked = send(
            wanted, wanted_turn, velocity, turn, pose, near, gap, hits, sides, motors, guard, floors
        )
        turn = sent[2]
        blocked_for = blocked_for + 1 if blocked else 0
        mean = sent + left_in_mean * (twist - sent)
        twist = sent + left * (twist - sent)
        heading = pose[2] + 0.5 * dt * mean[2]
        c, s = math.cos(heading), math.sin(heading)
        pose[0] += dt * (c * mean[0] - s * mean[1])
        pose[1] += dt * (s * mean[0] + c * mean[1])
        pose[2] += dt * mean[2]
        poses[n] = pose
        n += 1
    return poses[:n]
