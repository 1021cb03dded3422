"""CARMEN logs of later versions: ROBOTLASER1 says what FLASER does, and what the laser is."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.geometry import compose
from slam.logs import open_log, with_reference
from slam.logs.scans import ScanLog
from tests.slam.logs.scans_on_disk import CLOCK, SECONDS, drive, flaser, odom, put_lines, room_ranges, words

MOUNT = np.array([0.3, 0.0, 0.0])
LASER = "0 -1.570796 3.141593 0.017453 20 0.01 0"


def robotlaser(
    ranges: np.ndarray, robot: np.ndarray, stamp: float, *, laser: str = LASER, more: int | None = 2
) -> str:
    """Return a line with so many remissions, and with no turn axis where it knows of none."""
    remissions, axis = ("", "") if more is None else (f"{words([more, *[0.5] * more])} ", " 1e6")
    poses = f"{words(compose(robot, MOUNT))} {words(robot)}"
    times = f"{stamp:.6f} host {stamp:.6f}"
    return f"ROBOTLASER1 {laser} {len(ranges)} {words(ranges)} {remissions}{poses} 0.2 0.1 0 0{axis} {times}"


def log_of(path: Path, lines: list[str]) -> ScanLog:
    log = open_log(put_lines(path, lines))
    assert isinstance(log, ScanLog)
    return log


def both(folder: Path, *, more: int | None) -> tuple[ScanLog, ScanLog]:
    """Return the same drive by lines of both kinds."""
    true, reckoned = drive(20)
    old, new = [], []
    for k, (at, robot) in enumerate(zip(true, reckoned, strict=True)):
        stamp = CLOCK + SECONDS * k
        ranges = room_ranges(at, 180)
        old += [odom(robot, stamp - 0.1), flaser(ranges, compose(robot, MOUNT), robot, stamp)]
        new += [odom(robot, stamp - 0.1), robotlaser(ranges, robot, stamp, more=more), f"RAWLASER1 {stamp}"]
    return log_of(folder / "old.log", old), log_of(folder / "new.log", new)


@pytest.mark.parametrize("more", [None, 0, 3, 180])
def test_the_same_drive_in_lines_of_either_kind_is_the_same_log(more: int | None, tmp_path: Path) -> None:
    old, new = both(tmp_path, more=more)
    assert np.array_equal(new.stamps, old.stamps) and np.allclose(new.ranges, old.ranges)
    assert np.allclose(new.odometry_poses, old.odometry_poses, atol=1e-6)
    assert new.angle_min == pytest.approx(old.angle_min, abs=1e-6)
    assert new.angle_increment == pytest.approx(old.angle_increment, abs=1e-6)
    referenced = with_reference(old, tmp_path / "new.log")
    assert np.allclose(referenced.reference_poses, old.odometry_poses, atol=1e-6)


def test_what_the_line_tells_of_its_laser_is_taken(tmp_path: Path) -> None:
    _, reckoned = drive(10)
    ranges = np.full(241, 3.0)
    ranges[:5], ranges[5] = 5.6, 6.0
    laser = "5 -2.094395 4.18879 0.0174533 5.6 0.01 0"
    log = log_of(
        tmp_path / "a.log", [robotlaser(ranges, p, float(k), laser=laser) for k, p in enumerate(reckoned)]
    )
    assert log.angle_min == -2.094395 and log.angle_increment == 0.0174533 and log.range_max == 5.6
    assert np.isinf(log.ranges[:, :6]).all() and (np.asarray(log.ranges)[:, 6:] == 3.0).all()
    # FLASER tells the same in a log that has both.
    twice: list[str] = []
    for k, p in enumerate(reckoned):
        twice += [robotlaser(ranges, p, float(k), laser=laser), flaser(np.full(181, 2.0), p, p, float(k))]
    assert np.asarray(log_of(tmp_path / "b.log", twice).ranges).shape == (10, 181)


@pytest.mark.parametrize(
    "laser",
    ["0 -1.57 3.14 0 20 0 0", "0 nan 3.14 0.017 20 0 0", "0 -1.57 3.14 0.017 -1 0 0", "0 -9 3.14 0.017 20 0 0"],
)
def test_a_laser_that_is_none_is_refused(laser: str, tmp_path: Path) -> None:
    good, bad = (robotlaser(np.ones(180), np.zeros(3), 1.0, laser=text) for text in (LASER, laser))
    path = put_lines(tmp_path / "a.log", [good, bad])
    with pytest.raises(ValueError, match=r"a\.log, line 2: .*"):
        open_log(path)
    wider = robotlaser(np.ones(180), np.zeros(3), 2.0, laser=LASER.replace("0.017453", "0.016"))
    with pytest.raises(ValueError, match="give a log of one laser"):
        open_log(put_lines(path, [good, wider]))


@settings(max_examples=60)
@given(
    place=st.integers(0, 200), cut=st.integers(0, 6),
    value=st.sampled_from(["", "x", "-1", "1e999", "9" * 400, "nan", "3"]),
)  # fmt: skip
def test_a_damaged_line_gives_a_log_or_one_line(
    place: int, cut: int, value: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    damaged = robotlaser(np.ones(180), np.zeros(3), 1.0).split()
    damaged[place % len(damaged)] = value
    path = put_lines(tmp_path_factory.getbasetemp() / "odd.log", [" ".join(damaged[: len(damaged) - cut])])
    try:
        log = open_log(path)
    except ValueError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert math.isfinite(log.duration_s) and np.isfinite(log.dead_reckoning()).all()
