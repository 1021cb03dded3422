"""Filters between the wheels and a backend: paper C's on-board use, of a robot that accelerates.

The wheels' twists are summed up to coordinates x, y, θ, each of which a Kalman-Bucy filter takes for measurements;
the twist that leads from one filtered pose to the next is what the backend is given. What it brings, and what it
costs in consistency: ``docs/reference/differential_transform.md``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numba import njit

from slam.odometry.differential_transform import MODELS, make_model
from slam.odometry.riccati import Rules, Tolerances, Workspace, advance
from slam.settings import Config, NotNegative, OneOf, Within, argument, check_name, from_mapping
from slam.types import Array, Odometry

__all__ = ["ODOMETRY_FILTERS", "OdometryFilter", "OdometryFilterConfig", "make_odometry_filter"]

_START_S = 0.1  # since which a robot that starts has moved: models that know of 1/t cannot start at 0


@dataclass(frozen=True, kw_only=True)
class OdometryFilterConfig(Config):
    """Of each coordinate the model, R and Q; only Q/R decides how fast the filter follows.

    Below either speed of rest the filters start anew where the wheels say that the robot is: the motion that the
    models describe begins there, and nothing that was held back is lost. Model and Q are those with the least
    velocity error on training seeds (``training.studies.paper_c.figures``).
    """

    model: Annotated[str, OneOf(tuple(MODELS))] = "constant_velocity"
    measurement_m2_s: Annotated[float, Within("[1e-12, 1e6]")] = 2.5e-8  # R of x and y: 0.5 mm, every 0.1 s
    measurement_rad2_s: Annotated[float, Within("[1e-12, 1e6]")] = 2.5e-7  # R of θ
    # Q of x and y: m²/s³, of wiener_acceleration m²/s⁵
    process_linear: Annotated[float, Within("[1e-12, 1e6]")] = 0.03
    process_turn: Annotated[float, Within("[1e-12, 1e6]")] = 0.3  # Q of θ: rad²/s³, of wiener_acceleration rad²/s⁵
    # Of a start: m, m/s, m/s²; of θ in rad.
    start_sigmas: Annotated[tuple[float, float, float], Within("[0, 1e6]")] = (1e-4, 0.1, 1.0)
    rest_speed_m_s: NotNegative = 0.002
    rest_turn_rate_rad_s: NotNegative = 0.005


class OdometryFilter:
    """Twists in, filtered twists out; :meth:`reset` at the start of every episode."""

    def __init__(self, config: OdometryFilterConfig | None = None) -> None:
        self.config = config = config or OdometryFilterConfig()
        model, n = make_model(config.model), make_model(config.model).size
        tolerances = Tolerances(relative=1e-4)  # of tenths of a millimetre: far below what any sensor can tell
        drive = np.outer(model.drive, model.drive)
        process = (config.process_linear, config.process_linear, config.process_turn)
        measured = (config.measurement_m2_s, config.measurement_m2_s, config.measurement_rad2_s)
        x, y, theta = (Workspace.of(n, tolerances.order) for _ in measured)
        self._work = x, y, theta
        self._poses = np.zeros((3, 3))  # rows: reckoned, filtered, where the filters started; θ unwrapped
        self._clock = np.zeros(1)  # [s] of the models
        self._start_cov = np.diag(np.array(config.start_sigmas[:n]) ** 2)
        self._fixed = (
            model.powers, model.matrices, np.array([q * drive for q in process]), 1.0 / np.array(measured),
            self._start_cov, config.rest_speed_m_s, config.rest_turn_rate_rad_s,
            self._poses, self._clock, self._work, tolerances.rules,
        )  # fmt: skip
        self.reset()

    def reset(self) -> None:
        """Begin at rest, at the origin."""
        self._poses[:] = 0.0
        self._clock[0] = _START_S
        for work in self._work:
            work.x[0], work.eta[0] = 0.0, self._start_cov

    def filter(self, odometry: Odometry) -> Odometry:
        """Return the twist between the filtered poses before and after a step; over no time, the twist given.

        ``ValueError`` for a twist that is not finite.
        """
        vx, vy, omega = odometry.numbers
        if odometry.dt == 0.0 and math.isfinite(vx + vy + omega):
            return odometry._replace(twist=np.array([vx, vy, omega]))
        out = np.empty(3)
        if not _filter(vx, vy, omega, odometry.dt, *self._fixed, out):
            raise ValueError(f"odometry must be finite, got {odometry}")
        return odometry._replace(twist=out)


@njit(cache=True, nogil=True, error_model="numpy")
def _filter(
    vx: float, vy: float, omega: float, dt: float, powers: Array, matrices: Array, noise: Array, inverse_r: Array,
    start_cov: Array, rest_speed: float, rest_turn: float, poses: Array, clock: Array,
    works: tuple[Workspace, Workspace, Workspace], rules: Rules, out: Array,
) -> bool:  # fmt: skip
    """Reckon on, filter each coordinate, and write the twist that leads from filtered pose to filtered pose."""
    reckoned, filtered, origin = poses[0], poses[1], poses[2]
    old_x, old_y, old_theta = filtered[0], filtered[1], filtered[2]
    middle = reckoned[2] + 0.5 * omega * dt
    c, s = math.cos(middle), math.sin(middle)
    change = ((vx * c - vy * s) * dt, (vx * s + vy * c) * dt, omega * dt)
    if not math.isfinite(change[0] + change[1] + change[2]):
        return False
    resting = math.hypot(vx, vy) < rest_speed and abs(omega) < rest_turn
    for k in range(3):
        if not resting:
            work = works[k]
            work.z[0], work.z[1] = reckoned[k] - origin[k], change[k]
            count = advance(powers, matrices, noise[k], inverse_r[k], clock[0], dt, work, rules)
            filtered[k] = origin[k] + work.x[0, 0]
            resting = count < 0 or not math.isfinite(filtered[k])  # never seen; then as after a rest
        reckoned[k] += change[k]
    clock[0] += dt
    if resting:
        for k in range(3):
            filtered[k] = origin[k] = reckoned[k]
            works[k].x[0, :] = 0.0
            works[k].eta[0] = start_cov
        clock[0] = _START_S
    turn = filtered[2] - old_theta
    middle = old_theta + 0.5 * turn
    c, s = math.cos(middle), math.sin(middle)
    dx, dy = filtered[0] - old_x, filtered[1] - old_y
    out[0], out[1], out[2] = (c * dx + s * dy) / dt, (c * dy - s * dx) / dt, turn / dt
    return True


# ---- by name ---------------------------------------------------------------------------------------------------

ODOMETRY_FILTERS = ("none", "differential-transform")
"""The names that :func:`make_odometry_filter` knows."""


def make_odometry_filter(
    name: str, config: Mapping[str, Any] | OdometryFilterConfig | None = None
) -> OdometryFilter | None:
    """Return a filter by name, None for ``"none"``; ``ValueError`` lists the valid names or keys."""
    check_name("odometry filter", name, ODOMETRY_FILTERS)
    if name == "none":
        if config:
            raise ValueError('the odometry filter "none" has no settings; name "differential-transform" with them')
        return None
    with argument("config"):
        return OdometryFilter(from_mapping(OdometryFilterConfig, config))
