"""Settings of ``graph-slam``."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from slam.backend import BackendConfig
from slam.graph.loop_closing import ClosingConfig
from slam.grids.scan_matching import MatchConfig
from slam.settings import Angle, Gap, Length, NotNegative, Within, argument

__all__ = ["GraphSlamConfig"]


@dataclass(frozen=True, kw_only=True)
class GraphSlamConfig(BackendConfig):
    """Pose-graph SLAM: key scans, what a beam is believed, when a loop closes."""

    key_m: Length = 0.4  # a scan becomes a key scan when the robot has moved …
    key_rad: Angle = 0.5  # … or turned so far since the last
    reach_m: Length = 20.0  # beams that end farther are not used
    # Beams farther apart on a surface than this do not make a patch of it: a better view will come.
    spacing_m: Length = 0.3
    # 1σ of what the model leaves out, common to all beams of a scan on one surface: of a wall …
    straight_m: Annotated[float, Within("[0, 10]")] = 0.0003
    common_m: Annotated[float, Within("[0, 10]")] = 0.01  # … and of a contour
    # 1σ by which a contour that is not straight departs from its tangents
    rough_m: Annotated[float, Within("[0, 10]")] = 0.005
    gate_m: Length = 0.1  # farthest from its surface that a beam may end, before the alignment
    # Wheels that know a step to less than this are helped by a search over the window of ``MatchConfig``.
    search_sigma_m: NotNegative = 0.03
    search_sigma_rad: NotNegative = 0.015
    matching: MatchConfig = field(default_factory=MatchConfig)
    closing: ClosingConfig = field(default_factory=ClosingConfig)
    # Patches farther from the robot than a beam of it reaches, and so much more, leave the window.
    beyond_m: Gap = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        with argument("GraphSlamConfig.closing.farthest_m and farthest_rad"):
            replace(self.matching, window_m=self.closing.farthest_m, window_rad=self.closing.farthest_rad)
