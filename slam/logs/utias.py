"""UTIAS multi-robot cooperative localisation and mapping (MRCLAM) logs, one robot at a time.

Leung, Halpern, Barfoot and Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR 2011.
Differential-drive robots among 15 tubes with bar codes; the odometry is the commanded velocity; a camera at the
robot's centre reads bar codes; Vicon gives the truth. Subjects 1-5 are the robots, which move and are left out.

What is recorded is not yet what the columns' names say, in the same way on every robot that was measured:

- The range is a depth along the camera's axis, stretched: ρ = (z / cos φ − 0.0385 m) / 1.0152, and too long off
  the axis, by 0.15 m (1 − cos φ).
- An observation's stamp is 0.03 s late.
- Rows of zeros come in between, one or two at a time: nothing stops for them.
- The base follows its commands 0.19 s later, and not quite: v = 1.038 ṽ − 0.09 m |ω̃|, never backwards (turning,
  its inner wheel hangs back until the robot turns about it), ω = 0.97 ω̃.
- A short turn on its own is driven as one pulse of 0.21 s, however long it was logged. It ends 0.15 s after the
  logged end.

All measured on data set 6 against Vicon, docs/studies/real-logs.md. ``raw`` hands everything on as recorded, for
comparison with filters that take it so; so does a log with bearings that this camera cannot see: another rig's.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from slam.files import plain_name
from slam.geometry import wrap
from slam.logs.recorded import ObservationNoise, RecordedLog, group_by_time, split_holds
from slam.logs.tables import find, read_table, read_timed
from slam.types import Array, Indices

__all__ = ["FIRST_LANDMARK", "NOISE", "SETTINGS", "read"]

FIRST_LANDMARK = 6
"""Subjects below this are robots."""

# Measured against Vicon on robots 1 and 3 of data set 6, as all that follows: see docs/studies/real-logs.md.
NOISE = ObservationNoise(range_m=0.01, range_square_per_m=0.0011, bearing_deg=0.7, repeat_s=9.0)
RAW_NOISE = ObservationNoise(range_m=0.17, bearing_deg=1.1)

_ODOMETRY = {
    "lever_m": 0.13, "speed_floor_m_s": 0.01, "speed_share": 1.2, "turn_floor_rad_s": 0.01,
    "turn_share_rad_m": 4.5, "slip_share": 0.0,
}  # fmt: skip
# A robot's wheels are not quite alike, which turns it by as much a metre all along: states of the filters.
_LASTING = {"difference_sigma": 0.015, "lever_sigma": 0.04, "white_turn_share_rad_m": 2.8}
SETTINGS = {
    "lidar_offset_m": 0.0,
    "start_sigma_m": 1e-4,
    "start_sigma_rad": 0.01,  # Vicon's: 0.005 to 0.02 rad, by the heading
    "association": "nearest",
    "health": {"nis_from": -2.2},  # noise is stated large: so low is the logarithm of NIS where all is well
    "known_gate": 18.4,  # 99.99 %: a few bar codes were misread
    "loop_sigma_m": math.inf,  # meant for walls, many in a scan; tubes are seen one by one, and never find company
    "invariant-ekf": {"loop_sigma_m": 0.6},  # it knows how unsure it is; groups of tubes stand metres apart
    "odometry": _ODOMETRY | {"lasting": _LASTING},
    "landmarks": {"tentative_gate_m": 0.3, "new_distance_m": 0.3, "confirm_after": 3, "forget_after": 20},
}
RAW_SETTINGS = SETTINGS | {"odometry": _ODOMETRY | {"speed_share": 1.9, "turn_share_rad_m": 4.0}}

_LONGEST_HOLD_S = 0.02  # of a command that was logged late; the usual interval is 10 to 20 ms

_DEPTH_AHEAD_M, _DEPTH_SCALE = 0.0385, 1.0152  # depth = (ahead + scale · (range + off the axis)) · cos φ
_OFF_AXIS_M = 0.15
_CAMERA_LATE_S = 0.03
_BASE_LATE_S = 0.19
_NEAREST_M = 0.1  # of a range; the log's are above 1 m
_FULL_TURN_RAD = 6.3
_WIDEST_RAD = 1.2  # a bearing; the camera's go to 0.6
_SPEED_SCALE, _HANGS_BACK_M, _TURN_SCALE = 1.038, 0.09, 0.97
_STRAY_S = 0.115  # zeros that are shorter are the logger's, not a command
_PULSE_S, _PULSE_LATE_S = 0.21, 0.15
_BURST_RAD_S, _LONGEST_BURST_S = 0.3, 0.395  # such a turn is driven as a pulse …
_QUIET_RAD_S, _QUIET_S = 0.08, 0.245  # … if the robot hardly turns for so long on either side


def read(folder: Path, robot: int, *, raw: bool = False) -> RecordedLog:
    """Read one robot's log with the surveyed landmarks and the Vicon reference.

    ``raw``: ranges, stamps and commands as they were recorded, and the noise that goes with them.

    Raises
    ------
    ValueError
        One line: the file (and line) that is missing or damaged.
    """
    odometry = read_timed(
        find(folder, f"Robot{robot}_Odometry.dat"), 3, "time, speed, angular velocity", most=100.0
    )
    measured = read_timed(
        find(folder, f"Robot{robot}_Measurement.dat"), 4, "time, bar code, range, bearing", most=1e9
    )
    odd = np.flatnonzero((measured[:, 2] < 0.0) | (np.abs(measured[:, 3]) > _FULL_TURN_RAD))
    if len(odd):
        at, _, distance, bearing = measured[odd[0]].tolist()
        raise ValueError(
            f"{find(folder, f'Robot{robot}_Measurement.dat')}, time {at:.10g}: a range of {distance:g} m at a "
            f"bearing of {bearing:g} rad is none; ranges are at least 0, bearings radians"
        )
    truth = read_timed(find(folder, f"Robot{robot}_Groundtruth.dat"), 4, "time, x, y, orientation", most=1e7)
    landmark_ids, landmarks = _landmarks(find(folder, "Landmark_Groundtruth.dat"))
    subject_of_code = _codes(find(folder, "Barcodes.dat"))

    clock = float(odometry[0, 0])
    for table in (odometry, measured, truth):
        # To the microsecond: a clock of seconds since 1970 tells a quarter of one, and spans are compared.
        table[:, 0] = np.round(table[:, 0] - clock, 6)
    begin, end = 0.0, float(odometry[-1, 0])
    if not begin < end:
        raise ValueError(f"log of robot {robot} in {folder} has odometry of a single instant; it is cut short")
    subjects = np.array([subject_of_code.get(int(code), 0) for code in measured[:, 1]], np.int64)
    of_landmarks = np.isin(subjects, landmark_ids)
    measured, subjects = measured[of_landmarks], subjects[of_landmarks]
    raw = raw or bool(np.any(np.abs(measured[:, 3]) > _WIDEST_RAD))
    if not raw:
        odometry, measured = _driven(odometry), _measured(measured)
        end = float(odometry[-1, 0])
    times, ends, kept = group_by_time(measured[:, 0], begin, end)
    _, first = np.unique(truth[:, 0], return_index=True)  # a stamp that is there twice has no slope
    truth = truth[first]
    start = np.array(
        [np.interp(begin, truth[:, 0], c) for c in (truth[:, 1], truth[:, 2], np.unwrap(truth[:, 3]))]
    )
    start[2] = wrap(start[2])
    if not truth[0, 0] <= begin <= truth[-1, 0]:
        raise ValueError(f"log of robot {robot} in {folder}: the ground truth does not cover the first odometry")
    within = (truth[:, 0] >= begin) & (truth[:, 0] <= end)
    twists = np.column_stack([odometry[:, 1], np.zeros(len(odometry)), odometry[:, 2]])
    odometry_times, twists = split_holds(odometry[:, 0], twists, longest_s=_LONGEST_HOLD_S)
    note = "reference: Vicon pose of the robot's centre; the start pose is the reference's"
    return RecordedLog(
        name=f"{plain_name(folder.absolute().name)} robot {robot}", clock_start_s=clock,
        odometry_times=odometry_times, twists=twists,
        observation_times=times, observation_ends=ends, range_bearing=measured[kept, 2:4], ids=subjects[kept],
        reference_times=truth[within, 0],
        reference_poses=np.column_stack([truth[within, 1:3], wrap(truth[within, 3])]), reference_gap_s=0.5,
        landmark_ids=landmark_ids, landmarks=landmarks, start_pose=start,
        observation_noise=RAW_NOISE if raw else NOISE, settings=RAW_SETTINGS if raw else SETTINGS,
        note=f"{note}; ranges and commands as recorded" if raw else note,
    )  # fmt: skip


def _driven(odometry: Array) -> Array:
    """Return what the base drives (k + 1, 3) by its commands (k, 3), both t [s], v [m/s], ω [rad/s].

    It stands until the first one comes through.
    """
    t, v, omega = _pulsed(_without_stray_zeros(odometry)).T
    speed = np.sign(v) * np.maximum(_SPEED_SCALE * np.abs(v) - _HANGS_BACK_M * np.abs(omega), 0.0)
    driven = np.column_stack([t + _BASE_LATE_S, speed, _TURN_SCALE * omega])
    return np.vstack([[t[0], 0.0, 0.0], driven])


def _without_stray_zeros(odometry: Array) -> Array:
    """Return commands (k, 3), as :func:`_driven` has them; zeros too short for one are what was before them."""
    t, still = odometry[:, 0], ~np.any(odometry[:, 1:], axis=1)
    begins, ends = _runs(still)
    stray = np.zeros(len(t), bool)
    for begin, end in zip(begins[1:-1].tolist(), ends[1:-1].tolist(), strict=True):
        stray[begin:end] = still[begin] and t[end] - t[begin] < _STRAY_S
    last = np.maximum.accumulate(np.where(stray, 0, np.arange(len(t))))
    return np.column_stack([t, odometry[last, 1:]])


def _pulsed(odometry: Array) -> Array:
    """Return commands (k, 3), as :func:`_driven` has them; each short turn on its own is the pulse it becomes.

    Longer ones, and those close to one another, are left: what the base makes of them is not known so well.
    """
    t, omega = odometry[:, 0], odometry[:, 2]
    side = np.where(np.abs(omega) > _BURST_RAD_S, np.sign(omega), 0.0)
    begins, ends = _runs(side)
    for begin, end in zip(begins[1:-1].tolist(), ends[1:-1].tolist(), strict=True):
        if side[begin] == 0.0 and side[begin - 1] == side[end] and t[end] - t[begin] < _STRAY_S:
            side[begin:end] = side[end]  # one turn, that paused for a moment
    begins, ends = _runs(side)
    begins, ends = begins[1:-1], ends[1:-1]
    turning = np.cumsum(np.append(0, np.abs(omega) >= _QUIET_RAD_S))  # rows that turn, before each
    before = np.searchsorted(t, t[begins] - _QUIET_S)
    after = np.searchsorted(t, t[ends] + _QUIET_S)
    alone = (turning[begins] == turning[before]) & (turning[after] == turning[ends])
    burst = (side[begins] != 0.0) & (t[ends] - t[begins] < _LONGEST_BURST_S) & alone
    begins, ends = begins[burst], ends[burst]

    held = odometry[:, 1:].copy()
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        held[begin:end] = held[begin - 1]
    pulse_ends = t[ends] + _PULSE_LATE_S - _BASE_LATE_S
    pulse_begins = np.maximum(pulse_ends - _PULSE_S, t[0])
    times = np.unique(np.concatenate([t, pulse_begins, pulse_ends]))
    commands = held[np.searchsorted(t, times, side="right") - 1]
    spans = (begins, ends, np.searchsorted(times, pulse_begins), np.searchsorted(times, pulse_ends))
    for begin, end, first, last in zip(*(span.tolist() for span in spans), strict=True):
        commands[first:last] = np.median(odometry[begin:end, 1:], axis=0)
    return np.column_stack([times, commands])


def _runs(labels: Array) -> tuple[Indices, Indices]:
    """Return where runs of equal labels (k,) begin, and where they end."""
    at = np.flatnonzero(labels[1:] != labels[:-1]) + 1
    return np.append(0, at), np.append(at, len(labels))


def _measured(rows: Array) -> Array:
    """Return observations (o, 4), t [s], bar code, z [m], φ [rad], with ranges for depths, at their own times."""
    t, code, depth, bearing = rows.T
    ranges = (depth / np.cos(bearing) - _DEPTH_AHEAD_M) / _DEPTH_SCALE - _OFF_AXIS_M * (1.0 - np.cos(bearing))
    return np.column_stack([t - _CAMERA_LATE_S, code, np.maximum(ranges, _NEAREST_M), bearing])


def _codes(path: Path) -> dict[int, int]:
    """Return bar code → subject."""
    values, lines = read_table(path, 2, "subject, bar code")
    codes: dict[int, int] = {}
    for (subject, code), line in zip(values.tolist(), lines.tolist(), strict=True):
        if subject != int(subject) or code != int(code) or subject < 1:
            raise ValueError(f"{path}, line {line}: subject and bar code must be whole numbers, subject ≥ 1")
        if int(code) in codes:
            raise ValueError(f"{path}, line {line}: bar code {int(code)} is there twice")
        codes[int(code)] = int(subject)
    return codes


def _landmarks(path: Path) -> tuple[Indices, Array]:
    values, lines = read_table(path, 5, "subject, x, y, their standard deviations")
    ids = values[:, 0].astype(np.int64)
    for i, line in enumerate(lines.tolist()):
        if ids[i] != values[i, 0] or ids[i] < FIRST_LANDMARK or ids[i] > 10_000:
            raise ValueError(
                f"{path}, line {line}: a landmark's subject is a whole number from {FIRST_LANDMARK} on"
            )
        if ids[i] in ids[:i]:
            raise ValueError(f"{path}, line {line}: subject {ids[i]} is there twice")
    return ids, values[:, 1:3].copy()
