"""The building's direction, a state beside the map: it stays what it was taken from, whatever the filter does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import slam
from slam import Scan
from slam.ekf import EkfSlam
from slam.gaussian.joint_gaussian import state_rows
from slam.gaussian.stacked_update import whiten_difference
from slam.geometry import wrap_scalar
from slam.landmarks.right_angles import HELD, HELD_ALONE, SQUARE
from slam.motion import LastingErrors, OdometryNoise
from slam.teams.centralised import JointEkf
from slam.types import LINE, Array
from tests.slam.simulated import drive, room_scan

OFFSET, SIGMA = 0.2, 0.001
LASTING = {"odometry": OdometryNoise(lever_m=0.4, lasting=LastingErrors(radius_sigma=0.02, lever_sigma=0.03))}
REGIONS = {"whole_up_to": 4, "margin_m": 0.5, "leave_share": 0.2}
SIGHTINGS, LAST, TO = 2, 5, 7  # columns of marks
FILTERS: list[tuple[str, dict[str, Any]]] = [
    ("ekf-lines", {}), ("compressed-ekf", {"lines": True, **REGIONS}), ("invariant-ekf", {}),
    ("invariant-ekf", LASTING), ("invariant-ekf", {**LASTING, **REGIONS}),
]  # fmt: skip


def scan_from(pose: Array, rng: np.random.Generator, width: float, reach: float) -> Scan:
    sensor = (pose[0] + OFFSET * math.cos(pose[2]), pose[1] + OFFSET * math.sin(pose[2]), pose[2])
    scan = room_scan(sensor, rng, width=width, height=4.0)
    return Scan(np.where(scan.ranges < reach, scan.ranges, np.inf), scan.angle_min, scan.angle_increment, reach)


def driven(backend: EkfSlam, steps: int, *, width: float = 12.0, reach: float = 8.0) -> EkfSlam:
    """Drive along a room as wide as that, from ``(1, 2)`` on."""
    rng, pose = np.random.default_rng(5), np.array([1.0, 2.0, 0.1])
    backend.reset(pose, pose_cov=np.eye(3) * 1e-8)
    backend.update(scan_from(pose, rng, width, reach))
    for k in range(steps):
        pose, odometry = drive(pose, np.array([0.5, 0.0, 0.2 * math.sin(k / 5)]), (0.01, 0.01), rng, dt=0.1)
        backend.predict(odometry)
        backend.update(scan_from(pose, rng, width, reach))
    return backend


def walls(backend: EkfSlam) -> list[int]:
    marks = backend._book.marks
    return [k for k in range(len(marks)) if marks[k, 0] == LINE and marks[k, SIGHTINGS] > 5]


def row_of(p: Array, n: int, i: int) -> Array:
    return np.concatenate([p[:i, i], p[i, i:n]])


class Taking:
    """Stands in for :meth:`EkfSlam._square`: takes the direction from the first wall, then corrects by others."""

    def __init__(self, variance: float, *, corrects: bool) -> None:
        self.variance, self.corrects, self.wall, self.corrections = variance, corrects, -1, 0

    def __call__(self, backend: EkfSlam) -> None:
        known = walls(backend)
        beside = backend._beside
        if known and self.wall < 0:
            self.wall = int(backend._book.ids[known[0]])
            beside.take_direction(backend._x, backend._p, backend._n, 3 + 2 * known[0], self.variance)
        elif self.corrects and self.wall >= 0 and backend._book.now % 7 == 0:
            for k in known:
                if backend._book.ids[k] != self.wall:
                    i, (_, variance, cross) = 3 + 2 * k, beside.direction
                    w, s = backend._w, backend._s
                    whiten_difference(backend._p, backend._n, i, variance, cross, 0.003, SIGMA**2, w, s)
                    backend._correct_direction(i)
                    self.corrections += 1


def check_is_the_walls(backend: EkfSlam, taking: Taking) -> None:
    """Mean, variance and covariance with everything are those of the wall's direction."""
    beside, row = backend._beside, backend._book.row(taking.wall)
    direction, variance, cross = beside.direction
    if row >= 0:
        x, p, i, states = backend._x, backend._p, 3 + 2 * row, np.arange(backend._n)
        of_others = beside.cov[: beside.own - 1, beside.own - 1] - beside.cross[: beside.own - 1, i]
        scale = np.sqrt(np.diag(beside.cov)[: beside.own - 1] * variance)
        assert np.abs(of_others / scale).max(initial=0.0) < 1e-9
    else:
        backend._leave()
        places = np.sort(np.concatenate([backend._near, backend._far]))
        at = int(places[backend._map_ids[places] == taking.wall][0])
        x, p, i, states = backend._map_x, backend._map_p, 3 + 2 * at, state_rows(places, robot=True)
        cross = backend._map_own[beside.own - 1]
    whole = row_of(p, len(p), i)
    scale = np.sqrt(np.diag(p)[states] * variance)
    assert wrap_scalar(direction - float(x[i])) == pytest.approx(0.0, abs=1e-9)
    assert variance == pytest.approx(whole[i] + taking.variance, rel=1e-6)
    assert np.abs((whole[states] - cross[states]) / scale).max() < 1e-6


@pytest.mark.parametrize("corrects", [False, True])
@pytest.mark.parametrize(("name", "config"), FILTERS)
def test_it_stays_the_wall_that_it_was_taken_from(
    name: str, config: dict[str, Any], *, corrects: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an error of its own if nothing corrects it, without one for good: over landmarks, regions, resets."""
    taking = Taking(0.0 if corrects else SIGMA**2, corrects=corrects)
    monkeypatch.setattr(EkfSlam, "_square", lambda self: taking(self))
    in_regions = "whole_up_to" in config
    backend = slam.make(name, config=config)
    assert isinstance(backend, EkfSlam)
    driven(backend, 110, width=30.0 if in_regions else 12.0, reach=2.5 if in_regions else 8.0)
    assert taking.wall >= 0 and (taking.corrections > 3) == corrects
    check_is_the_walls(backend, taking)


def test_it_stays_that_while_robots_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    team = JointEkf(3)
    starts = np.array([[1.0, 2.0, 0.1], [3.0, 1.5, 0.0], [6.0, 2.0, 3.0]])
    team.reset(starts, np.tile(np.eye(3) * 1e-6, (3, 1, 1)))
    taking, rng, true = Taking(SIGMA**2, corrects=False), np.random.default_rng(1), starts.copy()
    monkeypatch.setattr(EkfSlam, "_square", lambda self: taking(self))
    for k in range(40):
        for i, member in enumerate(team.members):
            true[i], odometry = drive(true[i], np.array([0.3, 0.0, 0.3 * math.sin(k / 10 + i)]), (0.01, 0.01), rng)
            member.predict(odometry)
            member.update(scan_from(true[i], rng, 9.0, 8.0))
    team.members[0].see(2, [1.0, 0.1, 0.2], np.eye(3) * 100.0)
    check_is_the_walls(team.members[0], taking)
    assert team.joint_cov().shape == (9 + 2 * team.members[0]._book.count,) * 2


def untold(backend: EkfSlam, *, sightings: float) -> int:
    """Forget what was held, and let one long wall be due, the others seen so often; return its row."""
    marks = backend._book.marks
    marks[:, SQUARE], marks[:, SIGHTINGS], marks[:, LAST] = 0.0, sightings, backend._book.now
    wall = max(walls(backend), key=lambda k: marks[k, TO] - marks[k, TO - 1])
    marks[wall, SIGHTINGS] = 20.0
    return wall


@pytest.mark.parametrize("name", ["ekf-lines", "invariant-ekf"])
def test_one_long_wall_tells_alone_then_most_tell(name: str) -> None:
    backend = slam.make(name, config={"right_angle_sigma_rad": SIGMA})
    assert isinstance(backend, EkfSlam)
    driven(backend, 100, width=9.0, reach=20.0)
    beside, marks = backend._beside, backend._book.marks
    k, n = beside.own - 1, backend._n
    assert beside.sure and (marks[:, SQUARE] == HELD).sum() >= 4, "a room is square"

    wall = untold(backend, sightings=6.0)
    i = 3 + 2 * wall
    beside.cov[k], beside.cov[:, k], beside.cross[k], beside.sure = 0.0, 0.0, 0.0, False
    backend._square()
    assert marks[wall, SQUARE] == HELD_ALONE and not beside.sure
    assert beside.direction[1] == pytest.approx(backend._p[i, i] + (3.0 * SIGMA) ** 2)

    wall = untold(backend, sightings=6.0)
    beside.mean[k], lost = backend._x[i] + 0.01, 0.02**2  # the direction is lost, and 10 mrad off
    beside.cov[k], beside.cov[:, k], beside.cov[k, k], beside.cross[k] = 0.0, 0.0, lost, 0.0
    before = backend._p[i, i]
    backend._square()
    direction, variance, cross = beside.direction
    apart = backend._p[i, i] + variance - 2.0 * cross[i]
    assert marks[wall, SQUARE] == HELD_ALONE and not beside.sure
    assert apart == pytest.approx(1.0 / (1.0 / (before + lost) + 1.0 / (3.0 * SIGMA) ** 2), rel=1e-3)
    assert abs(direction - backend._x[i]) < 0.0004

    untold(backend, sightings=20.0)  # now most walls of the room say that it is another one
    beside.mean[k] += 0.1
    backend._square()
    assert beside.sure and (marks[:, SQUARE] == HELD).sum() >= 4
    off = backend._x[3:n:2][marks[:, 0] == LINE] - beside.direction[0]
    assert np.abs(off - 0.5 * math.pi * np.round(off / (0.5 * math.pi))).max() < 0.005


def test_the_heading_is_kept_within_a_turn() -> None:
    backend = slam.make("ekf-lines")
    assert isinstance(backend, EkfSlam)
    driven(backend, 30)
    i = 3 + 2 * walls(backend)[0]
    backend._x[2] = math.pi - 1e-5
    backend._p[2, 2] = backend._p[2, i] = backend._p[i, i] = 0.02**2  # the wall turns with the heading
    backend._beside.take_direction(backend._x, backend._p, backend._n, i, 1.0)
    _, variance, cross = backend._beside.direction
    whiten_difference(backend._p, backend._n, i, variance, 0.0 * cross, 0.01, SIGMA**2, backend._w, backend._s)
    backend._correct_direction(i)
    assert abs(backend._x[2]) <= math.pi
