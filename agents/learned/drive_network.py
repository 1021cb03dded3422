"""The end-to-end policy's network in NumPy: the map and the observation in, body twist out.

Convolutions turn the map into prices and goals; the planning layer on them (``drive_memory``) finds a way; and the
way, the scan, the landmarks and the numbers go through a small network that says the twist. What trains it is in
``training/learning/end_to_end/networks.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from agents.learned.drive_memory import CHANNELS, PATH_POINTS, MapMemory, Plan, PlanSettings
from agents.learned.layers import Layers
from slam.types import Bytes, Floats

__all__ = ["BEAMS", "NUMBERS", "RANGE_M", "SECTORS", "DriveNetwork", "Inputs", "sectors"]

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

    def memory(self, *, step_s: float = 0.1) -> MapMemory:
        """Return a memory of this network's, as it is at the start of an episode."""
        return MapMemory(self.of_map, self._settings, step_s=step_s)

    def of_map(self, maps: Bytes) -> Floats:
        """Return log prices and goals' log odds ``(2, n, m)`` of a map ``(CHANNELS, n, m)``."""
        x = maps.astype(np.float32) / np.float32(128.0) - np.float32(1.0)
        for layer, dilation in ((0, 1), (2, 1), (4, 2), (6, 4)):
            x = self._convolved(f"map.{layer}", x, dilation)
            np.maximum(x, 0.0, out=x)
        return self._convolved("map.8", x)

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
        width, hidden = len(self._weights["map.0.bias"]), len(self._weights["head.0.bias"])
        summary = 16 * SECTORS // 4 + 16 + NUMBERS
        wanted: dict[str, tuple[int, ...]] = {
            "map.0.weight": (width, CHANNELS, 5, 5), "map.8.weight": (2, width, 1, 1),
            "scan.0.weight": (8, 1, 5), "scan.2.weight": (16, 8, 5), "landmark.0.weight": (16, 5),
            "landmark.2.weight": (16, 16), "head.0.weight": (hidden, summary),
            "head.2.weight": (hidden, hidden), "head.4.weight": (3, hidden),
        }  # fmt: skip
        wanted |= {f"map.{layer}.weight": (width, width, 3, 3) for layer in (2, 4, 6)}
        self._expect(wanted)
        self._expect({name.replace("weight", "bias"): shape[:1] for name, shape in wanted.items()})
