"""Logs of laser scans: what is written is read, odometry and stamps are mended as described, damage is named."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import slam
from slam.geometry import compose, relative, wrap
from slam.logs import ScanLog, open_log, with_reference
from slam.logs.dpslam import NOMINAL_DT_S
from slam.logs.scans import beam_angles, rising, without_returns
from slam.metrics.measures import ate
from tests.slam.logs.logs_on_disk import data_folder, write_utias
from tests.slam.logs.scans_on_disk import (
    SECONDS,
    carmen_lines,
    dpslam_lines,
    drive,
    flaser,
    odom,
    put_lines,
    room_ranges,
)

coordinates = st.floats(-300.0, 300.0)  # no farther apart than a robot can be from scan to scan
poses = st.tuples(coordinates, coordinates, st.floats(-3.1, 3.1)).map(np.array)
measured = st.floats(0.01, 8.0) | st.floats(8.2, 50.0)  # between are a laser's codes for no return
unknown_lines = st.sampled_from(
    ["", "# a comment", "NEFF 14.2", "PARAM a b", "SYNC x", "RLASER 2 1 1", "TRUEPOS 1", "  ", "FLASERX 3", "\x00"]
)


def scan_log(path: Path) -> ScanLog:
    log = open_log(path)
    assert isinstance(log, ScanLog)
    return log


# ---- what was written is read ---------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    scans=st.lists(st.tuples(st.lists(measured, min_size=3, max_size=3), poses), min_size=1, max_size=6),
    noise=st.lists(unknown_lines, max_size=8), packed=st.booleans(), end=st.sampled_from(["", "\n", "\r\n"]),
)  # fmt: skip
def test_carmen_scans_among_unknown_lines(scans, noise, packed, end, tmp_path_factory):
    lines = []
    for i, (ranges, pose) in enumerate(scans):
        lines += noise[i::2]
        lines += [odom(pose, 10.0 + i), flaser(np.array(ranges), pose, pose, 10.0 + i)]
    text = "\n".join(lines).encode() + end.encode()
    path = tmp_path_factory.getbasetemp() / "room.x.log"
    path.write_bytes(gzip.compress(text) if packed else text)
    log = scan_log(path)
    assert log.name == "room" and log.clock_start_s == 10.0 and log.times.tolist() == list(range(len(scans)))
    assert np.allclose(log.ranges, [ranges for ranges, _ in scans])
    assert np.allclose(log.odometry_poses[:, :2], [pose[:2] for _, pose in scans], atol=1e-6)
    assert log.range_max > np.max(log.ranges)


def test_a_dpslam_log(tmp_path):
    log = scan_log(put_lines(tmp_path / "loop.log.gz", ["# a comment", *dpslam_lines(5)], packed=True))
    true, reckoned = drive(5)
    assert log.times.tolist() == [i * NOMINAL_DT_S for i in range(5)]
    assert np.allclose(log.odometry_poses, reckoned) and np.allclose(log.ranges[3], room_ranges(true[3], 181))
    assert math.degrees(log.angle_min) == -90 and math.degrees(log.angle_increment * 180) == pytest.approx(180)


@settings(max_examples=60)
@given(
    data=st.binary(max_size=300),
    start=st.sampled_from([b"", b"FLASER ", b"FLASER 2 1 1 ", b"Laser 2 ", b"\x1f\x8b"]),
)
def test_any_bytes_give_a_log_or_one_line(data, start, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "noise.log"
    path.write_bytes(start + data)
    try:
        log = scan_log(path)
    except ValueError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert np.isfinite(log.odometry_poses).all()


def test_beams_stand_a_degree_apart():
    for beams, last in ((180, 89.0), (181, 90.0), (361, 90.0), (2, 90.0)):
        first, step = beam_angles(beams)
        assert math.degrees(first) == -90.0 and math.degrees(first + step * (beams - 1)) == pytest.approx(last)


@pytest.mark.parametrize(
    ("beams", "first_deg", "step_deg"),
    [
        (360, -90.0, 0.5), (361, -90.0, 0.5), (540, -135.0, 0.5), (541, -135.0, 0.5),
        (682, -119.7, 360 / 1024), (683, -119.9, 360 / 1024), (769, -135.0, 360 / 1024),
    ],
)  # fmt: skip
def test_beams_of_other_lasers_are_known_by_their_number(beams, first_deg, step_deg):
    first, step = beam_angles(beams)
    assert math.degrees(first) == pytest.approx(first_deg, abs=0.05)
    assert math.degrees(step) == pytest.approx(step_deg)


# ---- odometry -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["raw", "gfs2log"])
def test_raw_odometry_is_found_again(kind, tmp_path):
    log = scan_log(put_lines(tmp_path / "a.log", carmen_lines(30, kind=kind)))
    _, reckoned = drive(30)
    assert np.allclose(log.odometry_poses[:, :2], reckoned[:, :2], atol=1e-7)
    assert np.allclose(wrap(log.odometry_poses[:, 2] - reckoned[:, 2]), 0, atol=1e-7)


def test_predict_composes_to_the_odometry(tmp_path):
    log = scan_log(put_lines(tmp_path / "a.log", carmen_lines(30)))
    backend = slam.make("odometry")
    backend.reset(log.start_pose)
    now = 0.0
    for event, expected in zip(log.events(), log.dead_reckoning(), strict=True):
        assert event.observations is None and event.scan is not None
        assert event.time_s == pytest.approx(now + event.odometry.dt)
        now = event.time_s
        backend.predict(event.odometry)
        assert backend.pose == pytest.approx(expected, abs=1e-9)
    assert now == log.duration_s == pytest.approx(29 * SECONDS)


@pytest.mark.parametrize("decimals", [9, 2])
def test_a_laser_mounted_ahead_is_followed_and_not_taken_for_a_correction(tmp_path, decimals):
    true, _ = drive(10)
    ahead = np.array([0.3, 0.0, 0.0])
    lines = []
    for i, pose in enumerate(true):
        robot, laser = np.round(pose, decimals), np.round(compose(pose, ahead), decimals)
        lines += [odom(robot, float(i)), flaser(room_ranges(pose, 180), laser, robot, float(i))]
    log = scan_log(put_lines(tmp_path / "a.log", lines))
    least = max(1e-7, 2.0 * 10.0**-decimals)
    assert np.allclose(log.odometry_poses, [compose(pose, ahead) for pose in true], atol=least)


def test_a_corrected_laser_pose_beside_odometry_is_left_to_the_reference(tmp_path):
    true, reckoned = drive(10)
    lines = [
        flaser(room_ranges(t, 180), t, r, float(i)) for i, (t, r) in enumerate(zip(true, reckoned, strict=True))
    ]
    log = scan_log(path := put_lines(tmp_path / "a.log", lines))
    assert np.allclose(log.odometry_poses, reckoned, atol=1e-7)
    assert np.allclose(with_reference(log, path).reference_poses, true, atol=1e-7)


# ---- time stamps and ranges -----------------------------------------------------------------------------------


@given(st.lists(st.floats(0.0, 100.0), min_size=1, max_size=30))
def test_stamps_come_to_rise_and_good_ones_stay(stamps):
    times = rising(np.array(stamps))
    assert len(times) == len(stamps) and np.all(np.diff(times) > 0)
    if np.all(np.diff(stamps) > 1e-5):
        assert times.tolist() == stamps


def test_a_late_stamp_is_put_between_its_neighbours():
    assert rising(np.array([0.0, 1.0, 90.0, 3.0, 4.0])).tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert rising(np.array([0.0, 1.0, 2.0, 0.5])).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert rising(np.array([50.0, 1.0, 2.0])).tolist() == [0.0, 1.0, 2.0]
    assert rising(np.array([3.0, 3.0])).tolist() == [2.0, 3.0]


def test_a_clock_that_jumps_back_is_told_of(tmp_path):
    lines = carmen_lines(30)
    log = scan_log(put_lines(tmp_path / "a.log", lines))
    back = scan_log(put_lines(tmp_path / "b.log", [*lines[15:], *lines[:15]]))
    assert "did not rise" not in log.note and " of 30 stamps did not rise" in back.note


def test_codes_for_no_return():
    ranges, reach = without_returns(np.array([[1.0, 8.183, 8.175, 0.0]]))
    assert reach == 8.18 and ranges[0, :3].tolist() == [1.0, math.inf, 8.175] and math.isnan(ranges[0, 3])
    ranges, reach = without_returns(np.array([[1.0, 81.83, 8.183, 25.38]]))
    assert reach == 25.4 and math.isnan(ranges[0, 1]) and ranges[0, 2:].tolist() == [8.183, 25.38]
    ranges, reach = without_returns(np.array([[81.83, 0.0]]))
    assert np.isnan(ranges).all() and reach > 0


@pytest.mark.parametrize(("farthest", "taken_as"), [(5.6, math.inf), (8.0, math.inf), (30.0, math.nan)])
def test_the_farthest_of_another_laser_is_no_wall(farthest, taken_as):
    rng = np.random.default_rng(0)
    measured = np.round(rng.uniform(0.5, 0.9 * farthest, (40, 181)), 3)
    open_ = rng.random((40, 181)) < 0.02
    ranges, reach = without_returns(np.where(open_, farthest, measured))
    assert np.array_equal(ranges[~open_], measured[~open_]) and reach <= farthest
    np.testing.assert_equal(ranges[open_], np.full(open_.sum(), taken_as))
    # A wall that a robot stands before is as far at few bearings.
    wall = np.where(np.abs(np.arange(181) - 90) < 3, farthest, measured)
    assert np.array_equal(without_returns(wall)[0], wall)


@pytest.mark.parametrize("yaw", [0.0, 0.4, math.pi])
def test_a_laser_may_look_any_way(tmp_path, yaw):
    """It looks backwards: its heading less the robot's is about π as often as about −π."""
    _, reckoned = drive(60)
    mount = np.array([-0.2, 0.1, yaw])
    lines = []
    for k, pose in enumerate(reckoned):
        laser = compose(pose, mount)
        lines.append(flaser(np.ones(180), np.array([*laser[:2], wrap(laser[2])]), pose, SECONDS * k))
    log = scan_log(put_lines(tmp_path / "raw.log", lines))
    found = relative(log.odometry_poses[:1], log.odometry_poses)
    true = relative(compose(reckoned[0], mount)[None], np.array([compose(pose, mount) for pose in reckoned]))
    np.testing.assert_allclose(found[:, :2], true[:, :2], atol=1e-6)
    np.testing.assert_allclose(wrap(found[:, 2] - true[:, 2]), 0.0, atol=1e-6)


# ---- reference ------------------------------------------------------------------------------------------------


def test_a_reference_is_matched_by_time_stamps(tmp_path):
    raw = put_lines(tmp_path / "raw.log", carmen_lines(30))
    corrected = [line for line in carmen_lines(30, kind="corrected") if line.startswith("FLASER")]
    some = [line for k, line in enumerate(corrected) if k % 3 != 1 and k > 4]
    log = with_reference(scan_log(raw), put_lines(tmp_path / "some.log", some))
    true, _ = drive(30)
    rows = np.round(log.reference_times / SECONDS).astype(int)
    assert 0 < len(rows) < 30 and np.allclose(log.reference_poses[:, :2], true[rows, :2])
    # The start is the reference's first pose, taken back by the odometry.
    assert log.dead_reckoning()[rows[0]] == pytest.approx(true[rows[0]])
    assert log.has_heading and "some.log" in log.note
    begun = log.until(6.2)
    assert begun.duration_s == 6.0 and len(begun.times) == len(begun.stamps) == len(begun.ranges) == 13
    assert begun.reference_times.max() <= 6.2


def test_references_that_do_not_fit(tmp_path):
    log = scan_log(put_lines(tmp_path / "raw.log", carmen_lines(5)))
    other = put_lines(tmp_path / "other.log", [flaser(np.ones(3), np.zeros(3), np.zeros(3), 3.0)])
    (tmp_path / "notes.txt").write_text("dear diary\n")
    for path, words in (
        (other, "has no scan at a time stamp"), (tmp_path / "notes.txt", "is no log that is known"),
        (tmp_path / "nowhere", "is no file"), (tmp_path, "is no file"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            with_reference(log, path)
    write_utias(tmp_path / "utias", seconds=2.0)
    with pytest.raises(ValueError, match="has its own reference"):
        with_reference(open_log(tmp_path / "utias"), other)
    with pytest.raises(ValueError, match="leave --robot out"):
        open_log(other, robot=1)
    dpslam = scan_log(put_lines(tmp_path / "dp.log", dpslam_lines(5)))
    fewer, as_many = (put_lines(tmp_path / f"dp{n}.log", dpslam_lines(n)) for n in (3, 5))
    for each in (dpslam, log):
        with pytest.raises(ValueError, match=r"dp3.log has 3 scans, .* 5; give a log of the same scans"):
            with_reference(each, fewer)
        assert len(with_reference(each, as_many).reference_times) == 5


# ---- what is wrong --------------------------------------------------------------------------------------------

GOOD = carmen_lines(4)
ONES = "FLASER 180 " + "1 " * 180
SCAN = next(k for k, line in enumerate(GOOD) if line.startswith("FLASER"))


@settings(max_examples=60)
@given(cut=st.integers(1, 189), word=st.sampled_from([None, "nan", "inf", "-inf", "x1", "1e999", "--1"]))
def test_a_damaged_scan_is_named_with_its_line(cut, word, tmp_path_factory):
    parts = GOOD[SCAN].split(" ")
    damaged = parts[:cut] if word is None else [*parts[:cut], word, *parts[cut + 1 :]]
    lines = [*GOOD[:SCAN], " ".join(damaged), *GOOD[SCAN + 1 :]]
    path = put_lines(tmp_path_factory.getbasetemp() / "bad.log", lines)
    if word is not None and cut == len(parts) - 2:
        assert len(scan_log(path).times) == 4  # the host may be called what it likes
        return
    with pytest.raises(ValueError) as raised:
        open_log(path)
    message = str(raised.value)
    assert f"{path}, line {SCAN + 1}: " in message and "\n" not in message


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("ODOM 1 2 3", "expected 9 values after ODOM"),
        ("ODOM 1 2 nan 0 0 0 1 host 1", "'nan' is not a finite number"),
        ("FLASER", "is no number of beams"),
        ("FLASER 1e3 1 2", "'1e3' is no number of beams"),
        ("FLASER 99999999999999999999 1 2", "is no number of beams"),
        ("FLASER 3 1 1 1 0 0 0 0 0 0 1 host", "has 13 values, here are 12"),
        ("FLASER 3 1 -1 1 0 0 0 0 0 0 1 host 1", "range -1 is below 0"),
        ("FLASER 3 1 1 1 0 0 0 0 0 0 1 host 1", "a scan of 3 beams after scans of 180"),
        ("ODOM 1 -1e6 0 0 0 0 1 host 1", "a coordinate of 1e[+]06 m is more than 100000 m"),
        ("ODOM 1 1 0 0 0 0 1e12 host 1", "a time of 1e[+]12 s is more than 1e[+]11 s"),
        (ONES + "1e200 0 0 0 0 0 1 host 1", "a coordinate of 1e[+]200 m"),
        (ONES + "0 0 0 0 1e200 0 1 host 1", "a coordinate of 1e[+]200 m"),
        (ONES + "0 0 0 0 0 0 -1e12 host 1", "a time of -1e[+]12 s"),
        (ONES + "2e3 0 0 0 0 0 1 host 1", "a jump of .* m from the scan before is more than 1000 m"),
        (ONES + "0 0 0 2e3 0 0 1 host 1", "a jump of .* m from the scan before is more than 1000 m"),
    ],
)
def test_what_carmen_lines_may_not_be(line, words, tmp_path):
    path = put_lines(tmp_path / "bad.log", [*GOOD, line])
    with pytest.raises(ValueError, match=words) as raised:
        open_log(path)
    assert f"line {len(GOOD) + 1}: " in str(raised.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("Odometry 1 2", "expected 3 values after Odometry"),
        ("Odometry 1 2 inf", "'inf' is not a finite number"),
        ("Laser 2 1 1", "without an Odometry line"),
        ("Odometry 0 0 0\nLaser 2 1", "line 12: a Laser of 2 beams"),
        ("Odometry 0 0 0\nLaser 2 1 y", "line 12: 'y' is not a finite number"),
        ("Odometry 0 0 0\nLaser 2 1 1", "line 12: a scan of 2 beams after scans of 181"),
        ("Odometry 0 0 0\nLaser x 1 1", "line 12: 'x' is no number of beams"),
        ("Odometry 0 0 0\nLaser 2 -1 1", "line 12: range -1 is below 0"),
        ("Odometry 0 1e6 0", "line 11: a coordinate of 1e[+]06 m is more than 100000 m"),
        ("Odometry 0 0 1e300", "line 11: a heading of 1e[+]300 rad"),
        ("Odometry 0 2e3 0\nLaser 181" + " 1" * 181, "line 12: a jump of .* m from the scan before"),
    ],
)
def test_what_dpslam_lines_may_not_be(line, words, tmp_path):
    path = put_lines(tmp_path / "bad.log", [*dpslam_lines(5), line])
    with pytest.raises(ValueError, match=words):
        open_log(path)


@pytest.mark.parametrize("range_m", [0, 5000])
def test_a_log_in_which_nothing_was_measured_is_refused(range_m, tmp_path):
    line = f"FLASER 180 {f'{range_m} ' * 180}0 0 0 0 0 0 1 host 1"
    with pytest.raises(ValueError, match="nothing was measured; give ranges in m"):
        open_log(put_lines(tmp_path / "lost.log", [line, line]))


def test_a_text_may_begin_with_a_byte_order_mark(tmp_path):
    path = tmp_path / "room.log"
    scans = [line for line in GOOD if line.startswith("FLASER")]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(scans).encode())
    assert len(scan_log(path).times) == len(scans)
    path.write_bytes("\n".join(GOOD).encode("utf-16"))
    with pytest.raises(ValueError, match="is written in UTF-16; save it as UTF-8"):
        open_log(path)


def test_a_bag_of_ros_1_is_told_what_to_do(tmp_path):
    path = tmp_path / "drive.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(2**21))
    with pytest.raises(ValueError, match="is a bag of ROS 1; make it one of ROS 2 by rosbags-convert"):
        open_log(path)


def test_files_without_a_scan(tmp_path):
    for lines, words in (
        (["PARAM a b"], "holds neither FLASER nor ROBOTLASER1"),
        (["Odometry 0 0 0"], "holds no Laser line"),
    ):
        with pytest.raises(ValueError, match=words):
            open_log(put_lines(tmp_path / "none.log", lines))
    whole = put_lines(tmp_path / "cut.log.gz", GOOD, packed=True)
    whole.write_bytes(whole.read_bytes()[:-200])
    with pytest.raises(ValueError, match="damaged gzip"):
        open_log(whole)


# ---- real data ------------------------------------------------------------------------------------------------


def test_real_intel():
    folder = data_folder("carmen")
    log = scan_log(folder / "intel.gfs.log.gz")
    assert log.ranges.shape == (910, 180) and log.range_max == 25.4
    assert np.count_nonzero(np.isnan(log.ranges)) == 4172 and np.diff(log.times).min() > 0
    log = with_reference(log, folder / "intel-corrected.log.gz")
    assert len(log.reference_times) == 910
    assert ate(log.reference_poses, log.dead_reckoning()) == pytest.approx(25.8, abs=0.1)


def test_real_dpslam():
    log = scan_log(data_folder("carmen") / "dpslam-loop5.log.gz")
    assert log.ranges.shape == (551, 181) and log.range_max == 8.18
    way = np.hypot(*np.diff(log.odometry_poses[:, :2], axis=0).T).sum()
    assert way == pytest.approx(56.1, abs=0.1) and np.count_nonzero(np.isinf(log.ranges)) == 6726
