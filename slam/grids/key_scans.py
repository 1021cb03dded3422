"""Key scans: what the map is redrawn from when the filter corrects the past.

A grid is drawn from poses that the filter later corrects. Each key scan therefore hangs on the landmarks that
were seen with it, points and walls: where those have moved, the scan's pose moves by as much as their covariance
with it, when it was taken, says (docs/reference/occupancy.md). Once a key scan would be drawn more than half a
cell from where it was, the map is redrawn from all of them. So a closed loop mends the map instead of doubling its
walls. What the landmarks of a scan leave open, as the way along a single wall, follows the scan before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.geometry import wrap, wrap_scalar
from slam.grids.occupancy import OccupancyGrid
from slam.settings import Config, Gap, Within
from slam.types import Array, Flags, Indices, Scan

__all__ = ["KeyScanConfig", "KeyScans", "largest_shift"]

_ANCHORS = 8  # landmarks that a key scan hangs on, at most

_RECENT = 100  # key scans, some 20 m of way

_ROWS = (
    "_poses", "_kept", "_latest", "_before", "_variances", "_anchor_ids", "_anchor_local", "_held", "_covs",
    "_steps", "_gains",
)  # fmt: skip

_PASSES = 5  # two, mostly: turns are small

_UNTOLD = 0.01  # share of a motion that is carried on from so far back that it may be of the last look

# Variances [m², rad²] of the way from the key scan before, 0.2 m or 0.25 rad of it.
_STEP_SHIFT, _STEP_TURN = 0.01**2, 0.0025**2


@dataclass(frozen=True, kw_only=True)
class KeyScanConfig(Config):
    """When a scan is kept, and when the map is redrawn."""

    spacing_m: Gap = 0.2
    spacing_rad: Gap = 0.25
    check_every: Annotated[int, Within("[1, 1000000000]")] = 20  # updates between two looks at the landmarks
    lever_m: Gap = 4.0  # distance at which a turn of a key scan counts as a shift [m]


class KeyScans:
    """The scans a map can be redrawn from, each with its pose and the landmarks it hangs on."""

    def __init__(self, config: KeyScanConfig | None = None) -> None:
        self.config = config or KeyScanConfig()
        self._scans: list[tuple[Scan, NDArray[np.int16]]] = []
        # Poses of the sensor: as last drawn, as believed when the scan was taken, as the landmarks had it lately …
        self._poses, self._kept, self._latest = np.zeros((64, 3)), np.zeros((64, 3)), np.zeros((64, 3))
        self._before = np.zeros((64, 3))  # … and that of the scan before when the scan was taken
        self._variances = np.zeros(64)  # [m²] of where the beams ended, when the scan was taken
        self._anchor_ids = np.full((64, _ANCHORS), -1, np.int64)
        self._anchor_local = np.zeros((64, _ANCHORS, 3))  # in that pose's frame: x, y, 0, or α, r, 1
        self._held = np.zeros((64, _ANCHORS), np.bool_)  # those that were in the map when gains were last reckoned
        self._covs = np.zeros((64, 3 + 2 * _ANCHORS, 3 + 2 * _ANCHORS))  # of pose and landmarks, in that frame
        self._steps = np.zeros(64)  # σ's of the way from the scan before, in those of a step
        self._gains = np.zeros((64, 3, 6 + 2 * _ANCHORS))  # K, G J and G of docs/reference/occupancy.md
        self._since_check = 0
        self._last = (0.0, 0.0, 0.0)
        self._cos_spacing = math.cos(min(self.config.spacing_rad, math.pi))

    def __len__(self) -> int:
        return len(self._scans)

    @property
    def poses(self) -> Array:
        """Sensor poses ``(n, 3)`` of the key scans as they were last drawn."""
        return self._poses[: len(self._scans)].copy()

    def wants(self, x: float, y: float, theta: float) -> bool:
        """Tell whether a scan from this sensor pose should be kept: it has moved on since the last one."""
        n = len(self._scans)
        if n == 0:
            return True
        last_x, last_y, last_theta = self._last
        config = self.config
        return (
            math.hypot(x - last_x, y - last_y) >= config.spacing_m
            or math.cos(theta - last_theta) <= self._cos_spacing
        )

    def old_variance(self, x: float, y: float, radius_m: float) -> float:
        """Return the variance [m²] of the least sure old key scan within a radius of a place; 0 without one.

        Old are all but the last hundred: beside those the robot knows where it is, unsure as both may be.
        """
        n = max(len(self._scans) - _RECENT, 0)
        near = np.hypot(self._poses[:n, 0] - x, self._poses[:n, 1] - y) <= radius_m
        return float(self._variances[:n][near].max(initial=0.0))

    def keep(
        self, sensor_pose: Array, scan: Scan, surface: NDArray[np.int16], ids: Indices, marks: Array,
        cov: Array, landmarks: Array | None = None, row_of_id: Indices | None = None, *,
        ahead_m: float = 0.0, variance: float = 0.0,
    ) -> None:  # fmt: skip
        """Keep a scan, and what was seen with it.

        ``ids`` are the landmarks; ``marks`` ``(k, 3)`` are x, y, 0 of a point as it is now, or α, r, 1 of a wall;
        ``cov`` ``(3 + 2k, 3 + 2k)`` is the covariance of the body's pose and theirs, the sensor being ``ahead_m``
        ahead of the body's centre. ``landmarks`` and ``row_of_id`` are all of them, as for
        :meth:`redraw_if_moved`. ``variance`` [m²] is that of where the beams ended.
        """
        n = len(self._scans)
        if n == len(self._poses):
            for name in _ROWS:
                setattr(self, name, np.concatenate([getattr(self, name), np.zeros_like(getattr(self, name))]))
        last_x, last_y, last_theta = self._last
        self._last = x, y, theta = float(sensor_pose[0]), float(sensor_pose[1]), float(sensor_pose[2])
        if n:
            if landmarks is not None and row_of_id is not None:
                self._follow(landmarks, row_of_id, _pinned(self._gains, n))
            self._before[n] = self._latest[n - 1]
            steps = max(
                math.hypot(x - last_x, y - last_y) / 0.2, abs(wrap_scalar(theta - last_theta)) / 0.25, 1.0
            )  # fmt: skip
        else:
            steps = math.inf  # nothing is known of a way from anywhere
        self._poses[n] = self._kept[n] = self._latest[n] = sensor_pose
        self._steps[n] = steps
        local, own_cov, held = self._anchor_local[n], self._covs[n], self._held[n]
        _hang(sensor_pose, ids, marks, cov, ahead_m, self._anchor_ids[n], local, own_cov)
        np.greater_equal(self._anchor_ids[n], 0, out=held)
        _weigh(held, local, own_cov, steps, self._gains[n])
        self._variances[n] = variance
        self._scans.append((scan.kept(), surface.copy()))

    def due(self) -> bool:
        """Count an update; tell whether it is time to look at the landmarks again."""
        self._since_check += 1
        if self._since_check < self.config.check_every:
            return False
        # A redraw costs as much as there are key scans: the longer the journey, the rarer the look.
        n = len(self._scans)
        return self._since_check >= n // 8 and n >= 2

    def redraw_if_moved(
        self, grid: OccupancyGrid, landmarks: Array, row_of_id: Indices, others: Sequence[KeyScans] = ()
    ) -> bool:
        """Redraw ``grid`` if a landmark's correction moved a key scan by more than half a cell; tell whether.

        ``landmarks`` ``(n, 2)`` are the current estimates, of points x, y and of walls α, r; ``row_of_id`` maps a
        landmark's id to its row, or -1. ``others`` are key scans of other robots, drawn into the same grid.
        """
        everyone = (self, *others)
        corrected = [k._corrected(landmarks, row_of_id) for k in everyone]
        if max(largest for _, largest in corrected) <= 0.5 * grid.resolution:
            return False
        for scans, (poses, _) in zip(everyone, corrected, strict=True):
            scans._poses[: len(poses)] = poses
            if len(poses):
                scans._last = tuple(poses[-1].tolist())
        grid.redraw(np.concatenate([poses for poses, _ in corrected]), [s for k in everyone for s in k._scans])
        return True

    def _corrected(self, landmarks: Array, row_of_id: Indices) -> tuple[Array, float]:
        """Return where the key scans ``(n, 3)`` should be drawn, and by how much [m] one moved most."""
        self._since_check = 0
        largest = self._follow(landmarks, row_of_id, 0)
        return self._latest[: len(self._scans)].copy(), largest

    def _follow(self, landmarks: Array, row_of_id: Indices, first: int) -> float:
        """Have the key scans from ``first`` on go with their landmarks; return the largest shift [m]."""
        return _follow(
            first, len(self._scans), self._kept, self._before, self._poses, self._anchor_ids, self._anchor_local,
            self._held, self._covs, self._steps, self._gains, landmarks, row_of_id, self.config.lever_m,
            self._latest,
        )  # fmt: skip

    def put_back(self, grid: OccupancyGrid, poses: Array) -> None:
        """Keep only as many scans as there are sensor poses ``(n, 3)``, the first ones, and redraw ``grid``."""
        n = len(poses)
        del self._scans[n:]
        self._poses[:n] = self._latest[:n] = poses
        self._last = tuple(poses[-1].tolist()) if n else (0.0, 0.0, 0.0)
        grid.redraw(poses, self._scans)


def largest_shift(poses: Array, drawn: Array, lever_m: float) -> float:
    """Return how far [m] the farthest of poses ``(n, 3)`` is from where it was drawn; 0 where there are none."""
    off = np.hypot(*(poses - drawn)[:, :2].T) + np.abs(wrap(poses[:, 2] - drawn[:, 2])) * lever_m
    return float(off.max(initial=0.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _hang(
    sensor_pose: Array, ids: Indices, marks: Array, cov: Array, ahead_m: float,
    anchor_ids: Indices, anchor_local: Array, p: Array,
) -> None:  # fmt: skip
    """Write a key scan's landmarks in its pose's frame, and the covariance of it and them there."""
    count = min(ids.shape[0], anchor_ids.shape[0])
    n = 3 + 2 * count
    x, y, theta = sensor_pose
    c, s = math.cos(theta), math.sin(theta)
    for i in range(n):
        for j in range(n):
            p[i, j] = cov[i, j]
    _turn(p, n, 0, c, s)
    _add(p, n, 1, 2, ahead_m)
    anchor_ids[:] = -1
    for k in range(count):
        anchor_ids[k] = ids[k]
        u, v, wall = marks[k]
        if wall:
            nx, ny = math.cos(u), math.sin(u)
            local_u, local_v = u - theta, v - x * nx - y * ny
            _add(p, n, 4 + 2 * k, 3 + 2 * k, x * ny - y * nx)
        else:
            local_u, local_v = c * (u - x) + s * (v - y), c * (v - y) - s * (u - x)
            _turn(p, n, 3 + 2 * k, c, s)
        anchor_local[k, 0], anchor_local[k, 1], anchor_local[k, 2] = local_u, local_v, wall


@njit(cache=True, nogil=True, error_model="numpy")
def _weigh(held: Flags, local: Array, cov: Array, steps: float, gains: Array) -> None:
    """Write how far a key scan goes with the scan before and with those of its landmarks that there are."""
    of = np.empty(held.shape[0], np.int64)
    count = 0
    for a in range(held.shape[0]):
        if held[a]:
            of[count] = a
            count += 1
    n = 3 + 2 * count
    p = np.empty((n + 3, n + 3))
    for i in range(n):
        row = i if i < 3 else 3 + 2 * of[(i - 3) // 2] + (i - 3) % 2
        for j in range(n):
            p[i, j] = cov[row, j if j < 3 else 3 + 2 * of[(j - 3) // 2] + (j - 3) % 2]
    # One more: the scan before goes where this one goes, but for the way from it.
    for i in range(n, n + 3):
        for j in range(n):
            p[i, j] = p[j, i] = p[i - n, j] if steps < math.inf else 0.0
        for j in range(n, n + 3):
            p[i, j] = p[i - n, j - n] if steps < math.inf else 0.0
        p[i, i] += steps * steps * (_STEP_TURN if i == n + 2 else _STEP_SHIFT)
    _sweep(p)
    gains[:] = 0.0
    for i in range(3):
        for j in range(3):
            gains[i, j] = p[i, n + j]
        for k in range(count):
            a, by_u, by_v = of[k], p[i, 3 + 2 * k], p[i, 4 + 2 * k]
            gains[i, 6 + 2 * a], gains[i, 7 + 2 * a] = by_u, by_v
            # How the landmark goes with a motion of the frame.
            if local[a, 2]:
                gains[i, 3] += math.cos(local[a, 0]) * by_v
                gains[i, 4] += math.sin(local[a, 0]) * by_v
                gains[i, 5] += by_u
            else:
                gains[i, 3] += by_u
                gains[i, 4] += by_v
                gains[i, 5] += local[a, 0] * by_v - local[a, 1] * by_u


@njit(nogil=True, error_model="numpy", forceinline=True)
def _turn(p: Array, n: int, i: int, c: float, s: float) -> None:
    """Turn the vector of states i and i + 1, of n of a covariance, into a frame turned by (cos, sin)."""
    for j in range(n):
        p[i, j], p[i + 1, j] = c * p[i, j] + s * p[i + 1, j], c * p[i + 1, j] - s * p[i, j]
    for j in range(n):
        p[j, i], p[j, i + 1] = c * p[j, i] + s * p[j, i + 1], c * p[j, i + 1] - s * p[j, i]


@njit(nogil=True, error_model="numpy", forceinline=True)
def _add(p: Array, n: int, i: int, j: int, times: float) -> None:
    """Add a multiple of state j, of n of a covariance, to state i."""
    for k in range(n):
        p[i, k] += times * p[j, k]
    for k in range(n):
        p[k, i] += times * p[k, j]


@njit(nogil=True, error_model="numpy", forceinline=True)
def _sweep(p: Array) -> None:
    """Turn the first three rows of a covariance of (a, b) into those of P_aa − P_ab P_bb⁻¹ P_ba and P_ab P_bb⁻¹.

    By the sweep operator (Beaton 1964), one state of b after the other.
    """
    n = p.shape[0]
    for j in range(3, n):
        pivot = p[j, j]
        if not 1e-15 < pivot < math.inf:  # the others say all of it, or it says nothing
            for i in range(n):
                p[i, j] = p[j, i] = 0.0
            continue
        for i in range(n):
            if i < 3 or i > j:
                share = p[i, j] / pivot
                for q in range(n):
                    p[i, q] -= share * p[j, q]
                p[i, j] = share


@njit(cache=True, nogil=True, error_model="numpy")
def _pinned(gains: Array, n: int) -> int:
    """Return the scan from which on all must follow their landmarks for the last of n to be where they have it."""
    carried = 1.0
    while n > 0 and carried > _UNTOLD:
        n -= 1
        largest = 0.0
        for i in range(3):
            largest = max(largest, abs(gains[n, i, 0]) + abs(gains[n, i, 1]) + abs(gains[n, i, 2]))
        carried *= min(largest, 1.0)
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(
    first: int, n: int, kept: Array, before: Array, drawn: Array, ids: Indices, local: Array, held: Flags,
    covs: Array, steps: Array, gains: Array, landmarks: Array, row_of_id: Indices, lever: float, out: Array,
) -> float:  # fmt: skip
    """Write key scans' poses as their landmarks now have them; return the largest shift [m] from where one is."""
    # Of those that are walls; for a few scans not worth while.
    normals = np.empty((landmarks.shape[0] if first == 0 else 0, 2))
    for i in range(normals.shape[0]):
        normals[i, 0], normals[i, 1] = math.cos(landmarks[i, 0]), math.sin(landmarks[i, 0])
    largest = 0.0
    going = np.zeros(3)  # how the scan before has moved since, as the k-th one's own frame has it, and the k-th
    motion = np.zeros(3)
    for k in range(first, n):
        others = False  # landmarks than last time: some were dropped, or are there again
        for a in range(ids.shape[1]):
            there = ids[k, a] >= 0 and row_of_id[ids[k, a]] >= 0
            if there != held[k, a]:
                held[k, a], others = there, True
        if others:
            _weigh(held[k], local[k], covs[k], steps[k], gains[k])
        x, y, theta = kept[k]
        c, s = math.cos(theta), math.sin(theta)
        if k:
            turn = wrap_scalar(out[k - 1, 2] - before[k, 2])
            ct, st = math.cos(turn), math.sin(turn)
            dx, dy = x - before[k, 0], y - before[k, 1]
            dx, dy = out[k - 1, 0] + ct * dx - st * dy - x, out[k - 1, 1] + st * dx + ct * dy - y
            going[0], going[1], going[2] = c * dx + s * dy, c * dy - s * dx, turn
        for i in range(3):
            motion[i] = going[i]
        for _ in range(_PASSES):
            ahead, left, turn = _moved(
                kept[k], going, motion, ids[k], held[k], local[k], gains[k], landmarks, normals, row_of_id
            )  # fmt: skip
            off = abs(ahead - motion[0]) + abs(left - motion[1]) + abs(turn - motion[2])
            motion[0], motion[1], motion[2] = ahead, left, turn
            if off < 1e-3:
                break
        out[k, 0], out[k, 1] = x + c * motion[0] - s * motion[1], y + s * motion[0] + c * motion[1]
        out[k, 2] = wrap_scalar(theta + motion[2])
        shift = math.hypot(out[k, 0] - drawn[k, 0], out[k, 1] - drawn[k, 1])
        largest = max(largest, shift + abs(wrap_scalar(out[k, 2] - drawn[k, 2])) * lever)
    return largest


@njit(nogil=True, error_model="numpy", forceinline=True)
def _moved(
    kept: Array, going: Array, motion: Array, ids: Indices, held: Flags, local: Array,
    gain: Array, landmarks: Array, normals: Array, row_of_id: Indices,
) -> tuple[float, float, float]:  # fmt: skip
    """Return how a key scan moves, linearised about a motion of it."""
    c, s = math.cos(kept[2]), math.sin(kept[2])
    x, y = kept[0] + c * motion[0] - s * motion[1], kept[1] + s * motion[0] + c * motion[1]
    theta, ct, st = kept[2] + motion[2], math.cos(motion[2]), math.sin(motion[2])
    c, s = math.cos(theta), math.sin(theta)
    ahead = left = turn = 0.0
    for a in range(ids.shape[0]):
        if not held[a]:
            continue
        row = row_of_id[ids[a]]
        u, v = landmarks[row, 0], landmarks[row, 1]
        if local[a, 2]:
            nx, ny = (normals[row, 0], normals[row, 1]) if normals.shape[0] else (math.cos(u), math.sin(u))
            du, dv = wrap_scalar(u - theta - local[a, 0]), v - nx * x - ny * y
            if abs(du) > 0.5 * math.pi:  # the wall passed the map's origin: the other normal
                du, dv = wrap_scalar(du + math.pi), -dv
            dv -= local[a, 1]
        else:
            du, dv = c * (u - x) + s * (v - y) - local[a, 0], c * (v - y) - s * (u - x) - local[a, 1]
        i = 6 + 2 * a
        ahead += gain[0, i] * du + gain[0, i + 1] * dv
        left += gain[1, i] * du + gain[1, i + 1] * dv
        turn += gain[2, i] * du + gain[2, i + 1] * dv
    ahead, left = ct * ahead - st * left, st * ahead + ct * left  # so far in the moved frame
    for i in range(3):
        ahead += gain[0, i] * going[i] + gain[0, 3 + i] * motion[i]
        left += gain[1, i] * going[i] + gain[1, 3 + i] * motion[i]
        turn += gain[2, i] * going[i] + gain[2, 3 + i] * motion[i]
    return ahead, left, turn
