"""Scan matching: where a scan fits a map of surfaces best, and how well that is known.

The map is a likelihood field: every cell holds exp(-d²/2s²), d the distance to the nearest surface point. A match
first searches a bounded window over x, y and θ exhaustively (Olson 2009, "Real-time correlative scan matching": a
coarse table of maxima bounds blocks of poses, so that few are looked at closely), then climbs to the top between
the cells (Gauss-Newton on the interpolated field, as Kohlbrecher et al. 2011, "A flexible and scalable SLAM
system with full 3D motion estimation"; by a quadratic spline, since between two cells the same distance from a
wall a bilinear field is flat, and says nothing of where between them the wall is). Each beam counts by Welsch's
robust loss, so what the map does not know yet, people and lost beams pull little or not at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np

from slam.grids.match_kernels import BLOCK, climb, correlate, splat
from slam.settings import Config, Count, Few, Length, Positive, Sigma, Within, require
from slam.types import Array, Floats, Scan

__all__ = ["LikelihoodField", "Match", "MatchConfig", "body_points", "match", "refine", "search", "stamps_of"]

_MOST_PLACES = 2_000_000  # of one search: some seconds
_MARGIN_M = 1.0  # of a field around its points
_PHASES = 8  # sub-cell positions a side at which a surface point is drawn
_FLAT_INFO = 1e-3  # [1/m², 1/rad²] added so that a featureless scan still has a (very wide) covariance


@dataclass(frozen=True, kw_only=True)
class MatchConfig(Config):
    """The field, the window of the search, and how much a beam is believed."""

    cell_m: Annotated[float, Within("[0.01, 1]")] = 0.05
    smooth_m: Annotated[float, Within("[0.01, 1]")] = 0.1  # s: reach of a surface in the field
    window_m: Annotated[float, Within("[0, 10]")] = 0.3  # the search goes as far as this to either side …
    window_rad: Annotated[float, Within("[0, 3.2]")] = 0.25
    step_rad: Annotated[float, Within("[0.001, 3.2]")] = 0.0125  # … in steps of one cell and of this
    sigma_m: Sigma = 0.03  # of a beam's end against the map: range noise and the map's own error
    # A scan's beams err together (edges of cells, bent walls, a moving robot): each counts as this part of one.
    beam_weight: Positive = 0.2
    beams: Count = 180  # used at most, evenly thinned
    reach_m: Length = 20.0  # beams that end farther are not used
    iterations: Few = 12

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.smooth_m >= self.cell_m,
            f"MatchConfig.smooth_m must be at least cell_m, {self.cell_m}, got {self.smooth_m}",
        )
        places = (2 * self.window_m / self.cell_m + 1) ** 2 * (2 * self.window_rad / self.step_rad + 1)
        require(
            places <= _MOST_PLACES,
            f"MatchConfig.window_m, window_rad, cell_m and step_rad make {places:.0f} places to search; at most "
            f"{_MOST_PLACES} are allowed",
        )

    @property
    def gain(self) -> float:
        """What a beam's field value is worth in nat: 1 - L ≈ d²/2s², and a Gaussian's exponent is d²/2σ²."""
        return self.beam_weight * (self.smooth_m / self.sigma_m) ** 2


@dataclass(frozen=True, slots=True)
class Match:
    """Where a scan fits best."""

    pose: Array  # (3,) x [m], y [m], θ [rad] in the field's frame
    cov: Array  # (3, 3) from the curvature there, prior included
    score: float  # mean field value over the beams: 1 where every beam ends on a surface
    log_likelihood: float  # [nat] relative to a perfect fit, prior not included


class LikelihoodField:
    """A window of the plane whose cells hold exp(-d²/2s²), d the distance to the nearest surface point.

    Attributes
    ----------
    values : NDArray[np.float32]
        ``(rows, cols)`` in [0, 1]; rows run along y.
    x0, y0 : float
        Centre of cell (0, 0) [m].
    """

    def __init__(self, config: MatchConfig, points: Array) -> None:
        """Draw surface points ``(n, 2)`` [m] into a field that encloses them with a margin."""
        cell = config.cell_m
        low = high = np.zeros(2)
        if len(points):
            low, high = points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
        self.cell_m = cell
        (col, row), (last_col, last_row) = (
            (math.floor(x / cell), math.floor(y / cell)) for x, y in (low.tolist(), high.tolist())
        )
        self.x0, self.y0 = (col + 0.5) * cell, (row + 0.5) * cell
        self.values = np.zeros((last_row - row + 1, last_col - col + 1), np.float32)
        splat(self.values, self.x0, self.y0, cell, stamps_of(config), np.asarray(points, dtype=np.float64))

    @cached_property
    def bounds(self) -> Floats:
        """Cell (r, c): the largest value of the block of 4 × 4 cells that begins there."""
        kernel = np.ones((BLOCK, BLOCK), np.uint8)
        largest = cv2.dilate(self.values, kernel, anchor=(0, 0), borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
        return np.asarray(largest, np.float32)


_STAMPS: dict[tuple[float, float], Floats] = {}


def stamps_of(config: MatchConfig) -> Floats:
    """Return what a surface point looks like in the cells around it, ``(phases, phases, size, size)``."""
    key = (config.cell_m, config.smooth_m)
    if key not in _STAMPS:
        half = math.ceil(2.5 * config.smooth_m / config.cell_m)
        offset = np.arange(-half, half + 1) * config.cell_m
        phase = ((np.arange(_PHASES) + 0.5) / _PHASES - 0.5) * config.cell_m
        d2 = (offset[None, :] - phase[:, None]) ** 2  # (phases, size)
        distance2 = d2[:, None, :, None] + d2[None, :, None, :]
        _STAMPS[key] = np.exp(-0.5 * distance2 / config.smooth_m**2).astype(np.float32)
    return _STAMPS[key]


def body_points(scan: Scan, config: MatchConfig, *, offset_m: float = 0.0) -> Array:
    """Return where beams ended ``(n, 2)`` [m] in the body frame, the sensor ``offset_m`` ahead of its centre.

    Lost beams (``nan``), those without return (``inf``, or at ``range_max``), those below ``range_min`` and those
    beyond ``reach_m`` are left out; if more are left than ``beams``, evenly spaced ones are taken.
    """
    ranges = np.asarray(scan.ranges, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        good = (ranges < min(scan.range_max, config.reach_m)) & (ranges >= scan.range_min) & (ranges > 0.0)
    index = np.flatnonzero(good)
    if len(index) > config.beams:
        index = index[(np.arange(config.beams) * len(index)) // config.beams]
    angle = scan.angle_min + scan.angle_increment * index
    r = ranges[index]
    return np.column_stack([offset_m + r * np.cos(angle), r * np.sin(angle)])


def match(
    field: LikelihoodField, points: Array, guess: Array, config: MatchConfig, *, prior_info: Array | None = None,
) -> Match:  # fmt: skip
    """Search the window around ``guess`` ``(3,)``, then refine; ``points`` ``(n, 2)`` are in the body frame.

    ``prior_info`` ``(3, 3)`` is the information of the guess itself, none where it is left out.
    """
    return refine(field, points, search(field, points, guess, config, prior_info=prior_info), config,
                  prior=guess, prior_info=prior_info)  # fmt: skip


def search(
    field: LikelihoodField, points: Array, guess: Array, config: MatchConfig, *, prior_info: Array | None = None,
) -> Array:  # fmt: skip
    """Return the best pose ``(3,)`` of the window, to a cell and ``step_rad``: exhaustive, by bounds (Olson)."""
    info = np.zeros((3, 3)) if prior_info is None else np.asarray(prior_info, dtype=np.float64)
    shifts = math.ceil(config.window_m / config.cell_m)
    turns = math.ceil(config.window_rad / config.step_rad)
    return correlate(
        field.values, field.bounds, field.x0, field.y0, field.cell_m, points, np.asarray(guess, dtype=np.float64),
        shifts, turns, config.step_rad, config.gain, info,
    )  # fmt: skip


def refine(
    field: LikelihoodField, points: Array, guess: Array, config: MatchConfig, *, prior: Array | None = None,
    prior_info: Array | None = None,
) -> Match:  # fmt: skip
    """Climb from ``guess`` ``(3,)`` to the nearest best fit; a prior pose with its information pulls along."""
    pose = np.array(guess, dtype=np.float64)
    info = np.zeros((3, 3)) if prior_info is None else np.array(prior_info, dtype=np.float64)
    mean = pose.copy() if prior is None else np.asarray(prior, dtype=np.float64)
    curvature = np.zeros((3, 3))
    total = climb(
        field.values, field.x0, field.y0, field.cell_m, points, pose, mean, info, config.gain,
        config.iterations, curvature,
    )  # fmt: skip
    cov = np.linalg.inv(curvature + np.eye(3) * _FLAT_INFO)
    n = len(points)
    return Match(pose, 0.5 * (cov + cov.T), total / n if n else 0.0, config.gain * (total - n))
