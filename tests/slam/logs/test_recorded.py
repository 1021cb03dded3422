"""Recorded logs: what is written is read, in time order; what is damaged is refused with its file and line."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.geometry import compose, wrap
from slam.logs import ObservationNoise, RecordedLog, open_log
from slam.logs.recorded import group_by_time, split_holds
from slam.logs.tables import read_table
from slam.logs.victoria_park import car_twist, plausible
from slam.motion import move
from tests.slam.logs.logs_on_disk import (
    CLOCK,
    PARK_FILES,
    UTIAS_FILES,
    circle,
    data_folder,
    seen_from,
    write_park,
    write_utias,
)  # fmt: skip

numbers = st.floats(-1e9, 1e9, allow_nan=False)


# ---- tables ---------------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    rows=st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=20),
    between=st.sampled_from(["", "\n", "# 1 2\n", "  \t\n", "  # x\n"]),
    gap=st.sampled_from([" ", "\t", "   \t "]),
    packed=st.booleans(),
)
def test_what_was_written_is_read(rows, between, gap, packed, tmp_path_factory):
    text = between.join(gap.join(map(repr, row)) + "\n" for row in rows)
    path = tmp_path_factory.getbasetemp() / "table.dat"
    path.write_bytes(gzip.compress(text.encode()) if packed else text.encode())
    values, lines = read_table(path, 3, "a, b, c")
    assert np.array_equal(values, np.array(rows))
    assert lines.tolist() == [1 + i * (1 + (between != "")) for i in range(len(rows))]


@settings(max_examples=60)
@given(data=st.binary(max_size=200), packed=st.booleans())
def test_any_bytes_give_numbers_or_one_line(data, packed, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "noise.dat"
    path.write_bytes((b"\x1f\x8b" if packed else b"") + data)
    try:
        values, lines = read_table(path, 2, "a, b")
    except ValueError as error:
        assert str(path) in str(error) and "\n" not in str(error)
    else:
        assert values.shape == (len(lines), 2) and np.isfinite(values).all()


# ---- whole logs -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [False, True])
def test_a_utias_log(packed, tmp_path):
    landmarks = write_utias(tmp_path / "set", packed=packed)
    name = "Robot1_Odometry.dat.gz" if packed else "Robot1_Odometry.dat"
    log = open_log(tmp_path / "set" / name)
    assert log.name == "set robot 1" and log.clock_start_s == CLOCK and log.duration_s == pytest.approx(20.0)
    assert np.array_equal(log.landmarks, landmarks) and log.landmark_ids.tolist() == [6, 7, 8, 9]
    assert log.observation_times == pytest.approx(np.arange(1, 41) / 2)
    assert set(log.ids.tolist()) == {6, 7, 8, 9} and len(log.ids) == 160  # the other robot is left out
    for i, t in enumerate(log.observation_times):
        rows = slice(4 * i, 4 * i + 4)
        expected = seen_from(circle(np.array([t]), 0.1, 0.2)[0], landmarks)
        assert np.allclose(log.range_bearing[rows], expected, atol=1e-8)
    assert log.has_heading and np.allclose(log.start_pose, 0.0)
    at = log.reference_at(7.013)
    assert at == pytest.approx(circle(np.array([7.013]), 0.1, 0.2)[0], abs=5e-6)
    assert np.allclose(log.dead_reckoning(), [[*p[:2], wrap(p[2])] for p in circle(log.odometry_times, 0.1, 0.2)],
                       atol=1e-6)  # fmt: skip


def test_a_folder_needs_a_robot_only_where_it_has_several(tmp_path):
    write_utias(tmp_path)
    assert open_log(tmp_path).name == open_log(tmp_path, robot=1).name
    (tmp_path / "Robot3_Odometry.dat.gz").write_bytes(b"")
    for robot, words in ((None, "no robot was chosen; give --robot 1 or 3"), (2, "there is no robot 2")):
        with pytest.raises(ValueError, match=words):
            open_log(tmp_path, robot=robot)
    with pytest.raises(ValueError, match="is robot 1's, not robot 3's"):
        open_log(tmp_path / "Robot1_Odometry.dat", robot=3)


@pytest.mark.parametrize("packed", [False, True])
def test_a_victoria_park_log(packed, tmp_path):
    trees = write_park(tmp_path / "park", packed=packed)
    log = open_log(tmp_path / "park")
    assert log.ids is None and log.landmarks is None and not log.has_heading
    assert log.start_pose == pytest.approx([5.0, -3.0, math.radians(35.5)])
    assert log.duration_s == pytest.approx(10.0) and len(log.odometry_times) == 401
    # Straight on, the laser drives as the rear axle does, and dead reckoning is where GPS is.
    at = np.searchsorted(log.odometry_times, log.reference_times)
    assert np.allclose(log.dead_reckoning()[at, :2], log.reference_poses[:, :2], atol=1e-6)
    # Every tree of every frame is where a tree stands.
    begin = 0
    for t, end in zip(log.observation_times, log.observation_ends, strict=True):
        pose = move(log.start_pose, np.array([2.0, 0.0, 0.0]), float(t))
        for rho, bearing in log.range_bearing[begin:end]:
            found = compose(pose, np.array([rho * math.cos(bearing), rho * math.sin(bearing), 0.0]))[:2]
            assert np.hypot(*(trees - found).T).min() < 1e-6
        begin = end
    assert begin == len(log.range_bearing) > 100


@pytest.mark.parametrize("make", [write_utias, write_park])
def test_events_come_in_time_order_and_lose_nothing(make, tmp_path):
    make(tmp_path, seconds=5.0)
    log = open_log(tmp_path)
    now, turned, pose, rows = 0.0, 0.0, log.start_pose, []
    for event in log.events():
        assert event.odometry.dt >= 0 and event.time_s == pytest.approx(now + event.odometry.dt, abs=1e-9)
        now, turned = event.time_s, turned + event.odometry.twist[2] * event.odometry.dt
        pose = move(pose, event.odometry.twist, event.odometry.dt)
        if event.observations is not None:
            rows.append(event.observations.range_bearing)
            assert (event.observations.ids is None) == (log.ids is None)
            assert event.time_s in log.observation_times
    assert now == pytest.approx(log.duration_s)
    assert np.array_equal(np.vstack(rows), log.range_bearing)
    assert pose == pytest.approx(log.dead_reckoning()[-1], abs=1e-4)
    assert all(event.observations is None or event.observations.ids is None for event in log.events(known=False))


stamps = st.lists(st.integers(0, 40), min_size=2, max_size=12).map(sorted).filter(lambda t: t[0] < t[-1])


@given(stamps, st.lists(st.integers(-5, 45), max_size=12).map(sorted), st.integers(1, 50))
def test_any_stamps_interleave(odometry, seen, limit):
    times = (np.array(odometry, float) - odometry[0]) / 8
    at = (np.array(seen, float) - odometry[0]) / 8
    set_times, ends, kept = group_by_time(at, 0.0, float(times[-1]))
    twists = np.column_stack([np.arange(len(times)) + 1.0, np.zeros(len(times)), np.zeros(len(times))])
    log = RecordedLog(
        name="", clock_start_s=0.0, odometry_times=times, twists=twists, observation_times=set_times,
        observation_ends=ends, range_bearing=np.column_stack([at[kept] + 1, at[kept]]), ids=None,
        reference_times=np.zeros(0), reference_poses=np.zeros((0, 3)), reference_gap_s=1.0, landmark_ids=None,
        landmarks=None, start_pose=np.zeros(3), observation_noise=ObservationNoise(range_m=1, bearing_deg=1),
    ).until(limit / 8)  # fmt: skip
    way, last = 0.0, 0.0
    for event in log.events():
        way += event.odometry.twist[0] * event.odometry.dt
        assert event.time_s >= last
        last = event.time_s
        if event.observations is not None:
            assert np.all(event.observations.range_bearing[:, 1] == event.time_s)
    assert last == log.duration_s == min(limit / 8, times[-1])
    assert way == pytest.approx(log.dead_reckoning()[-1, 0])
    expected = np.count_nonzero((at >= 0) & (at <= log.duration_s))
    assert sum(len(e.observations.range_bearing) for e in log.events() if e.observations is not None) == expected


@given(stamps, st.floats(0.01, 3.0))
def test_long_holds_are_split_and_lead_to_the_same_place(odometry, longest):
    times = np.array(odometry, float) / 4
    twists = np.column_stack([np.arange(len(times)) + 1.0, np.zeros(len(times)), np.zeros(len(times))])
    split, held = split_holds(times, twists, longest_s=longest)
    assert len(split) == len(held) and split[0] == times[0] and split[-1] == times[-1]
    assert np.diff(split).max() <= longest * (1 + 1e-6) and np.diff(split).min() >= 0
    assert np.sum(np.diff(split) * held[:-1, 0]) == pytest.approx(np.sum(np.diff(times) * twists[:-1, 0]))


# ---- the car --------------------------------------------------------------------------------------------------


def test_the_car_by_hand():
    # tan α = 0.283, so v = 3 / (1 - 0.283 · 0.76 / 2.83) = 3 / 0.924 and ω = v · 0.1.
    v = 3.0 / 0.924
    twist = car_twist(np.array([3.0]), np.array([math.atan(0.283)]))[0]
    assert twist == pytest.approx([v - 0.1 * v * 0.5, 0.1 * v * 3.78, 0.1 * v])


@given(st.floats(0.1, 7.0), st.floats(-0.6, 0.6).filter(lambda a: abs(a) > 0.01))
def test_the_laser_turns_about_the_centre_of_the_bend(speed, steering):
    vx, vy, omega = car_twist(np.array([speed]), np.array([steering]))[0]
    radius = 2.83 / math.tan(steering)  # of the rear axle's centre; the centre of the bend is (0, radius)
    assert math.hypot(vx, vy) == pytest.approx(abs(omega) * math.hypot(3.78, radius - 0.5))
    assert omega * (radius - 0.76) == pytest.approx(speed)  # the encoder's own wheel
    assert math.copysign(1.0, omega) == math.copysign(1.0, steering)


def test_a_lone_impossible_fix_is_dropped_but_a_jump_to_stay_is_not():
    fixes = np.array([[0.0, 0, 0], [0.2, 0, 0], [0.4, 90, 0], [0.6, 1, 0], [0.8, 1, 0], [1.0, 9, 0]])
    assert plausible(fixes).tolist() == [True, True, False, True, True, True]


# ---- what is wrong --------------------------------------------------------------------------------------------


def damage(path: Path, line: int, text: str) -> None:
    lines = path.read_text().splitlines()
    lines[line - 1] = text
    path.write_text("\n".join(lines) + "\n")


UTIAS_TIMED = tuple(zip(UTIAS_FILES[:3], (" 0", " 0 0", " 0 0"), strict=True))
WRONG = [
    *[("utias", name, 5, "1", "line 5: expected") for name in UTIAS_FILES],
    *[("utias", name, 5, f"1000.5 nan{more}", "line 5: 'nan'") for name, more in UTIAS_TIMED],
    *[("utias", name, 6, f"3 0{more}", "line 6: time 3 is before") for name, more in UTIAS_TIMED],
    (
        "utias",
        UTIAS_FILES[1],
        5,
        "1000.5 63 -1 0.1",
        "time 1000.5: a range of -1 m at a bearing of 0.1 rad",
    ),
    ("utias", UTIAS_FILES[1], 5, "1000.5 63 2 30", "ranges are at least 0, bearings radians"),
    ("utias", "Barcodes.dat", 6, "9 63", "bar code 63 is there twice"),
    ("utias", "Barcodes.dat", 5, "7 8.5", "line 5: subject and bar code must be whole"),
    ("utias", "Landmark_Groundtruth.dat", 4, "3 0 0 0 0", "line 4: a landmark's subject"),
    ("utias", "Landmark_Groundtruth.dat", 4, "6 0 0 0 0", "line 4: subject 6 is there twice"),
    *[("park", name, 3, "1 2 3 4", "line 3: expected") for name in PARK_FILES],
    *[("park", name, 3, "inf", "line 3: 'inf'") for name in ("time.txt", "speed.txt", "steering.txt")],
    *[("park", name, 3, "7", "line 3: time") for name in ("time.txt", "lasersampling.txt")],
    ("park", "gps.txt", 3, "7 0 0", "line 3: time"),
    ("park", "steering.txt", 3, "5.0", "line 3: no car steers by 5 rad"),
    ("park", "ObservationDistance.txt", 3, " ".join(["-1"] * 18), "line 3: distances cannot be negative"),
    ("park", "speed.txt", 3, "", "speed.txt has 400 rows, time.txt 401"),
    ("park", "ObservationAngle.txt", 3, "# gone", "cut short"),
]


@pytest.mark.parametrize(("kind", "name", "line", "text", "words"), WRONG)
def test_damage_is_named_with_file_and_line(kind, name, line, text, words, tmp_path):
    (write_utias if kind == "utias" else write_park)(tmp_path)
    damage(tmp_path / name, line, text)
    with pytest.raises(ValueError) as raised:
        open_log(tmp_path)
    message = str(raised.value)
    assert name in message and words in message and "\n" not in message, message


@pytest.mark.parametrize("make", [write_utias, write_park])
@pytest.mark.parametrize("how", ["missing", "empty", "only comments", "cut gzip", "folder"])
def test_files_that_are_no_logs(make, how, tmp_path):
    make(tmp_path / "whole")
    for k, name in enumerate(UTIAS_FILES if make is write_utias else PARK_FILES):
        if name in ("Robot1_Odometry.dat", "steering.txt") and how in ("missing", "folder"):
            continue  # by these a log is known at all
        folder = tmp_path / str(k)
        make(folder, seconds=2.0)
        path = folder / name
        packed = gzip.compress(path.read_bytes())
        path.unlink()
        if how == "folder":
            path.mkdir()
        elif how == "cut gzip":
            path.write_bytes(packed[: len(packed) // 2])
        elif how != "missing":
            path.write_text("" if how == "empty" else "# nothing\n\n")
        with pytest.raises(ValueError) as raised:
            open_log(folder)
        assert name in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(("make", "names"), [(write_utias, UTIAS_FILES), (write_park, PARK_FILES)])
def test_tables_may_begin_with_a_byte_order_mark(make, names, tmp_path):
    make(tmp_path)
    log = open_log(tmp_path)
    for name in names:
        path = tmp_path / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    marked = open_log(tmp_path)
    assert np.array_equal(marked.twists, log.twists) and np.array_equal(marked.range_bearing, log.range_bearing)
    assert np.array_equal(marked.reference_poses, log.reference_poses, equal_nan=True)


def test_what_is_no_log_at_all(tmp_path):
    (tmp_path / "notes.txt").write_text("1 2 3")
    for path, words in (
        (tmp_path / "nowhere", "does not exist"),
        (tmp_path, "holds no log that is known"),
        (tmp_path / "notes.txt", "is no log that is known"),
    ):
        with pytest.raises(ValueError, match=words):
            open_log(path)
    write_park(tmp_path / "park")
    with pytest.raises(ValueError, match="leave --robot out"):
        open_log(tmp_path / "park", robot=1)


def test_a_truth_that_begins_too_late_is_refused(tmp_path):
    write_utias(tmp_path)
    path = tmp_path / "Robot1_Groundtruth.dat"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[10:]))
    with pytest.raises(ValueError, match="does not cover the first odometry"):
        open_log(tmp_path)


# ---- sightings that repeat themselves ---------------------------------------------------------------------------


def test_a_repeated_sighting_tells_less():
    noise = ObservationNoise(range_m=0.1, bearing_deg=1.0, repeat_s=2.0)
    times, ids = np.array([0.0, 0.0, 1.0, 1.0, 11.0]), np.array([7, 8, 7, 9, 7])
    tells = 1.0 / noise.repeated(times, ids)
    np.testing.assert_allclose(tells, [1.0, 1.0, 1 - math.exp(-0.5), 1.0, 1 - math.exp(-5.0)])
    np.testing.assert_allclose(1.0 / noise.repeated(times, None)[1:4], [1.0, *2 * [1 - math.exp(-0.5)]])
    assert np.all(ObservationNoise(range_m=0.1, bearing_deg=1.0).repeated(times, ids) == 1.0)


def test_sightings_in_a_row_tell_what_a_lasting_error_lets_them():
    """The mean of an error with correlation exp(-t/τ) over a long time T has variance 2 τ s² / T."""
    tau, step, count = 3.0, 0.1, 20_000
    noise = ObservationNoise(range_m=1.0, bearing_deg=1.0, repeat_s=2.0 * tau)
    tells = np.sum(1.0 / noise.repeated(step * np.arange(count), None))
    lag = np.arange(1, count)
    variance = (1.0 + 2.0 * np.sum((1.0 - lag / count) * np.exp(-lag * step / tau))) / count
    assert 1.0 / tells == pytest.approx(variance, rel=0.02)


# ---- real data ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "raw", "odometry_m", "range_m"),
    [(1, True, 2.64, 0.1), (3, True, 4.25, 0.1), (1, False, 2.71, 0.02), (3, False, 1.70, 0.02)],
)
def test_real_utias(robot, raw, odometry_m, range_m):
    log = open_log(data_folder("utias6"), robot=robot, raw=raw)
    assert len(log.landmarks) == 15 and log.duration_s == pytest.approx(887.5, abs=1.0)
    compared = [i for i, t in enumerate(log.reference_times) if i % 10 == 0]
    reckoned = log.dead_reckoning()[np.searchsorted(log.odometry_times, log.reference_times[compared])]
    apart = np.hypot(*(reckoned - log.reference_poses[compared])[:, :2].T)
    assert math.sqrt(np.mean(apart**2)) == pytest.approx(odometry_m, abs=0.1)
    # The sensor model, frames and clocks: robustly, observations are what the truth says they must be.
    begin, errors = 0, []
    for t, end in zip(log.observation_times, log.observation_ends, strict=True):
        pose = log.reference_at(float(t))
        if pose is not None:
            expected = seen_from(pose, log.landmarks[log.ids[begin:end] - 6])
            errors.append(log.range_bearing[begin:end] - expected)
        begin = end
    spread = np.median(np.abs(np.vstack(errors)), axis=0)
    assert spread[0] < range_m and spread[1] < 0.01


def test_real_victoria_park():
    log = open_log(data_folder("victoria_park"))
    assert log.duration_s == pytest.approx(1548.6) and len(log.observation_times) == 7229
    at = np.searchsorted(log.odometry_times, log.reference_times)
    apart = np.hypot(*(log.dead_reckoning()[at] - log.reference_poses)[:, :2].T)
    assert math.sqrt(np.mean(apart**2)) == pytest.approx(149.0, abs=1.0)  # shared/data/README.md
