"""The network of ``learned-tour`` in NumPy: from what is known of a map to what each opening costs.

A picture of the map, a pixel a station, goes through convolutions at four scales (a U-Net: Ronneberger et al.,
2015), and a small network scores each opening by what these say at its target and at its first hop. What trains it
is in ``training/dungeons/networks.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from agents.learned.choice_network import apart
from agents.learned.layers import Layers
from agents.stations.survey import STRIDE, Openings, Survey
from slam.grids.occupancy import FREE, UNKNOWN
from slam.types import Array, Cells, Flags, Floats

__all__ = [
    "PLANES",
    "SIDE",
    "Picture",
    "StationEnsemble",
    "StationNetwork",
    "opening_numbers",
    "outside",
    "picture",
    "pixels",
    "with_walls",
]

SIDE = 32
"""Pixels a side of the picture, 4 m each: 128 m."""
PLANES = 14
"""Shares of free and of occupied cells in each quarter of a pixel; pieces of frontier; looked from; the way there;
pieces in sight where that is worth a visit; the robot; share of unknown cells."""
_FREE, _UNKNOWN = int(FREE), int(UNKNOWN)
_HALF = STRIDE // 2
_FARTHEST_M = 230.0
_RIM = 2  # pixels that are shown around the robot at least
_SCORE_M = 20.0  # of a score of 1


class Picture(NamedTuple):
    """What is known, with the middle of it in the picture's middle: where on the map that is remains untold."""

    planes: Floats  # (PLANES, SIDE, SIDE)
    corner: Cells  # (2,) lattice row and column of the first pixel, counted from the station at the grid's corner


@njit(cache=True, nogil=True)
def picture(
    known: NDArray[np.int8], visited: Flags, first: tuple[int, int], cell_m: float, found: Survey
) -> Picture:
    """Draw what is known; arguments are those of :func:`agents.stations.survey.survey`."""
    r0, c0 = first[0] % STRIDE - _HALF, first[1] % STRIDE - _HALF  # corner of the pixel of station (0, 0)
    low, high = np.array([10**6, 10**6]), np.array([-(10**6), -(10**6)])
    for r in range(known.shape[0]):
        for c in range(known.shape[1]):
            if known[r, c] != _UNKNOWN:
                i, j = (r - r0) // STRIDE, (c - c0) // STRIDE
                low[0], low[1] = min(low[0], i), min(low[1], j)
                high[0], high[1] = max(high[0], i), max(high[1], j)
    corner = (low + high + 1) // 2 - SIDE // 2
    robot = found.cells[found.places[0]]
    for k in range(2):  # on a map too large for the picture, the robot stays in it
        own = (robot[k] - (r0 if k == 0 else c0)) // STRIDE
        corner[k] = min(max(corner[k], own - SIDE + 1 + _RIM), own - _RIM)
    planes = np.zeros((PLANES, SIDE, SIDE), dtype=np.float32)
    share = np.float32(1.0 / _HALF**2)
    for r in range(known.shape[0]):
        for c in range(known.shape[1]):
            if known[r, c] == _UNKNOWN:
                continue
            i, j = (r - r0) // STRIDE - corner[0], (c - c0) // STRIDE - corner[1]
            if 0 <= i < SIDE and 0 <= j < SIDE:
                quarter = (r - r0) % STRIDE // _HALF * 2 + (c - c0) % STRIDE // _HALF
                planes[quarter if known[r, c] == _FREE else 4 + quarter, i, j] += share
    for k in range(len(found.pieces)):
        i, j = (found.pieces[k, 0] - r0) // STRIDE - corner[0], (found.pieces[k, 1] - c0) // STRIDE - corner[1]
        if 0 <= i < SIDE and 0 <= j < SIDE:
            planes[8, i, j] += np.float32(0.2)
    for n in range(len(found.cells)):
        r, c = found.cells[n, 0], found.cells[n, 1]
        i, j = (r - r0) // STRIDE - corner[0], (c - c0) // STRIDE - corner[1]
        if not (0 <= i < SIDE and 0 <= j < SIDE):
            continue
        if visited[r, c]:
            planes[9, i, j] = 1.0
        if np.isfinite(found.way[n]):
            planes[10, i, j] = 0.25 + 0.01 * min(found.way[n] * cell_m, _FARTHEST_M)
        if found.worth[n]:
            planes[11, i, j] = 0.2 + 0.05 * found.views[n]
        if n == found.places[0]:
            planes[12, i, j] = 1.0
    planes[13] = 1.0 - planes[:8].sum(axis=0) / 4.0
    return Picture(planes, corner)


def outside(shown: Picture, first: tuple[int, int], box: tuple[int, int, int, int]) -> Floats:
    """Return the share of each quarter of each pixel ``(4, SIDE, SIDE)`` that lies outside of a box of cells.

    ``box`` is the first row and column of it, and the first beyond it, in the cells that ``first`` is one of.
    """
    shares = []
    for axis in (0, 1):
        half = shown.corner[axis] * 2 + np.arange(2 * SIDE)  # quarters along the axis
        begin = half * _HALF + first[axis] % STRIDE - _HALF
        inside = np.minimum(begin + _HALF, box[2 + axis]) - np.maximum(begin, box[axis])
        shares.append((np.clip(inside, 0, _HALF) / _HALF).reshape(SIDE, 2))
    rows, cols = shares
    own = [rows[:, None, q // 2] * cols[None, :, q % 2] for q in range(4)]
    return np.asarray(1.0 - np.stack(own), dtype=np.float32)


def with_walls(planes: Floats, beyond: Floats) -> Floats:
    """Return planes ``(…, PLANES, n, n)`` that show as occupied what :func:`outside` found to lie there."""
    planes = planes.copy()
    free, occupied = planes[..., :4, :, :], planes[..., 4:8, :, :]
    occupied[...] = np.minimum(occupied + beyond, 1.0 - free)
    planes[..., 13, :, :] = 1.0 - planes[..., :8, :, :].sum(axis=-3) / 4.0
    return planes


def pixels(cells: Cells, first: tuple[int, int], shown: Picture) -> Cells:
    """Return the pixels ``(n, 2)`` of stations' cells ``(n, 2)``, those beyond the picture's rim on it."""
    own = (cells - np.array([first[0] % STRIDE, first[1] % STRIDE])) // STRIDE
    return np.asarray(np.clip(own - shown.corner, 0, SIDE - 1))


def opening_numbers(losses_m: Array | Floats, legs_m: Array | Floats) -> Floats:
    """Return what is told of each opening ``(c, 3)`` besides the picture, from its loss and its first leg [m]."""
    columns = [losses_m / _SCORE_M, legs_m / 40.0, np.log1p(legs_m / 4.0)]
    return np.stack(columns, axis=-1).astype(np.float32)


class StationNetwork(Layers):
    """``training.dungeons.networks.StationNetwork``, forward only."""

    def _check(self) -> None:
        blank = Picture(np.zeros((PLANES, SIDE, SIDE), np.float32), np.zeros(2, np.int64))
        nothing = Openings(np.zeros(1, np.int64), np.zeros(1, np.int64), np.zeros(1), np.zeros(1))
        self.costs_m(blank, np.zeros((1, 2), np.int64), np.zeros((1, 2), np.int64), nothing)

    def costs_m(self, shown: Picture, targets: Cells, hops: Cells, openings: Openings) -> Array:
        """Return what each opening ``(c,)`` is expected to cost [m], but for what all of them cost alike.

        ``targets`` and ``hops`` are the pixels ``(c, 2)`` of the tour's first stop and of the first hop.
        """
        x0 = self._block("down_0", shown.planes)
        x1 = self._block("down_1", _halved(x0))
        x2 = self._block("down_2", _halved(x1))
        x3 = self._block("down_3", _halved(x2))
        y2 = self._block("up_2", np.concatenate([_doubled(x3), x2]))
        y1 = self._block("up_1", np.concatenate([_doubled(y2), x1]))
        y0 = self._block("up_0", np.concatenate([_doubled(y1), x0]))
        whole = np.broadcast_to(x3.mean(axis=(1, 2)), (len(targets), len(x3)))
        at_target, at_hop = (y0[:, at[:, 0], at[:, 1]].T for at in (targets, hops))
        rows = np.concatenate([at_target, at_hop, whole, opening_numbers(openings.losses, openings.legs)], axis=1)
        for layer in ("score_1", "score_2"):
            rows = np.maximum(self._linear(layer, rows), 0.0)
        share = float(self._weights["loss_share"])
        return np.asarray(
            share * openings.losses + 0.5 * _SCORE_M * self._linear("score_3", rows)[:, 0], np.float64
        )

    def _block(self, name: str, x: Floats) -> Floats:
        skip = self._convolved(f"{name}.skip", x) if f"{name}.skip.weight" in self._weights else x
        inner = np.maximum(self._convolved(f"{name}.first", x), 0.0)
        return np.asarray(np.maximum(skip + self._convolved(f"{name}.second", inner), 0.0))


class StationEnsemble:
    """Several networks, and the mean of what they say of each opening.

    Parameters
    ----------
    weights : mapping
        As :func:`agents.learned.choice_network.joined` makes it; or those of a single network.

    Raises
    ------
    ValueError
        Where a weight is missing or does not fit the others.
    """

    def __init__(self, weights: Mapping[str, NDArray[Any]]) -> None:
        self.members = [StationNetwork(own) for own in apart(weights)]

    def costs_m(self, shown: Picture, targets: Cells, hops: Cells, openings: Openings) -> Array:
        """Return what each opening ``(c,)`` is expected to cost [m]; see :meth:`StationNetwork.costs_m`."""
        return np.asarray(np.mean([m.costs_m(shown, targets, hops, openings) for m in self.members], axis=0))


def _halved(x: Floats) -> Floats:
    """Return the maximum of each two by two pixels."""
    channels, rows, cols = x.shape
    return np.asarray(x.reshape(channels, rows // 2, 2, cols // 2, 2).max(axis=(2, 4)))


def _doubled(x: Floats) -> Floats:
    return x.repeat(2, axis=1).repeat(2, axis=2)
