"""What every recorded log has in common: how a replay steps through it, and what is known of the true path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from slam.geometry import wrap
from slam.types import Array, Observations, Odometry, Scan

__all__ = ["Event", "Log"]


class Event(NamedTuple):
    """One step of a replay: move on by ``odometry``, then correct by what was sensed, where anything was."""

    time_s: float  # at its end, since the start of the log
    odometry: Odometry  # dt may be 0, at the start of the log
    observations: Observations | None = None
    scan: Scan | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Log:
    """Name, start and reference of a log; its subclasses hold what was sensed."""

    name: str
    clock_start_s: float  # the recorder's own time of the start
    reference_times: Array  # (r,) [s] rising; only where the reference is valid
    reference_poses: Array  # (r, 3) [m, m, rad] of the body frame; headings nan where not recorded
    reference_gap_s: float  # the reference is interpolated between times no farther apart than this
    start_pose: Array  # (3,) in the reference's frame, given to every backend
    settings: Mapping[str, Any] = field(default_factory=dict)  # of backends; of one alone under its name
    note: str = ""  # what the reference is, and what of the comparison is given rather than estimated

    @property
    def has_heading(self) -> bool:
        """Whether the reference knows the heading."""
        return len(self.reference_poses) > 0 and bool(np.isfinite(self.reference_poses[:, 2]).all())

    def reference_at(self, time_s: float) -> Array | None:
        """Return the reference pose ``(3,)`` at a time, or ``None`` where it has a gap there."""
        times = self.reference_times
        i = int(np.searchsorted(times, time_s, side="right")) - 1
        if i < 0 or i >= len(times) or (i + 1 == len(times) and time_s > times[i]):
            return None
        if i + 1 == len(times) or times[i] == time_s:
            return np.array(self.reference_poses[i])
        span = times[i + 1] - times[i]
        if span > self.reference_gap_s:
            return None
        step = self.reference_poses[i + 1] - self.reference_poses[i]
        step[2] = wrap(step[2])
        pose: Array = self.reference_poses[i] + (time_s - times[i]) / span * step
        pose[2] = wrap(pose[2])
        return pose
