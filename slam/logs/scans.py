"""A recorded log of odometry and laser scans in memory (``docs/how-to/replay.md``)."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.files import plain_name
from slam.geometry import compose, inverse, relative, wrap
from slam.logs.log import Event, Log
from slam.logs.recorded import ObservationNoise
from slam.motion import twist_between
from slam.types import Array, Floats, Indices, Odometry, Scan

__all__ = [
    "SETTINGS", "Beams", "ScanLog", "beam_angles", "beside", "chain", "moved_by", "rising", "scan_log",
    "without_returns",
]  # fmt: skip

# For a two-wheeled robot with a SICK LMS, whose errors are many times those of the simulated robot: shares of the
# way as measured on the Intel log against its corrected poses, see docs/studies/real-logs.md.
_ODOMETRY = {
    "lever_m": 0.25, "speed_floor_m_s": 0.002, "speed_share": 0.1, "turn_floor_rad_s": 0.002,
    "turn_share_rad_m": 0.1, "slip_share": 0.0,
}  # fmt: skip
SETTINGS = {
    "lidar_offset_m": 0.0,
    "odometry": _ODOMETRY,
    "features": {"range_sigma_m": 0.02, "split_floor_m": 0.05, "sigma_floor_m": 0.02, "wall_sigma_m": 0.01,
                 "wall_sigma_rad": 0.005},
    "rough_m": 0.02, "common_m": 0.02, "straight_m": 0.02,
    "landmarks": {"tentative_gate_m": 0.3, "new_distance_m": 0.4},
}  # fmt: skip

# CARMEN and DP-SLAM do not say where the laser sits on the robot. Nobody carries a robot away while it records;
# among chairs, between whose legs beams pass, scans contradict the map though the robot is where it is believed
# to be (docs/studies/real-logs.md).
_UNTOLD = {"odometry": _ODOMETRY | {"mount_sigma_m": 0.1}, "health": {"recover": False}}

# A laser of the SICK LMS family answers one of the highest codes of its range, 8183 or above, where there is no
# measurement: in millimetres, or in centimetres for the long range.
_NO_RETURN_MM_M = 8.18
_NO_RETURN_CM_M = 81.8
_HIGHEST_MM_M = 8.192
# Another laser says the farthest that it measures. So many beams, at so many bearings, are no wall: on real logs
# the highest range is that of 1 beam of 100,000.
_SATURATED, _SATURATED_BEAMS, _SATURATED_BEARINGS, _SAME_M = 0.01, 10, 0.05, 1e-6


# First bearing and step [°], where the number of beams tells them; GMapping's reader has the same steps.
_URG = 360.0 / 1024.0
_BEAMS = {
    180: (-90.0, 1.0), 181: (-90.0, 1.0), 360: (-90.0, 0.5), 361: (-90.0, 0.5), 540: (-135.0, 0.5),
    541: (-135.0, 0.5), **{beams: (-0.5 * (beams - 1) * _URG, _URG) for beams in (682, 683, 769)},
}  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanLog(Log):
    """Odometry and laser scans of a real robot, one odometry pose a scan.

    Times are seconds since the first scan. The body frame is that of the sensor: the odometry is of the laser, and
    scans are made at its origin, or so far ahead of it as ``settings`` says in ``lidar_offset_m``. The reference
    is at scans only.
    """

    times: Array  # (n ≥ 1,) [s] rising, the first 0
    stamps: Array  # (n,) [s] as recorded, by which a reference is matched: not always rising
    # (n, beams) [m]; inf where nothing within reach returned, nan where the beam was lost. As precise as recorded.
    ranges: Array | Floats
    angle_min: float  # bearing of the first beam [rad]
    angle_increment: float  # [rad]
    range_max: float  # [m]
    odometry_poses: Array  # (n, 3) [m, m, rad] by the wheels alone, in a frame of their own
    beside_m: float = 0.0  # how far to the left of the robot's middle the lidar sits; poses are of its line

    # What a log of landmark observations has, and this one has not.
    ids = None
    landmark_ids = None
    landmarks = None
    observation_noise = None

    @property
    def duration_s(self) -> float:
        """Time from the first scan to the last [s]."""
        return float(self.times[-1])

    @property
    def odometry_times(self) -> Array:
        """Times ``(n,)`` of the odometry, which are those of the scans [s]."""
        return self.times

    def scan(self, index: int) -> Scan:
        """Return one scan; its ranges are a view where they are kept in full."""
        ranges = np.asarray(self.ranges[index], np.float64)
        return Scan(ranges, self.angle_min, self.angle_increment, self.range_max)

    def until(self, limit_s: float) -> ScanLog:
        """Return the log's beginning: the scans no later than ``limit_s`` ≥ 0."""
        n = int(np.searchsorted(self.times, limit_s, side="right"))
        r = int(np.searchsorted(self.reference_times, limit_s, side="right"))
        return replace(
            self, times=self.times[:n], stamps=self.stamps[:n], ranges=self.ranges[:n],
            odometry_poses=self.odometry_poses[:n],
            reference_times=self.reference_times[:r], reference_poses=self.reference_poses[:r],
        )  # fmt: skip

    def events(self, noise: ObservationNoise | None = None, *, known: bool = True) -> Iterator[Event]:
        """Yield one event a scan: the odometry since the scan before, dt = 0 at the first, and the scan.

        ``predict`` of every backend, which is :func:`slam.motion.move`, composes these odometries to the recorded
        ones exactly. ``noise`` and ``known`` are for logs of observations and mean nothing here.
        """
        del noise, known
        yield Event(0.0, Odometry((0.0, 0.0, 0.0), 0.0), scan=self.scan(0))
        for i in range(1, len(self.times)):
            dt = float(self.times[i] - self.times[i - 1])
            twist = twist_between(self.odometry_poses[i - 1], self.odometry_poses[i], dt)
            yield Event(float(self.times[i]), Odometry(twist, dt), scan=self.scan(i))

    def dead_reckoning(self) -> Array:
        """Return the poses ``(n, 3)`` at the scans by the odometry alone, from the start pose."""
        offset = compose(self.start_pose, inverse(self.odometry_poses[0]))
        c, s = math.cos(offset[2]), math.sin(offset[2])
        x, y, theta = self.odometry_poses.T
        return np.column_stack([offset[0] + c * x - s * y, offset[1] + s * x + c * y, wrap(offset[2] + theta)])

    def with_reference(self, rows: Indices, poses: Array, note: str) -> ScanLog:
        """Return the log with reference poses ``(r ≥ 1, 3)`` at the scans ``rows`` ``(r,)``, rising.

        The start pose becomes the reference's, by the odometry where the first scan has none.
        """
        first = int(rows[0])
        back = compose(inverse(self.odometry_poses[first]), self.odometry_poses[0])
        return replace(
            self, reference_times=self.times[rows], reference_poses=poses, start_pose=compose(poses[0], back),
            note=note,
        )  # fmt: skip


class Beams(NamedTuple):
    """What a log tells of its laser."""

    first_rad: float  # bearing of the first beam
    step_rad: float
    farthest_m: float  # that it measures


def scan_log(
    path: Path, ranges: Array, odometry_poses: Array, *, times: Array, stamps: Array, note: str,
    beams: Beams | None = None,
) -> ScanLog:  # fmt: skip
    """Return a log without a reference, of ranges ``(n, beams)`` [m] as they were recorded."""
    beams = beams or Beams(*beam_angles(ranges.shape[1]), math.inf)
    measured, reach = without_returns(ranges, beams.farthest_m)
    if not np.isfinite(measured).any():
        raise ValueError(
            f"{path}: no range is above 0 and below {_NO_RETURN_CM_M} m, so nothing was measured; give ranges in m"
        )
    moved = int(np.count_nonzero(np.abs(times - stamps) > 1e-6))
    if moved:
        note += f"; {moved} of {len(stamps)} stamps did not rise, and were put between those that do"
    return ScanLog(
        name=plain_name(path.name.split(".")[0]), clock_start_s=float(times[0]),
        times=times - times[0], stamps=stamps,
        ranges=measured, angle_min=beams.first_rad, angle_increment=beams.step_rad, range_max=reach,
        odometry_poses=odometry_poses, start_pose=odometry_poses[0].copy(), reference_times=np.zeros(0),
        reference_poses=np.zeros((0, 3)), reference_gap_s=30.0, settings=SETTINGS | _UNTOLD, note=note,
    )  # fmt: skip


def beam_angles(beams: int) -> tuple[float, float]:
    """Return the bearing of the first beam and the step between beams [rad] of a laser with so many.

    180 and 181 beams: 1° from -90° on, 180 ending at 89° (on the Intel log consecutive corrected scans agree best
    so, better than with beams centred or spread to 90°, see docs/studies/real-logs.md). Half a degree alike: 360
    and 361 beams from -90° on, 540 and 541 from -135° on. A Hokuyo URG's 682, 683 or 769, 1024 a circle, are
    centred. Other numbers span -90° to 90°.
    """
    first, step = _BEAMS.get(beams, (-90.0, 180.0 / (beams - 1)))
    return math.radians(first), math.radians(step)


def chain(start: Array, steps: Array) -> Array:
    """Return poses ``(n + 1, 3)``: a start pose ``(3,)`` and steps ``(n, 3)`` on, each in the frame before."""
    theta = start[2] + np.append(0.0, np.cumsum(steps[:, 2]))
    c, s = np.cos(theta[:-1]), np.sin(theta[:-1])
    x = start[0] + np.append(0.0, np.cumsum(c * steps[:, 0] - s * steps[:, 1]))
    y = start[1] + np.append(0.0, np.cumsum(s * steps[:, 0] + c * steps[:, 1]))
    return np.column_stack([x, y, wrap(theta)])


def moved_by(poses: Array, offset: Array) -> Array:
    """Return poses ``(n, 3)`` each followed by the same transform ``(3,)``."""
    return relative(relative(poses, np.zeros_like(poses)), np.broadcast_to(offset, poses.shape))


def beside(poses: Array, beside_m: float) -> Array:
    """Return poses ``(n, 3)`` moved to the left: of the point of the robot that lies straight behind its lidar."""
    return moved_by(poses, np.array([0.0, beside_m, 0.0])) if beside_m else poses


def rising(stamps: Array) -> Array:
    """Return time stamps ``(n ≥ 1,)`` that rise: those out of order are put evenly between their neighbours.

    Recorders stamp late now and then. The order of the lines is kept, and as many stamps as possible: a longest
    rising subsequence of them.
    """
    tails: list[float] = []  # the least last value of a rising subsequence of each length …
    where: list[int] = []  # … where it stands …
    before = np.full(len(stamps), -1)  # … and what comes before each value
    for i, stamp in enumerate(np.round(stamps, 6).tolist()):  # less than a microsecond is no later
        k = bisect_left(tails, stamp)
        before[i] = where[k - 1] if k else -1
        tails[k : k + 1], where[k : k + 1] = [stamp], [i]
    kept, i = [], where[-1]
    while i >= 0:
        kept.append(i)
        i = int(before[i])
    kept.reverse()
    usual = float(np.median(np.diff(stamps[kept]))) if len(kept) > 1 else 1.0
    # Beyond the first and the last that are kept, by the usual interval.
    ends = [-1, *kept, len(stamps)]
    values = [stamps[kept[0]] - usual * (kept[0] + 1), *stamps[kept]]
    values.append(stamps[kept[-1]] + usual * (len(stamps) - kept[-1]))
    times: Array = np.interp(np.arange(len(stamps)), ends, values)
    return times


def without_returns(ranges: Array, farthest_m: float = math.inf) -> tuple[Array, float]:
    """Return ranges ``(n, beams)`` with the codes for "no measurement" taken out, and the laser's reach [m].

    A log that goes up to the codes of the millimetre mode is a short-range laser's: nothing returned within
    8.18 m, which is ``inf``. In the centimetre mode, 81.8 m and more, a beam is taken for lost, ``nan``: in a
    building it met glass or a black surface, not 80 m of free space. There the reach is that of the log's
    farthest measurement. A range of 0 is a beam lost, too. Where many beams at many bearings have the highest
    range of all, that is no measurement either: taken as these codes are, by how far it is. So is what lies at
    ``farthest_m`` or beyond, where a log tells how far its laser measures.
    """
    out = np.where(ranges > 0.0, ranges, math.nan)
    highest = float(np.nanmax(out, initial=0.0))
    if _NO_RETURN_MM_M <= highest <= _HIGHEST_MM_M:
        out[out >= _NO_RETURN_MM_M] = math.inf
        return out, _NO_RETURN_MM_M
    out[out >= _NO_RETURN_CM_M] = math.nan
    highest = min(float(np.nanmax(out, initial=0.0)), farthest_m)
    at = out >= highest - _SAME_M
    beams, of = np.count_nonzero(at), np.count_nonzero(np.isfinite(out))
    many = max(_SATURATED * of, _SATURATED_BEAMS) < beams < of and at.any(axis=0).mean() > _SATURATED_BEARINGS
    if many or highest == farthest_m:
        if highest < _NO_RETURN_MM_M:
            out[at] = math.inf
            return out, highest
        out[at] = math.nan
    # Above the farthest, since a range at the reach itself counts as no return.
    return out, (math.floor(float(np.nanmax(out, initial=0.0)) * 10.0 + 1e-6) + 1) / 10.0
