"""UTIAS multi-robot cooperative localisation and mapping (MRCLAM) logs, one robot at a time.

Leung, Halpern, Barfoot and Liu, "The UTIAS multi-robot cooperative localization and mapping dataset", IJRR 2011.
Differential-drive robots among 15 tubes with bar codes; the odometry is the commanded velocity; a camera at the
robot's centre reads bar codes; Vicon gives the truth. Subjects 1-5 are the robots, which move and are left out.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.geometry import wrap
from slam.logs.recorded import ObservationNoise, RecordedLog, group_by_time, split_holds
from slam.logs.tables import find, read_table, read_timed

__all__ = ["FIRST_LANDMARK", "NOISE", "SETTINGS", "read"]

Array = NDArray[np.float64]

FIRST_LANDMARK = 6
"""Subjects below this are robots."""

# Both measured against Vicon on robots 1 and 3 of data set 6, see docs/studies/real-logs.md.
NOISE = ObservationNoise(range_m=0.17, bearing_deg=1.1)

SETTINGS = {
    "lidar_offset_m": 0.0,
    "association": "nearest",
    "known_gate": 18.4,  # 99.99 %: a few bar codes were misread
    "odometry": {
        "lever_m": 0.13, "speed_floor_m_s": 0.01, "speed_share": 1.9, "turn_floor_rad_s": 0.01,
        "turn_share_rad_m": 4.0, "slip_share": 0.0,
    },
    "landmarks": {"tentative_gate_m": 0.3, "new_distance_m": 0.3, "confirm_after": 3, "forget_after": 20},
}  # fmt: skip

_LONGEST_HOLD_S = 0.02  # of a command that was logged late; the usual interval is 10 to 20 ms


def read(folder: Path, robot: int) -> RecordedLog:
    """Read one robot's log with the surveyed landmarks and the Vicon reference.

    Raises
    ------
    ValueError
        One line: the file (and line) that is missing or damaged.
    """
    odometry = read_timed(find(folder, f"Robot{robot}_Odometry.dat"), 3, "time, speed, angular velocity")
    measured = read_timed(find(folder, f"Robot{robot}_Measurement.dat"), 4, "time, bar code, range, bearing")
    truth = read_timed(find(folder, f"Robot{robot}_Groundtruth.dat"), 4, "time, x, y, orientation")
    landmark_ids, landmarks = _landmarks(find(folder, "Landmark_Groundtruth.dat"))
    subject_of_code = _codes(find(folder, "Barcodes.dat"))

    begin, end = float(odometry[0, 0]), float(odometry[-1, 0])
    if not begin < end:
        raise ValueError(f"log of robot {robot} in {folder} has odometry of a single instant; it is cut short")
    subjects = np.array([subject_of_code.get(int(code), 0) for code in measured[:, 1]], np.int64)
    of_landmarks = np.isin(subjects, landmark_ids)
    measured, subjects = measured[of_landmarks], subjects[of_landmarks]
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
    odometry_times, twists = split_holds(odometry[:, 0] - begin, twists, longest_s=_LONGEST_HOLD_S)
    return RecordedLog(
        name=f"{folder.absolute().name} robot {robot}", clock_start_s=begin,
        odometry_times=odometry_times, twists=twists,
        observation_times=times, observation_ends=ends, range_bearing=measured[kept, 2:4], ids=subjects[kept],
        reference_times=truth[within, 0] - begin,
        reference_poses=np.column_stack([truth[within, 1:3], wrap(truth[within, 3])]), reference_gap_s=0.5,
        landmark_ids=landmark_ids, landmarks=landmarks, start_pose=start,
        observation_noise=NOISE, settings=SETTINGS,
        note="reference: Vicon pose of the robot's centre; the start pose is the reference's",
    )  # fmt: skip


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


def _landmarks(path: Path) -> tuple[NDArray[np.int64], Array]:
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
