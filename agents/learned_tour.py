"""The tour of a robot that hops over stations, begun where experience says that the whole path becomes shorter.

A tour over what is known leaves out what is not: whether there is a large part of the building behind a door, or
little. On plans of the same kind a network has learned how much longer the path became, in the end, for each way
to begin it (``training/dungeons/lessons.py``), and the tour is begun with the least of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.policy_files import read_policy
from agents.learned.station_network import StationEnsemble, outside, picture, pixels, with_walls
from agents.stations.stop import StationStop
from agents.stations.survey import Openings, options
from agents.tour import Tour, TourConfig
from agents.ways.routing import draw_luck
from slam.grids.occupancy import UNKNOWN
from slam.settings import Few, NotNegative, Within, require

__all__ = ["FORMAT", "SHIPPED", "LearnedTour", "LearnedTourConfig", "load_station_policy"]

FORMAT = "mecanum-slam station policy 2"
SHIPPED = Path(__file__).parent / "policies" / "learned-tour.safetensors"


@dataclass(frozen=True, kw_only=True)
class LearnedTourConfig(TourConfig):
    """The tour's, and which experience."""

    policy: str = ""  # path of a .safetensors file, the .json file beside it; the package's own by default
    extent: Annotated[
        tuple[float, ...], Within("[-10000, 10000]")
    ] = ()  # x, y of the two corners [m] that all lies between; (): not known
    most: Few = 5  # openings that are weighed
    most_loss_m: NotNegative = 40.0  # what by the tour itself is worse by more is not

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.extent[:2], self.extent[2:]
        require(
            not self.extent or (len(self.extent) == 4 and all(a < b for a, b in zip(low, high, strict=True))),
            f"LearnedTourConfig.extent must be x and y of the lower corner, then of the upper, got {self.extent}",
        )


def load_station_policy(path: Path) -> tuple[StationEnsemble, dict[str, Any]]:
    """Read a policy: its networks, and what the JSON file says of its training; see :func:`read_policy`."""
    return read_policy(path, FORMAT, lambda weights, _: StationEnsemble(weights))


class LearnedTour(Tour):
    """Goes over a lattice of stations as :class:`agents.tour.Tour` does, but begins its tours by experience.

    It may be told the ``extent`` of what there is to explore, as exploration planners commonly are, and then
    counts on nothing beyond it. Where it is told of no stations, or of others than those it learned on (4 m apart,
    cells of 0.4 m), it is the tour.

    Attributes
    ----------
    policy_path : Path
        The weights; what belongs to them lies beside, with the suffix ``.json``.
    about : dict
        What the policy's JSON file says of its training.
    """

    config: LearnedTourConfig
    config_type = LearnedTourConfig

    def __init__(self, config: Any = None, **body: Any) -> None:
        super().__init__(config, **body)
        self.policy_path = Path(self.config.policy or SHIPPED)
        self._luck = draw_luck(self.config.tries, 700)
        self._network, self.about = load_station_policy(self.policy_path)

    def _forget(self) -> None:
        super()._forget()
        self._known_cells = 0
        self._decided_at: set[tuple[int, int]] = set()  # stations, since anything new was seen

    def _station(self, stop: StationStop) -> int:
        openings = options(stop.found, self._luck, most=self.config.most, most_loss_m=self.config.most_loss_m)
        best = 0
        if len(openings.targets) > 1 and self._is_news(stop):
            best = int(np.argmin(self._costs_m(stop, openings)))
        return int(openings.targets[best])

    def _costs_m(self, stop: StationStop, openings: Openings) -> NDArray[np.float64]:
        shown = picture(stop.known, stop.visited, stop.first, stop.resolution, stop.found)
        if self.config.extent:
            beyond = outside(shown, stop.first, stop.box(self.config.extent))
            shown = shown._replace(planes=with_walls(shown.planes, beyond))
        cells = stop.found.cells
        targets, hops = (pixels(cells[at], stop.first, shown) for at in (openings.targets, openings.hops))
        return self._network.costs_m(shown, targets, hops, openings)

    def _is_news(self, stop: StationStop) -> bool:
        """Whether it has not yet decided here, knowing no more: deciding alike twice would send it in circles."""
        count = int(np.count_nonzero(stop.known != UNKNOWN))
        if count != self._known_cells:
            self._known_cells = count
            self._decided_at.clear()
        news = stop.robot not in self._decided_at
        self._decided_at.add(stop.robot)
        return news
