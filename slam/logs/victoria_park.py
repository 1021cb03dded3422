"""The Victoria Park log: a car among trees (Guivant and Nebot, University of Sydney).

The wheel encoder sits on the rear left wheel, the steering sensor on the axle in front; a laser at the front of
the car sees trees as points; GPS, with gaps and jumps, is the reference.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from slam.logs.recorded import ObservationNoise, RecordedLog, group_by_time
from slam.logs.tables import find, read_table, read_timed
from slam.types import Array, Flags, Indices

__all__ = [
    "AXLES_M",
    "LASER_AHEAD_M",
    "LASER_LEFT_M",
    "NOISE",
    "SETTINGS",
    "WHEEL_LEFT_M",
    "car_twist",
    "plausible",
    "read",
]

AXLES_M = 2.83
"""L: distance of the two axles."""
WHEEL_LEFT_M = 0.76
"""H: the wheel with the encoder is so far left of the rear axle's centre."""
LASER_AHEAD_M, LASER_LEFT_M = 3.78, 0.5
"""a, b: where the laser sits, from the rear axle's centre."""

START_HEADING = math.radians(35.5)
"""Heading at the start [rad]; of the reference's frame, no estimator can know it (docs/studies/real-logs.md)."""

NOISE = ObservationNoise(range_m=1.5, bearing_deg=2.8)

_SPEED_SIGMA, _STEERING_SIGMA = 0.8, math.radians(1.8)  # σv [m/s], σγ [rad], as published
_USUAL_SLOPE = 0.184  # root mean square of tan α over the log

SETTINGS = {
    "lidar_offset_m": 0.0,  # the body frame is the laser's own
    "odometry": {
        "lever_m": LASER_AHEAD_M, "speed_floor_m_s": _SPEED_SIGMA, "speed_share": 0.0,
        # ω = v tan α / L: its part from σv, and that from σγ, which grows with v.
        "turn_floor_rad_s": round(_SPEED_SIGMA * _USUAL_SLOPE / AXLES_M, 4),
        "turn_share_rad_m": round(_STEERING_SIGMA / AXLES_M, 5), "slip_share": 0.0,
    },
    "association": "nearest",
    "health": {"nis_from": -2.2},  # as of UTIAS's logs
    "loop_sigma_m": math.inf,  # meant for walls, which stand nearer to each other than trees
    "landmarks": {"tentative_gate_m": 1.5, "new_distance_m": 3.0, "confirm_after": 5, "forget_after": 50},
}  # fmt: skip

_FASTEST_M_S = 25.0  # the car never drives above 7
_TREES = 18  # columns of a frame
_STEEPEST = math.radians(60.0)  # no car steers farther


def car_twist(wheel_speed: Array, steering: Array) -> Array:
    """Return the twist ``(n, 3)`` of the laser's frame from the car's two sensors.

    With L the distance of the axles, H the encoder wheel's offset, (a, b) the laser's place:
    v = v_e / (1 − tan α · H / L) at the rear axle's centre, which cannot move sideways; ω = v tan α / L; and by
    the rigid body (v − ω b, ω a, ω) at the laser.

    Parameters
    ----------
    wheel_speed : (n,)
        v_e, of the rear left wheel [m/s].
    steering : (n,)
        α [rad], left positive.
    """
    slope = np.tan(steering)
    centre = wheel_speed / (1.0 - slope * WHEEL_LEFT_M / AXLES_M)
    omega = centre * slope / AXLES_M
    return np.column_stack([centre - omega * LASER_LEFT_M, omega * LASER_AHEAD_M, omega])


def plausible(fixes: Array) -> Flags:
    """Tell which fixes ``(n, 3)`` (time [s], east, north [m]) a car could have been at ``(n,)``.

    Not one that it would have had to reach and to leave faster than any car drives in a park. Jumps to stay,
    where the set of satellites changes, pass: they are GPS's usual error.
    """
    step = np.diff(fixes, axis=0)
    fast = np.hypot(step[:, 1], step[:, 2]) > _FASTEST_M_S * step[:, 0]
    lone: Flags = np.append(False, fast) & np.append(fast, False)
    return ~lone


def read(folder: Path) -> RecordedLog:
    """Read the log from its folder.

    Raises
    ------
    ValueError
        One line: the file (and line) that is missing or damaged, or two files that disagree in length.
    """
    times = _times(folder, "time.txt")
    rows = len(times)
    speed = _beside(folder, "speed.txt", 1, "wheel speed", rows=rows, of="time.txt")[0][:, 0]
    angles, lines = _beside(folder, "steering.txt", 1, "steering angle", rows=rows, of="time.txt")
    steering = angles[:, 0]
    steep = np.flatnonzero(np.abs(steering) > _STEEPEST)
    if len(steep):
        i = int(steep[0])
        where = f"{find(folder, 'steering.txt')}, line {lines[i]}"
        raise ValueError(f"{where}: no car steers by {steering[i]:.3g} rad; steering angles are radians")
    begin, end = float(times[0]), float(times[-1])
    if not begin < end:
        raise ValueError(f"log {folder} has odometry of a single instant; it is cut short")
    gps = read_timed(find(folder, "gps.txt"), 3, "time in ms, east, north", second=1e3, most=1e8)
    gps[:, 0] *= 1e-3
    _, first = np.unique(gps[:, 0], return_index=True)
    gps = gps[first]
    gps = gps[plausible(gps)]
    scan_times, range_bearing, ends = _trees(folder, begin, end)
    within = (gps[:, 0] >= begin) & (gps[:, 0] <= end)
    poses = np.column_stack([gps[within, 1:3], np.full(np.count_nonzero(within), np.nan)])
    return RecordedLog(
        name="victoria_park", clock_start_s=begin,
        odometry_times=times - begin, twists=car_twist(speed, steering),
        observation_times=scan_times, observation_ends=ends, range_bearing=range_bearing, ids=None,
        reference_times=gps[within, 0] - begin, reference_poses=poses, reference_gap_s=0.5,
        landmark_ids=None, landmarks=None, start_pose=np.array([gps[0, 1], gps[0, 2], START_HEADING]),
        observation_noise=NOISE, settings=SETTINGS,
        note="reference: GPS positions, compared with the laser's; start: the first fix and a heading of 35.5°",
    )  # fmt: skip


def _trees(folder: Path, begin: float, end: float) -> tuple[Array, Array, Indices]:
    """Return times ``(m,)`` since ``begin``, trees ``(o, 2)`` and where each frame's end ``(m,)``."""
    times = _times(folder, "lasersampling.txt")
    frames: list[Array] = []
    for name, what in (("ObservationDistance.txt", "distances"), ("ObservationAngle.txt", "angles")):
        meaning = f"{what} of up to {_TREES} trees, 0 for none"
        values, lines = _beside(folder, name, _TREES, meaning, rows=len(times), of="lasersampling.txt")
        bad = np.flatnonzero((values < 0.0).any(axis=1))
        if len(bad):
            raise ValueError(f"{find(folder, name)}, line {lines[bad[0]]}: {what} cannot be negative")
        frames.append(values)
    distances, angles = frames
    seen = distances > 0.0
    frame = np.nonzero(seen)[0]
    # The laser counts its angle from the right; ahead is a quarter turn on.
    range_bearing = np.column_stack([distances[seen], angles[seen] - 0.5 * math.pi])
    set_times, ends, kept = group_by_time(times[frame], begin, end)
    return set_times, range_bearing[kept], ends


def _times(folder: Path, name: str) -> Array:
    return 1e-3 * read_timed(find(folder, name), 1, "time in ms", second=1e3)[:, 0]


def _beside(folder: Path, name: str, columns: int, meaning: str, *, rows: int, of: str) -> tuple[Array, Indices]:
    """Read a table that must have as many rows as another file."""
    path = find(folder, name)
    values, lines = read_table(path, columns, meaning)
    if len(values) != rows:
        raise ValueError(f"{path} has {len(values)} rows, {of} {rows}: one of them is cut short; fetch them again")
    return values, lines
