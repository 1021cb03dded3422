"""The tour of a robot that hops over stations, begun where experience says that the whole path becomes shorter.

A tour over what is known leaves out what is not: whether there is a large part of the building behind a door, or
little. On plans of the same kind a network has learned how much longer the path became, in the end, for each way
to begin it (``training/dungeon_lessons.py``), and the tour is begun with the least of these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.base import Goal
from agents.policy_files import read_policy
from agents.routing import draw_luck
from agents.station_network import StationNetwork, picture, pixels
from agents.station_survey import HOP, STRIDE, VOXEL, find_pieces, no_pieces, options, survey
from agents.tour import Tour, TourConfig
from mecanum_env.config import LidarConfig, RobotConfig
from slam.occupancy import FREE, UNKNOWN
from slam.settings import from_mapping, require
from slam.types import Belief

__all__ = ["FORMAT", "PRECISION", "SHIPPED", "LearnedTour", "LearnedTourConfig", "load_station_policy"]

FORMAT = "mecanum-slam station policy 1"
PRECISION = np.float16
"""Of the weights in the file."""
SHIPPED = Path(__file__).parent / "policies" / "learned-tour.safetensors"

_LUCK = draw_luck(6, 700)


@dataclass(frozen=True, kw_only=True)
class LearnedTourConfig(TourConfig):
    """The tour's, and which experience."""

    policy: str = ""  # path of a .safetensors file, the .json file beside it; the package's own by default
    most: int = 5  # openings that are weighed
    most_loss_m: float = 40.0  # what by the tour itself is worse by more is not

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.most >= 1, f"LearnedTourConfig.most must be at least 1, got {self.most}")
        require(self.most_loss_m >= 0, f"LearnedTourConfig.most_loss_m must be ≥ 0, got {self.most_loss_m}")


def load_station_policy(path: Path) -> tuple[StationNetwork, dict[str, Any]]:
    """Read a policy: the network, and what the JSON file says of its training; neither file can run code.

    Raises
    ------
    ValueError
        For a missing or damaged file, or one of another format; the message names it.
    """
    weights, described = read_policy(path, FORMAT)
    try:
        return StationNetwork(weights), described
    except ValueError as error:
        raise ValueError(f"policy {path}: {error}") from error


class LearnedTour(Tour):
    """Goes over a lattice of stations as :class:`agents.tour.Tour` does, but begins its tours by experience.

    Where it is told of no stations, or of others than those it learned on (4 m apart, cells of 0.4 m), it is the
    tour.

    Attributes
    ----------
    policy_path : Path
        The weights; what belongs to them lies beside, with the suffix ``.json``.
    about : dict
        What the policy's JSON file says of its training.
    """

    config: LearnedTourConfig

    def __init__(
        self,
        config: LearnedTourConfig | Mapping[str, Any] | None = None,
        *,
        robot: RobotConfig | Mapping[str, Any] | str | None = None,
        lidar: LidarConfig | Mapping[str, Any] | str | None = None,
        step_s: float = 0.1,
    ) -> None:
        settings = from_mapping(LearnedTourConfig, config)
        self.policy_path = Path(settings.policy or SHIPPED)
        self._network, self.about = load_station_policy(self.policy_path)
        super().__init__(settings, robot=robot, lidar=lidar, step_s=step_s)

    def _forget(self) -> None:
        super()._forget()
        self._known_cells = 0
        self._decided_at: set[tuple[int, int]] = set()  # stations, since anything new was seen
        self._stops: list[NDArray[np.float64]] = []  # poses that the sensor looked from

    def looked(self, belief: Belief) -> None:
        """Take note that the sensor looked from the belief's pose."""
        super().looked(belief)
        self._stops.append(np.asarray(belief.pose, dtype=np.float64))

    def choose(self, belief: Belief) -> Goal | None:
        """Return the station to go to next, or where the tour goes where there are no stations worth a visit."""
        stations, resolution = self.config.stations, belief.grid.resolution
        if round(stations.spacing_m / resolution) != STRIDE or stations.hop != HOP:
            return super().choose(belief)
        known, corner = _aligned(belief)
        robot = _cell_of(belief.pose, resolution, corner)
        first = _cell_of(self._start, resolution, corner)
        if not _is_free(known, robot) or any((robot[k] - first[k]) % STRIDE for k in (0, 1)):
            return super().choose(belief)  # it stands on no station
        visited = np.zeros(known.shape, dtype=np.bool_)
        for pose in self._stops:
            cell = _cell_of(pose, resolution, corner)
            if _is_free(known, cell):
                visited[cell] = True
        pieces = no_pieces(known.shape)
        find_pieces(known, pieces, np.array([0, known.shape[0] - 1, 0, known.shape[1] - 1]))
        reach = self.config.stations.reach_m / resolution
        found = survey(known, pieces, visited, first, robot, resolution, reach)
        if not found.worth.any():
            return super().choose(belief)
        openings = options(found, _LUCK, most=self.config.most, most_loss_m=self.config.most_loss_m)
        best = 0
        if len(openings.targets) > 1 and self._is_news(known, robot):
            shown = picture(known, visited, first, resolution, found)
            targets, hops = (pixels(found.cells[at], first, shown) for at in (openings.targets, openings.hops))
            best = int(np.argmin(self._network.costs_m(shown, targets, hops, openings)))
        station = found.cells[openings.targets[best]]
        goal = (np.array([station[1] + corner[1], station[0] + corner[0]]) + 0.5) * resolution
        self._frontiers = (found.pieces[:, ::-1] + np.array([corner[1], corner[0]]) + 0.5) * resolution
        self._status = "driving"
        return Goal(pose=np.array([*goal, belief.pose[2]]), path=np.array([belief.pose[:2], goal]))

    def _is_news(self, known: NDArray[np.int8], robot: tuple[int, int]) -> bool:
        """Whether it has not yet decided here, knowing no more: deciding alike twice would send it in circles."""
        count = int(np.count_nonzero(known != UNKNOWN))
        if count != self._known_cells:
            self._known_cells = count
            self._decided_at.clear()
        news = robot not in self._decided_at
        self._decided_at.add(robot)
        return news


def _aligned(belief: Belief) -> tuple[NDArray[np.int8], tuple[int, int]]:
    """Return the classes of what is known, with a margin, and the lattice row and column of its first cell.

    The corner lies on a multiple of :data:`VOXEL`, wherever the grid begins: squares of frontier are the frame's.
    """
    classes = belief.grid.classes()
    rows, cols = (np.flatnonzero((classes != UNKNOWN).any(axis=axis)) for axis in (1, 0))
    row0, col0 = belief.grid.lattice_origin
    low = [row0 + int(rows[0]), col0 + int(cols[0])]
    corner = [(value - 1) // VOXEL * VOXEL for value in low]  # at least one unknown cell all round
    part = classes[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    pad = [(value - own, STRIDE) for value, own in zip(low, corner, strict=True)]
    return np.pad(part, pad, constant_values=UNKNOWN), (corner[0], corner[1])


def _is_free(known: NDArray[np.int8], cell: tuple[int, int]) -> bool:
    """Whether a cell, which may lie beyond what is known, is known to be free."""
    inside = all(0 <= value < size for value, size in zip(cell, known.shape, strict=True))
    return inside and bool(known[cell] == FREE)


def _cell_of(pose: NDArray[np.float64], resolution: float, corner: tuple[int, int]) -> tuple[int, int]:
    return (
        int(np.floor(pose[1] / resolution)) - corner[0],
        int(np.floor(pose[0] / resolution)) - corner[1],
    )
