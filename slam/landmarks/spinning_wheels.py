"""Wheels that turn in vain: the robot is pressed to a wall, or has lost its grip.

A filter that trusts V where the robot does not follow has every gate closed within two steps, or holds a few wrong
landmarks for the right ones. So where landmarks are missed all at once, and the scan fits the map worse from where
the wheels have the robot than the last one did, observations are associated anew with a pose that may be off by
all that the wheels claim. Gates so wide take any corner for a landmark: one pose must explain them all, and the
scan must fit the map surely better from there. Along walls of one direction, which leave open how far along them
the robot is, one missed landmark is enough to ask, and a wall across them alone is an answer: the end of a
corridor. (In buildings jambs and ledges stand centimetres apart, and any of them fits where nothing else says how
far along the robot is.) Where landmarks do not answer, as in caves, and the body touches something, the scan alone
is held against the map; where it touches nothing, a view that changes is a door. Wheels that spun once are likely
to do so in the next scans, too: then they are not believed, and of two explanations the better one is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit

from slam.grids.occupancy import OccupancyGrid
from slam.types import LINE, Array, Indices, Scan

__all__ = ["FEWEST_BACK", "SpinningWheels", "seen_again", "touches", "walls_cross"]

FEWEST_BACK = 2
"""Landmarks by which a robot is back from wheels that spun; one alone says nothing about the heading."""

_ASKEW = 0.2  # sine of the angle between two walls from which on they say where along them the robot is
_UNTOLD_M = 0.3  # of the wheels' way at most is remembered along a corridor of which no end is in sight
# Log-odds [nat] by which a scan fits worse; by which it must fit better, and where less than half of the landmarks
# are still matched and the robot touches something. Of 692 explanations that robots driven at random needed 610
# come up to that, of 314 not needed none (rooms with straight walls, training seeds 200-205): all were right. At
# the doors of 20 drives on floors, where it is the view that changed, 5 of 645 would without the touching, and 23
# if two thirds were few enough. In caves every tenth is wrong, half of those by more than 80 nat.
_WORSE_NAT, _SURE_NAT, _PRESSED_NAT = 30.0, 80.0, 20.0
_LATELY = 6  # scans for which wheels that spun are not believed
_TOUCH_SIGMAS = 4.0  # of a range, from which on what a beam meets is not touched
_BEYOND_M, _BEYOND_RAD = 0.05, 0.05  # by which a pose may be farther off than the wheels claim to have moved


class SpinningWheels:
    """What the wheels claim, when to ask whether they turn in vain, and what counts as an answer.

    Attributes
    ----------
    moved_m, turned_rad : float
        What the wheels claim since the landmarks were last in sight.
    untold : bool
        Whether the matched landmarks leave open how far along them the robot is: walls of one direction, or none.
    touching : bool
        Whether the robot touches something, as the last scan that had to be asked about shows.
    """

    def __init__(self) -> None:
        self.moved_m = self.turned_rad = 0.0
        self.untold = self.touching = False
        self._left = 0
        self._most_missed = False
        self._last: tuple[Scan, Array] | None = None

    def claim(self, moved_m: float, turned_rad: float) -> None:
        """Count what the wheels claim in a step."""
        self.moved_m += moved_m
        self.turned_rad += turned_rad

    def forget_motion(self) -> None:
        """Note that the landmarks say where the robot is, but for what is ``untold``."""
        self.moved_m = min(self.moved_m, _UNTOLD_M) if self.untold else 0.0
        self.turned_rad = 0.0

    def allowed_for(self) -> None:
        """Note that the pose's covariance owns to what they claim: once, or it would grow scan after scan."""
        self.moved_m = self.turned_rad = 0.0

    @property
    def _least(self) -> int:
        """How many landmarks must be missed to ask; a corridor's end alone tells how far along it the robot is."""
        return 1 if self.untold else FEWEST_BACK

    @property
    def variances(self) -> tuple[float, float, float]:
        """What the pose may be off by: x, y [m²], θ [rad²]."""
        return self.moved_m**2, self.moved_m**2, self.turned_rad**2

    def claims(self, way_m: float, turn_rad: float) -> bool:
        """Tell whether a pose so far off is one where the robot stayed while the wheels went on."""
        return way_m <= self.moved_m + _BEYOND_M and turn_rad <= self.turned_rad + _BEYOND_RAD

    @property
    def lately(self) -> bool:
        """Whether they turned in vain in one of the last scans."""
        return self._left > 0

    def suspected(
        self, grid: OccupancyGrid, sensor_pose: Callable[[Array | None], Array], scan: Scan, recent: int,
        still: int, match: Indices,
    ) -> bool:  # fmt: skip
        """Tell whether to ask.

        Parameters
        ----------
        grid, scan
            The map, and the scan at hand.
        sensor_pose
            Returns where the sensor is ``(3,)`` with the body at a pose ``(3,)``, the believed one for ``None``.
        recent, still
            Landmarks that the last scans showed, and how many of them are matched.
        match
            Landmark of each observation ``(m,)``, negative for none.
        """
        self._most_missed = 2 * still < recent
        if self._left:
            return True
        if recent - still < self._least or np.count_nonzero(match < 0) < self._least:
            return False
        if self._last is None:
            return True
        last, body = self._last
        return grid.agreement(sensor_pose(None), scan) < grid.agreement(sensor_pose(body), last) - _WORSE_NAT

    def enough(self, found: Indices, usual: Indices) -> bool:
        """Tell whether a match that was made as though they spun may explain more than the usual one."""
        least = int(np.count_nonzero(usual >= 0)) + (0 if self._left else self._least)
        return int(np.count_nonzero(found >= 0)) >= max(FEWEST_BACK, least)

    def explain(self, fit: float, usual: float, *, unseen: bool = False) -> bool:
        """Tell whether a scan says that they spun, by how well [nat] it fits from there and as usual.

        Where the two poses are less than a cell apart (``unseen``) the fit tells nothing; then the end of a
        corridor, too near to where it was to be another wall, is believed.
        """
        if unseen and self.untold and fit >= usual:
            self._left = _LATELY
            return True
        return self.surely(fit, usual) or (self.lately and fit > usual)

    def surely(self, fit: float, usual: float) -> bool:
        """Tell whether a scan fits so much better [nat] that they spun; then they are not believed for a while."""
        less = self._most_missed and self.touching  # where the robot is held back, less will do
        if fit > usual + min(abs(usual), _PRESSED_NAT if less else _SURE_NAT):
            self._left = _LATELY
            return True
        return False

    def note(self, scan: Scan, body: Array, recent: int, matched: int) -> None:
        """Take note of a scan and the body's pose ``(3,)``; one that misses landmarks is no measure."""
        self._left = max(self._left - 1, 0)
        if matched > recent - self._least:
            self._last = scan.kept(), body.copy()


def touches(scan: Scan, offset_m: float, length_m: float, width_m: float, sigma_m: float) -> bool:
    """Tell whether a scan shows something at a body of this length and width [m], as far as it can be seen.

    Parameters
    ----------
    scan, offset_m
        From a sensor so far ahead of the body's middle.
    sigma_m
        Standard deviation of a range.
    """
    if length_m <= 0.0 or width_m <= 0.0:  # nobody has said how large it is
        return False
    near = np.flatnonzero(scan.ranges < math.hypot(length_m, width_m) + abs(offset_m))
    bearings = scan.angle_min + scan.angle_increment * near
    ahead = np.abs(offset_m + scan.ranges[near] * np.cos(bearings)) - 0.5 * length_m
    aside = np.abs(scan.ranges[near] * np.sin(bearings)) - 0.5 * width_m
    clear = np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0))
    return bool(np.any(clear < _TOUCH_SIGMAS * sigma_m))


@njit(cache=True, nogil=True, error_model="numpy")
def walls_cross(z: Array, match: Indices) -> bool:
    """Tell whether there are walls of two directions among matched observations, as for :func:`seen_again`."""
    first = -1
    for k in range(z.shape[0]):
        if match[k] < 0 or z[k, 5] != LINE:
            continue
        if first >= 0 and abs(math.sin(z[k, 6] - z[first, 6])) > _ASKEW:
            return True
        first = k if first < 0 else first
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def seen_again(z: Array, match: Indices) -> tuple[int, bool]:
    """Return how many observations are matched, and whether they say where the robot is.

    Parallel walls alone do not: they leave open how far along them.

    Parameters
    ----------
    z, match
        As in :func:`slam.landmarks.association.nearest_neighbour`.
    """
    count, points = 0, False
    for k in range(z.shape[0]):
        if match[k] >= 0:
            count += 1
            points = points or z[k, 5] != LINE
    return count, points or walls_cross(z, match)
