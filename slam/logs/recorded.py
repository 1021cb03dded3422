"""A recorded log in memory: what the robot sensed, in time order, and what is known of where it really was."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from slam.geometry import wrap
from slam.logs.log import Event, Log
from slam.settings import Config, NotNegative, Positive
from slam.types import Array, Indices, Observations, Odometry

__all__ = ["Event", "ObservationNoise", "RecordedLog", "group_by_time", "split_holds"]

_LEAST_TOLD = 1e-3  # by a sighting, of what one on its own tells: two at the same time are no division by zero


@dataclass(frozen=True, kw_only=True)
class ObservationNoise(Config):
    """Standard deviations of a landmark observation: of its range, a + b ρ + c ρ², and of its bearing."""

    range_m: Positive
    range_share: NotNegative = 0.0  # of the range, added to ``range_m``
    range_square_per_m: NotNegative = 0.0  # of the range's square, as where a range is told from an apparent size
    bearing_deg: Positive
    # How long the error of a landmark's sightings stays the same. A sighting right after another one of the same
    # landmark says little that is new: see ``repeated``.
    repeat_s: NotNegative = 0.0

    def cov(self, range_bearing: Array) -> Array:
        """Return the covariances ``(m, 2, 2)`` of observations ``(m, 2)`` [m², m·rad, rad²], each on its own."""
        out = np.zeros((len(range_bearing), 2, 2))
        ranges = range_bearing[:, 0]
        out[:, 0, 0] = (self.range_m + self.range_share * ranges + self.range_square_per_m * ranges**2) ** 2
        out[:, 1, 1] = math.radians(self.bearing_deg) ** 2
        return out

    def repeated(self, times: Array, ids: Indices | None) -> Array:
        """Return by what the covariance of each sighting grows ``(o,)`` for what those before it have told.

        An error that lasts is not averaged out. Of a process with variance s² and correlation exp(−t/τ) a second
        of sightings tells 1/(2 τ s²) at most, however many there are (the spectral density at zero). So a sighting
        after a gap Δ counts 1 − exp(−Δ / ``repeat_s``) of one on its own, ``repeat_s`` being 2 τ times the share
        of s² that lasts: all of it after a long gap, Δ / ``repeat_s`` in a dense row of them.

        Parameters
        ----------
        times : Array
            ``(o,)`` [s], not falling.
        ids : NDArray[np.int64], optional
            ``(o,)``; without them a gap is one in which nothing at all was seen.
        """
        if self.repeat_s == 0.0:
            return np.ones(len(times))
        gap = np.full(len(times), math.inf)
        last: dict[int, float] = {}
        now, before = -math.inf, -math.inf
        for k, at in enumerate(times.tolist()):
            if at > now:
                now, before = at, now
            of = 0 if ids is None else int(ids[k])
            gap[k] = now - (before if ids is None else last.get(of, -math.inf))
            last[of] = now
        return 1.0 / np.maximum(-np.expm1(-gap / self.repeat_s), _LEAST_TOLD)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedLog(Log):
    """Odometry and landmark observations of a real robot, with a reference where one was recorded.

    Times are seconds since the first odometry; what was seen before it or after the last one is left out. The body
    frame is that of the sensor: observations are made at its origin.
    """

    odometry_times: Array  # (k ≥ 2,) [s] never falling, the first 0; a twist is held from its time to the next
    twists: Array  # (k, 3) vx, vy [m/s], ω [rad/s] in the body frame
    observation_times: Array  # (m,) [s] rising; one entry a set
    observation_ends: Indices  # (m,) set i is the rows from the end of set i - 1 to here
    range_bearing: Array  # (o, 2) [m, rad] in the body frame
    ids: Indices | None  # (o,) where landmarks were told apart as they were seen
    landmark_ids: Indices | None  # (l,) of the surveyed landmarks
    landmarks: Array | None  # (l, 2) [m] in the reference's frame
    observation_noise: ObservationNoise

    @property
    def duration_s(self) -> float:
        """Time from the first odometry to the last [s]."""
        return float(self.odometry_times[-1])

    def until(self, limit_s: float) -> RecordedLog:
        """Return the log's beginning, as far as ``limit_s``."""
        if limit_s >= self.duration_s:
            return self
        k = max(int(np.searchsorted(self.odometry_times, limit_s)), 1)
        times = np.append(self.odometry_times[:k], limit_s)
        m = int(np.searchsorted(self.observation_times, limit_s, side="right"))
        r = int(np.searchsorted(self.reference_times, limit_s, side="right"))
        rows = int(self.observation_ends[m - 1]) if m else 0
        return replace(
            self, odometry_times=times, twists=np.vstack([self.twists[:k], self.twists[k - 1 : k]]),
            observation_times=self.observation_times[:m], observation_ends=self.observation_ends[:m],
            range_bearing=self.range_bearing[:rows], ids=None if self.ids is None else self.ids[:rows],
            reference_times=self.reference_times[:r], reference_poses=self.reference_poses[:r],
        )  # fmt: skip

    def events(self, noise: ObservationNoise | None = None, *, known: bool = True) -> Iterator[Event]:
        """Yield the log in time order: at every odometry and every set of observations, one event.

        Each moves on from the event before by the twist held then, so an observation between two odometry
        stamps splits the interval; one at an odometry's own stamp belongs to the end of the interval before. A
        step may have dt = 0 where there is something to observe at the start.

        Parameters
        ----------
        noise : ObservationNoise, optional
            Of the observations, instead of the log's own.
        known : bool
            Hand the ids on, where the log has them.
        """
        ids = self.ids if known else None
        noise = noise or self.observation_noise
        at_set = np.repeat(self.observation_times, np.diff(self.observation_ends, prepend=0))
        cov = noise.cov(self.range_bearing) * noise.repeated(at_set, ids)[:, None, None]
        seen, sets = 0, len(self.observation_times)
        begin, now = 0, 0.0
        twists = [tuple(row) for row in self.twists.tolist()]
        for i, end in enumerate(self.odometry_times.tolist()):
            # The first odometry has no interval before it, but may have observations at its stamp.
            twist = twists[max(i - 1, 0)]
            while seen < sets and self.observation_times[seen] <= end:
                at, stop = float(self.observation_times[seen]), int(self.observation_ends[seen])
                part = slice(begin, stop)
                observations = Observations(
                    range_bearing=self.range_bearing[part], cov=cov[part], ids=None if ids is None else ids[part]
                )
                yield Event(at, Odometry(twist, at - now), observations)
                seen, begin, now = seen + 1, stop, at
            if end > now:
                yield Event(end, Odometry(twist, end - now), None)
                now = end

    def dead_reckoning(self) -> Array:
        """Return the poses ``(k, 3)`` at the odometry's times by the odometry alone, from the start pose."""
        dt = np.diff(self.odometry_times)
        vx, vy, omega = self.twists[:-1].T
        turned = self.start_pose[2] + np.append(0.0, np.cumsum(omega * dt))
        middle = turned[:-1] + 0.5 * omega * dt  # slam.motion.move
        c, s = np.cos(middle), np.sin(middle)
        x = self.start_pose[0] + np.append(0.0, np.cumsum((c * vx - s * vy) * dt))
        y = self.start_pose[1] + np.append(0.0, np.cumsum((s * vx + c * vy) * dt))
        return np.column_stack([x, y, wrap(turned)])


def group_by_time(times: Array, begin: float, end: float) -> tuple[Array, Indices, slice]:
    """Group observations ``(o,)`` in time order by equal times, those within [begin, end] only.

    Returns
    -------
    times (m,) since ``begin``, where each set ends (m,), and the slice of the rows that are kept.
    """
    kept = slice(int(np.searchsorted(times, begin)), int(np.searchsorted(times, end, side="right")))
    unique, counts = np.unique(times[kept], return_counts=True)
    return unique - begin, np.cumsum(counts).astype(np.int64), kept


def split_holds(times: Array, twists: Array, *, longest_s: float) -> tuple[Array, Array]:
    """Split every interval longer than ``longest_s`` into equal parts, each with the twist held there.

    V is the covariance of the twist of one step, so a walk of k equal steps gathers V dt² k: a twist held for a
    second in one step would count as much noise as 2500 steps of 20 ms do.
    """
    dt = np.diff(times)
    parts = np.maximum(np.ceil(dt / longest_s - 1e-9), 1).astype(np.int64)
    source = np.repeat(np.arange(len(dt)), parts)
    within = np.arange(len(source)) - np.repeat(np.cumsum(parts) - parts, parts)
    split = times[source] + within / parts[source] * dt[source]
    return np.append(split, times[-1]), np.vstack([twists[source], twists[-1:]])
