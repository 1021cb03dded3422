"""What a robot tells the others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from slam.accounts.account import Account
from slam.teams.apart import Start
from slam.teams.merged_grid import Chart
from slam.types import Array

__all__ = ["Report"]


class Report(NamedTuple):
    """What a robot tells of itself, in the frame of its own belief: nothing in it that others told."""

    time_s: float
    pose: Array  # (3,)
    pose_cov: Array  # (3, 3)
    goal: Array | None  # (2,) [m]
    chart_s: float  # when chart and account were made
    chart: Chart | None
    account: Account | None  # where frames have to be found
    start: Start | None  # where starts are known, but not for sure: which it believes in
    frames: Mapping[int, Array]  # poses (3,) of others' frames, as far as it found them
    ended: bool  # its episode is over: it goes nowhere
