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

from agents.learned.convolution import convolve
from agents.learned.drive_plan import descend, distances, node_prices

__all__ = [
    "BEAMS",
    "NUMBERS",
    "PATH_POINTS",
    "RANGE_M",
    "SECTORS",
    "DriveNetwork",
    "Inputs",
    "Plan",
    "PlanSettings",
    "control",
    "landmark_rows",
    "numbers",
    "pixel_size",
    "plan",
    "sectors",
]  # fmt: skip

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
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
    goal_bias: float = 0.0  # log odds at which doubt begins
    turn_m: float = 0.4  # what lies behind costs more by up to twice this [m]: no dithering between two ways


class Plan(NamedTuple):
    """What the planning layer says."""

    path: Array  # (n, 2) [m] forward, left of the robot, from the robot on
    cost: float  # of the way, its goal included [m]
    prices: Floats  # (PATH_POINTS,) log price of a metre at each of the resampled points
    points: Floats  # (PATH_POINTS, 2) the path resampled [m]
    length: float  # of the path within the local map [m]


def stack(weights: Mapping[str, Floats], name: str, maps: Bytes) -> Floats:
    """Return what a stack of convolutions makes of a map ``(3, n, m)``."""
    x = maps.astype(np.float32) / np.float32(128.0) - np.float32(1.0)
    for layer, dilation in ((0, 1), (2, 1), (4, 2)):
        x = convolve(x, weights[f"{name}.{layer}.weight"], weights[f"{name}.{layer}.bias"], dilation)
        np.maximum(x, 0.0, out=x)
    return convolve(x, weights[f"{name}.6.weight"], weights[f"{name}.6.bias"])


@njit(cache=True, nogil=True)
def pixel_size(near: Bytes, far: Bytes, pose: Floats) -> float:
    """Return the side [m] of a pixel of ``map_global``: the one at which it agrees best with ``map_local``.

    The observation does not tell it, but shows the same place on two maps of which one has a known scale.
    """
    at_col, at_row = (pose[0] + 1.0) * 0.5 * SIZE, SIZE - (pose[1] + 1.0) * 0.5 * SIZE
    best, found = np.inf, 0.4
    for size in _PIXELS_M:
        apart = 0.0
        for i in range(1, SIZE, 3):
            for j in range(1, SIZE, 3):
                ahead, left = (0.5 * SIZE - 0.5 - i) * CELL_M, (0.5 * SIZE - 0.5 - j) * CELL_M
                dx, dy = pose[2] * ahead - pose[3] * left, pose[3] * ahead + pose[2] * left
                row, col = math.floor(at_row - dy / size), math.floor(at_col + dx / size)
                known = probability = 0.0
                if 0 <= row < SIZE and 0 <= col < SIZE:
                    known = far[1, row, col] / 255.0
                    probability = far[0, row, col] / 255.0 if known > 0.0 else 0.5
                else:
                    probability = 0.5
                apart += abs(near[1, i, j] / 255.0 - known) + 0.5 * abs(near[0, i, j] / 255.0 - probability)
        if apart < best:
            best, found = apart, size
    return found


@njit(cache=True, nogil=True)
def _ends(goal: Floats, far: Floats, pose: Floats, pixel: float, turn_m: float) -> Floats:
    """Return what ending at each local pixel costs ``(n, m)``: a goal there, or the way on from the rim."""
    out = goal.copy()
    at_col, at_row = (pose[0] + 1.0) * 0.5 * SIZE, SIZE - (pose[1] + 1.0) * 0.5 * SIZE
    for i in range(SIZE):
        for j in range(SIZE):
            ahead, left = (0.5 * SIZE - 0.5 - i) * CELL_M, (0.5 * SIZE - 0.5 - j) * CELL_M
            if max(abs(ahead), abs(left)) > _RIM_M:
                dx, dy = pose[2] * ahead - pose[3] * left, pose[3] * ahead + pose[2] * left
                row, col = math.floor(at_row - dy / pixel), math.floor(at_col + dx / pixel)
                if 0 <= row < SIZE and 0 <= col < SIZE:
                    out[i, j] = min(out[i, j], far[row, col])
            away = math.hypot(ahead, left)
            out[i, j] = out[i, j] + turn_m * (1.0 - ahead / away) if away > _HERE_M else 1e6
    return out


def plan(weights: Mapping[str, Floats], observation: Mapping[str, Any], settings: PlanSettings) -> Plan:
    """Return the way that the planning layer finds on what the convolutions make of the maps."""
    near, far = stack(weights, "local", observation["map_local"]), observation["map_global"]
    pose = observation["pose"]
    pixel = pixel_size(observation["map_local"], far, pose)
    used = _used(far[1])
    said = stack(weights, "overview", far[:, used[0], used[1]])
    prices = np.float32(pixel) * STEP_LENGTHS * np.exp(np.clip(said[:4], *LOG_PRICES))
    onwards = np.full((SIZE, SIZE), _FAR)
    onwards[used] = distances(prices, _doubt(said[4], settings))[0]
    ends = _ends(_doubt(near[1], settings), onwards, pose, pixel, settings.turn_m)
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


def _used(known: Bytes) -> tuple[slice, slice]:
    """Return the rows and columns of a map that anything is known in, and a margin that convolutions look into."""
    rows, cols = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not len(rows):
        return slice(0, SIZE), slice(0, SIZE)
    return (
        slice(max(int(rows[0]) - _MARGIN, 0), int(rows[-1]) + _MARGIN + 1),
        slice(max(int(cols[0]) - _MARGIN, 0), int(cols[-1]) + _MARGIN + 1),
    )


def _doubt(logit: Floats, settings: PlanSettings) -> Floats:
    return np.asarray(
        np.float32(settings.goal_m) * np.logaddexp(np.float32(0.0), np.float32(settings.goal_bias) - logit)
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


def numbers(observation: Mapping[str, Any], way: Plan, *, uncertainty: bool = True) -> Floats:
    """Return the way and the other numbers of an observation ``(NUMBERS,)``, scaled to about 1."""
    out = np.empty(NUMBERS, np.float32)
    k = 2 * PATH_POINTS
    out[:k] = 0.5 * way.points.ravel()
    out[k : k + PATH_POINTS] = way.prices / 3.5
    k += PATH_POINTS
    out[k : k + 2] = min(way.length, 3.0) / 3.0, min(way.cost, 20.0) / 20.0
    out[k + 2 : k + 5] = observation["twist"]
    out[k + 5 : k + 7] = observation["progress"]
    variances = np.log10(np.maximum(observation["pose_cov"][[0, 3, 5]], _LEAST))
    out[k + 7 : k + 10] = variances / 4.0 + 1.0 if uncertainty else 0.0
    return out


def sectors(scan: Floats) -> Floats:
    """Return how near the nearest return in each direction is ``(…, SECTORS)``: 1 at the sensor, 0 far away."""
    nearest = np.asarray(scan, np.float32).reshape(*scan.shape[:-1], SECTORS, -1).min(axis=-1)
    return np.asarray(np.exp(nearest / np.float32(-_NEAR_SHARE)))


def landmark_rows(rows: Floats, *, uncertainty: bool = True) -> Floats:
    """Return the landmarks scaled ``(…, n, 5)``: x, y, two variances' logarithms, whether there is one."""
    out = np.empty((*rows.shape[:-1], 5), np.float32)
    out[..., :2] = rows[..., :2] / 8.0
    out[..., 2:4] = np.log10(np.maximum(rows[..., [2, 4]], _LEAST)) / 4.0 + 1.0
    out[..., 4] = rows[..., 5]
    out *= rows[..., 5:] if uncertainty else 0.0
    return out


def control(weights: Mapping[str, Floats], scan: Floats, landmarks: Floats, rest: Floats) -> Floats:
    """Return the twist ``(3,)`` as fractions of the limits, before it is cut off at ±1."""
    x = scan[None]
    for layer in (0, 2):
        x = np.maximum(_around(x, weights[f"scan.{layer}.weight"], weights[f"scan.{layer}.bias"]), 0.0)
    each = np.maximum(_linear(weights, "landmark.0", landmarks), 0.0)
    each = _linear(weights, "landmark.2", each) * landmarks[:, 4:] + (landmarks[:, 4:] - 1.0) * 1e3
    x = np.concatenate([x.ravel(), np.maximum(each.max(axis=0), 0.0), rest])
    for layer in (0, 2):
        x = np.maximum(_linear(weights, f"head.{layer}", x), 0.0)
    return _linear(weights, "head.4", x)


def _around(x: Floats, weight: Floats, bias: Floats) -> Floats:
    """Return the convolution around the circle with stride 2 ``(out, n / 2)`` of ``(in, n)``."""
    out, channels, k = weight.shape
    n = x.shape[1]
    index = (np.arange(0, n, 2)[None] + np.arange(k)[:, None] - k // 2) % n
    view = x[:, index].reshape(channels * k, -1)
    return np.asarray(weight.reshape(out, -1) @ view + bias[:, None])


def _linear(weights: Mapping[str, Floats], name: str, x: Floats) -> Floats:
    return np.asarray(x @ weights[name + ".weight"].T + weights[name + ".bias"])


class Inputs(NamedTuple):
    """What the control network is given."""

    scan: Floats  # (SECTORS,)
    landmarks: Floats  # (n, 5)
    numbers: Floats  # (NUMBERS,)


class DriveNetwork:
    """Observation in, twist out.

    Parameters
    ----------
    weights : mapping
        Name to array, as PyTorch names them.
    settings : PlanSettings
        Of the planning layer.
    uncertainty : bool
        Whether the belief's covariance and its landmarks are looked at; without, for an ablation.

    Raises
    ------
    ValueError
        Where a weight is missing or has another shape than the others ask for.
    """

    def __init__(
        self, weights: Mapping[str, Floats], settings: PlanSettings | None = None, *, uncertainty: bool = True
    ) -> None:
        self._weights = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in weights.items()}
        self._settings, self._uncertainty = settings or PlanSettings(), uncertainty
        self._check()

    def plan(self, observation: Mapping[str, Any]) -> Plan:
        """Return the way that the planning layer finds."""
        return plan(self._weights, observation, self._settings)

    def inputs(self, observation: Mapping[str, Any], way: Plan) -> Inputs:
        """Return what the control network is given."""
        return Inputs(
            sectors(observation["scan"]),
            landmark_rows(observation["landmarks"], uncertainty=self._uncertainty),
            numbers(observation, way, uncertainty=self._uncertainty),
        )

    def twist(self, inputs: Inputs) -> Floats:
        """Return the action ``(3,)``."""
        return np.clip(control(self._weights, *inputs), -1.0, 1.0).astype(np.float32)

    def _check(self) -> None:
        try:
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
            for name, shape in list(wanted.items()):
                wanted[name.replace("weight", "bias")] = shape[:1]
            for name, shape in wanted.items():
                found: Any = self._weights[name].shape
                if found != shape:
                    raise ValueError(f"weight {name} has the shape {found}, expected {shape}")
        except KeyError as error:
            raise ValueError(f"weight {error.args[0]} is missing") from error
