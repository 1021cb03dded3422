"""The end-to-end policy's network in NumPy: observation in, body twist out.

Convolutions turn either map into prices and goals; the planning layer turns these into a way; and the way, the
scan, the landmarks and the numbers go through a small network that says the twist. What trains it is in
``training/learning/end_to_end/networks.py``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.learned.drive_plan import descend, distances, node_prices
from agents.learned.layers import Layers
from slam.types import Array, Floats

__all__ = [
    "BEAMS", "LOG_PRICES", "NUMBERS", "RANGE_M", "SECTORS", "STEP_LENGTHS", "DriveNetwork", "Inputs", "Plan",
    "PlanSettings", "pixel_size", "sectors",
]  # fmt: skip

Bytes = NDArray[np.uint8]

SIZE = 64
CELL_M = 0.1  # of map_local
PATH_POINTS = 10
PATH_STEP_M = 0.2
STEP_LENGTHS = np.array([1.0, math.sqrt(2.0), 1.0, math.sqrt(2.0)], np.float32)[:, None, None]
"""Of the four steps that a pixel owns, in pixels."""
LOG_PRICES = (-0.5, 3.5)
"""Bounds of the log price of a metre on `map_global`."""
_PIXELS_M = np.array([0.05, 0.1, 0.2, 0.4, 0.8, 1.6])
_FAR = np.float32(1e6)
_MARGIN = 6
_HERE_M = 0.3  # nearer goals are none: from here the robot looks already
_RIM_M = 2.6  # square of the local map from which on the way goes on by the whole map


class PlanSettings(NamedTuple):
    """Numbers of the planning layer that are learned, or set, with the network."""

    goal_m: float = 3.0  # what a goal costs per nat of doubt [m]
    turn_m: float = 0.4  # what lies behind costs more by up to twice this [m]: no dithering between two ways


class Plan(NamedTuple):
    """What the planning layer says."""

    path: Array  # (n, 2) [m] forward, left of the robot, from the robot on
    cost: float  # of the way, its goal included [m]
    prices: Floats  # (PATH_POINTS,) log price of a metre at each of the resampled points
    points: Floats  # (PATH_POINTS, 2) the path resampled [m]
    length: float  # of the path within the local map [m]


@njit(cache=True, nogil=True)
def _there(ahead: float, left: float, pose: Floats, pixel: float) -> tuple[int, int]:
    """Return row and column on ``map_global`` of a place beside the robot [m]; they may lie beyond the map."""
    at_col, at_row = (pose[0] + 1.0) * 0.5 * SIZE, SIZE - (pose[1] + 1.0) * 0.5 * SIZE
    dx, dy = pose[2] * ahead - pose[3] * left, pose[3] * ahead + pose[2] * left
    return math.floor(at_row - dy / pixel), math.floor(at_col + dx / pixel)


@njit(cache=True, nogil=True)
def pixel_size(near: Bytes, far: Bytes, pose: Floats) -> float:
    """Return the side [m] of a pixel of ``map_global``: the one at which it agrees best with ``map_local``.

    The observation does not tell it, but shows the same place on two maps of which one has a known scale.
    """
    best, found = np.inf, 0.4
    for size in _PIXELS_M:
        apart = 0.0
        for i in range(1, SIZE, 3):
            for j in range(1, SIZE, 3):
                ahead, left = (0.5 * SIZE - 0.5 - i) * CELL_M, (0.5 * SIZE - 0.5 - j) * CELL_M
                row, col = _there(ahead, left, pose, size)
                known, probability = 0.0, 0.5
                if 0 <= row < SIZE and 0 <= col < SIZE and far[1, row, col] > 0:
                    known, probability = far[1, row, col] / 255.0, far[0, row, col] / 255.0
                apart += abs(near[1, i, j] / 255.0 - known) + 0.5 * abs(near[0, i, j] / 255.0 - probability)
        if apart < best:
            best, found = apart, size
    return found


@njit(cache=True, nogil=True)
def _ends(goal: Floats, far: Floats, pose: Floats, pixel: float, turn_m: float) -> Floats:
    """Return what ending at each local pixel costs ``(n, m)``: a goal there, or the way on from the rim."""
    out = goal.copy()
    for i in range(SIZE):
        for j in range(SIZE):
            ahead, left = (0.5 * SIZE - 0.5 - i) * CELL_M, (0.5 * SIZE - 0.5 - j) * CELL_M
            if max(abs(ahead), abs(left)) > _RIM_M:
                row, col = _there(ahead, left, pose, pixel)
                if 0 <= row < SIZE and 0 <= col < SIZE:
                    out[i, j] = min(out[i, j], far[row, col])
            away = math.hypot(ahead, left)
            out[i, j] = out[i, j] + turn_m * (1.0 - ahead / away) if away > _HERE_M else 1e6
    return out


def _used(known: Bytes) -> tuple[slice, slice]:
    """Return the rows and columns of a map that anything is known in, and a margin that convolutions look into."""
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not len(rows):
        return slice(0, SIZE), slice(0, SIZE)
    return (
        slice(max(int(rows[0]) - _MARGIN, 0), int(rows[-1]) + _MARGIN + 1),
        slice(max(int(cols[0]) - _MARGIN, 0), int(cols[-1]) + _MARGIN + 1),
    )


def _smooth(path: Array) -> Array:
    """Return the path from the robot on, its steps' corners taken off."""
    path = np.vstack([np.zeros(2), path[1:]])
    if len(path) < 3:
        return path if len(path) > 1 else np.zeros((2, 2))
    padded = np.vstack([np.repeat(path[:1], 3, axis=0), path, np.repeat(path[-1:], 3, axis=0)])
    kernel = np.full(7, 1.0 / 7.0)
    out = np.stack([np.convolve(padded[:, k], kernel, mode="valid") for k in (0, 1)], axis=1)
    out[0], out[-1] = path[0], path[-1]
    return np.asarray(out)


BEAMS, RANGE_M = 360, 8.0
"""The lidar that scans are taken with [beams, m]; the first beam looks backwards."""
SECTORS = 72
"""Directions that the scan is summed up in."""
NUMBERS = 3 * PATH_POINTS + 10
_NEAR_SHARE = 0.08  # of the scan's range: what is nearer than this matters
_LEAST = 1e-12  # below any variance that a belief has


def sectors(scan: Floats) -> Floats:
    """Return how near the nearest return in each direction is ``(…, SECTORS)``: 1 at the sensor, 0 far away."""
    nearest = np.asarray(scan, np.float32).reshape(*scan.shape[:-1], SECTORS, -1).min(axis=-1)
    return np.asarray(np.exp(nearest / np.float32(-_NEAR_SHARE)))


class Inputs(NamedTuple):
    """What the control network is given, scaled to about 1."""

    scan: Floats  # (SECTORS,)
    landmarks: Floats  # (n, 5) x, y, two variances' logarithms, whether there is one
    numbers: Floats  # (NUMBERS,) the way, and the other numbers of the observation


class DriveNetwork(Layers):
    """Observation in, twist out.

    Parameters
    ----------
    weights : mapping
        As for :class:`agents.learned.layers.Layers`.
    settings : PlanSettings
        Of the planning layer.
    uncertainty : bool
        Whether the belief's covariance and its landmarks are looked at; without, for an ablation.
    """

    def __init__(
        self, weights: Mapping[str, Floats], settings: PlanSettings | None = None, *, uncertainty: bool = True
    ) -> None:
        self._settings, self._uncertainty = settings or PlanSettings(), uncertainty
        super().__init__(weights)

    def plan(self, observation: Mapping[str, Any]) -> Plan:
        """Return the way that the planning layer finds on what the convolutions make of the maps."""
        near, far = self.of_map("local", observation["map_local"]), observation["map_global"]
        pose, turn_m = observation["pose"], self._settings.turn_m
        pixel = pixel_size(observation["map_local"], far, pose)
        used = _used(far[1])
        said = self.of_map("overview", far[:, used[0], used[1]])
        prices = np.float32(pixel) * STEP_LENGTHS * np.exp(np.clip(said[:4], *LOG_PRICES))
        onwards = np.full((SIZE, SIZE), _FAR)
        onwards[used] = distances(prices, self._doubt(said[4]))[0]
        ends = _ends(self._doubt(near[1]), onwards, pose, pixel, turn_m)
        price = np.clip(near[0], 0.0, 3.5)
        best, parent = distances(node_prices(np.exp(price), CELL_M), ends)
        start = min(((i, j) for i in (31, 32) for j in (31, 32)), key=lambda p: best[p])
        way = descend(parent, *start)
        path = _smooth(np.asarray((0.5 * SIZE - 0.5 - way) * CELL_M, dtype=np.float64))
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        at = np.minimum(np.arange(1, PATH_POINTS + 1) * PATH_STEP_M, arc[-1])
        points = np.stack([np.interp(at, arc, path[:, k]) for k in (0, 1)], axis=1)
        cells = np.clip(np.round(0.5 * SIZE - 0.5 - points / CELL_M).astype(np.int64), 0, SIZE - 1)
        along = price[cells[:, 0], cells[:, 1]]
        return Plan(path, float(best[start]), along, points.astype(np.float32), float(arc[-1]))

    def of_map(self, name: str, maps: Bytes) -> Floats:
        """Return what a stack of convolutions, ``local`` or ``overview``, makes of a map ``(3, n, m)``."""
        x = maps.astype(np.float32) / np.float32(128.0) - np.float32(1.0)
        for layer, dilation in ((0, 1), (2, 1), (4, 2)):
            x = self._convolved(f"{name}.{layer}", x, dilation)
            np.maximum(x, 0.0, out=x)
        return self._convolved(f"{name}.6", x)

    def _doubt(self, logit: Floats) -> Floats:
        return np.asarray(np.float32(self._settings.goal_m) * np.logaddexp(np.float32(0.0), -logit))

    def inputs(self, observation: Mapping[str, Any], way: Plan) -> Inputs:
        """Return what the control network is given."""
        rows = observation["landmarks"]
        landmarks = np.empty((len(rows), 5), np.float32)
        landmarks[:, :2] = rows[:, :2] / 8.0
        landmarks[:, 2:4] = np.log10(np.maximum(rows[:, [2, 4]], _LEAST)) / 4.0 + 1.0
        landmarks[:, 4] = rows[:, 5]
        landmarks *= rows[:, 5:] if self._uncertainty else 0.0
        variances = np.log10(np.maximum(observation["pose_cov"][[0, 3, 5]], _LEAST)) / 4.0 + 1.0
        numbers = [
            0.5 * way.points.ravel(), way.prices / 3.5, [min(way.length, 3.0) / 3.0, min(way.cost, 20.0) / 20.0],
            observation["twist"], observation["progress"], variances if self._uncertainty else np.zeros(3),
        ]  # fmt: skip
        return Inputs(sectors(observation["scan"]), landmarks, np.concatenate(numbers, dtype=np.float32))

    def twist(self, inputs: Inputs) -> Floats:
        """Return the action ``(3,)``."""
        return np.clip(self.control(inputs), -1.0, 1.0).astype(np.float32)

    def control(self, inputs: Inputs) -> Floats:
        """Return the twist ``(3,)`` as fractions of the limits, before it is cut off at ±1."""
        scan, landmarks, rest = inputs
        x = scan[None]
        for layer in (0, 2):
            x = np.maximum(self._around(f"scan.{layer}", x), 0.0)
        each = np.maximum(self._linear("landmark.0", landmarks), 0.0)
        each = self._linear("landmark.2", each) * landmarks[:, 4:] + (landmarks[:, 4:] - 1.0) * 1e3
        x = np.concatenate([x.ravel(), np.maximum(each.max(axis=0), 0.0), rest])
        for layer in (0, 2):
            x = np.maximum(self._linear(f"head.{layer}", x), 0.0)
        return self._linear("head.4", x)

    def _around(self, name: str, x: Floats) -> Floats:
        """Return the convolution around the circle with stride 2 ``(out, n / 2)`` of ``(in, n)``."""
        weight, bias = self._weights[f"{name}.weight"], self._weights[f"{name}.bias"]
        out, channels, k = weight.shape
        n = x.shape[1]
        index = (np.arange(0, n, 2)[None] + np.arange(k)[:, None] - k // 2) % n
        view = x[:, index].reshape(channels * k, -1)
        return np.asarray(weight.reshape(out, -1) @ view + bias[:, None])

    def _check(self) -> None:
        width, hidden = len(self._weights["local.0.bias"]), len(self._weights["head.0.bias"])
        summary = 16 * SECTORS // 4 + 16 + NUMBERS
        wanted: dict[str, tuple[int, ...]] = {
            "scan.0.weight": (8, 1, 5), "scan.2.weight": (16, 8, 5), "landmark.0.weight": (16, 5),
            "landmark.2.weight": (16, 16), "head.0.weight": (hidden, summary),
            "head.2.weight": (hidden, hidden), "head.4.weight": (3, hidden),
        }  # fmt: skip
        for name, out in (("local", 2), ("overview", 5)):
            wanted |= {
                f"{name}.0.weight": (width, 3, 5, 5), f"{name}.2.weight": (width, width, 3, 3),
                f"{name}.4.weight": (width, width, 3, 3), f"{name}.6.weight": (out, width, 1, 1),
            }  # fmt: skip
        self._expect(wanted)
        self._expect({name.replace("weight", "bias"): shape[:1] for name, shape in wanted.items()})
