"""Settings of ``graph-slam``."""

from __future__ import annotations

from dataclasses import dataclass, field

from slam.backend import BackendConfig
from slam.graph.loop_closing import ClosingConfig
from slam.grids.scan_matching import MatchConfig
from slam.settings import require

__all__ = ["GraphSlamConfig"]


@dataclass(frozen=True, kw_only=True)
class GraphSlamConfig(BackendConfig):
    """Pose-graph SLAM: key scans, what a beam is believed, when a loop closes."""

    key_m: float = 0.4  # a scan becomes a key scan when the robot has moved …
    key_rad: float = 0.5  # … or turned so far since the last
    reach_m: float = 20.0  # beams that end farther are not used
    # Beams farther apart on a surface than this do not make a patch of it: a better view will come.
    spacing_m: float = 0.3
    # 1σ of what the model leaves out, common to all beams of a scan on one surface: of a wall …
    straight_m: float = 0.0003
    common_m: float = 0.01  # … and of a contour
    rough_m: float = 0.005  # 1σ by which a contour that is not straight departs from its tangents
    gate_m: float = 0.1  # farthest from its surface that a beam may end, before the alignment
    # Wheels that know a step to less than this are helped by a search over the window of ``MatchConfig``.
    search_sigma_m: float = 0.03
    search_sigma_rad: float = 0.015
    matching: MatchConfig = field(default_factory=MatchConfig)
    closing: ClosingConfig = field(default_factory=ClosingConfig)
    # Patches farther from the robot than a beam of it reaches, and so much more, leave the window.
    beyond_m: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.key_m > 0 and self.key_rad > 0, "GraphSlamConfig.key_* must be > 0")
        require(self.spacing_m > 0 and self.reach_m > 0, "GraphSlamConfig.spacing_m and reach_m must be > 0")
        for name in ("rough_m", "common_m", "straight_m"):
            require(getattr(self, name) >= 0, f"GraphSlamConfig.{name} must be ≥ 0")
