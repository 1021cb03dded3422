"""How a scan fits a particle's own map: its surfaces near the scan's ends as a field, climbed and weighed."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from slam.geometry import wrap_scalar
from slam.grids.match_kernels import climb, prior_loss, slope
from slam.grids.scan_matching import MatchConfig, stamps_of
from slam.particles.grids import OCCUPIED_SHARE, PASSES, STOPS, SUM_X, SUM_Y, Ints, ParticleGrids
from slam.types import Array, Bytes, Floats, Indices

__all__ = ["ParticleMatcher"]

_BLOCK = 4  # cells a side of what is read of a map at once, around each beam's end and one to every side
_UNWANTED, _UNKNOWN, _KNOWN = 0, 1, 2
_BEFORE = 3.0  # cells before a beam's end, where the map knows something if it can know where the beam ends


class ParticleMatcher:
    """Matches one scan after another to the maps of particles; its buffers are used again.

    Only cells near the ends of the beams are read: at least 4 cells around each, which is as far as a scan can be
    moved towards its best fit.
    """

    def __init__(self, config: MatchConfig) -> None:
        self.config = config
        self._values = np.zeros((1, 1), np.float32)
        self._plane = np.zeros((1, 1), np.uint8)
        self._cells = np.zeros((1, 2), np.int32)
        self._evidence = np.zeros((1, 4), np.float32)

    def fit(
        self, grids: ParticleGrids, particle: int, points: Array, pose: Array, info: Array, *,
        unknown: float, free: float,
    ) -> tuple[Array, Array, float]:  # fmt: skip
        """Move ``pose`` ``(3,)``, known to ``info`` ``(3, 3)``, to where the scan and that agree best.

        A beam that came through the unknown ends on what nobody has seen. The wall that it may be on ends where
        the map does, and would draw it back there: with a narrow view, against every turn. So it counts in a first
        fit, which tells which beams these are, and in the likelihood.

        Parameters
        ----------
        points : Array
            ``(n, 2)`` ends of beams [m, body frame].
        unknown, free : float
            Likelihood, against 1 on a surface, of an end where the map knows nothing, and where it knows no
            surface.

        Returns
        -------
        The pose, the information there ``(3, 3)``, and the log-likelihood of scan and motion [nat].
        """
        config, cell = self.config, self.config.cell_m
        count, row, col, x0, y0 = self._draw(grids, particle, points, pose)
        best, curvature = pose.copy(), np.zeros((3, 3))
        climb(self._values, x0, y0, cell, points, best, pose, info, config.gain, config.iterations, curvature)
        held = np.zeros(points.shape)
        held = held[: through_known(self._plane, x0, y0, cell, points, best, held)]
        climb(self._values, x0, y0, cell, held, best, pose, info, config.gain, config.iterations, curvature)
        log_likelihood = weigh(
            self._values, self._plane, x0, y0, cell, points, best, pose, info, config.beam_weight, unknown, free
        )
        wipe(self._values, self._plane, row, col, self._cells[:count])
        return best, curvature, log_likelihood

    def informations(
        self, grids: ParticleGrids, particle: int, points: Array, pose: Array, groups: Indices, most: int
    ) -> tuple[Array, float]:
        """Tell the parts of the map apart that a fit's information is from.

        Parameters
        ----------
        points, pose : Array
            As of :meth:`fit`, and where it ended.
        groups, most
            The group ``(n,)`` of each of the ``points``, and how many there are.

        Returns
        -------
        The information of the pose by each group's beams ``(most, 3, 3)``, and the mean square of the distances
        [m²] from the surfaces, of the beams that count.
        """
        config, cell = self.config, self.config.cell_m
        count, row, col, x0, y0 = self._draw(grids, particle, points, pose)
        out, gradient = np.zeros((most, 3, 3)), np.zeros(3)
        for group in range(most):
            slope(self._values, x0, y0, cell, points[groups == group], pose, gradient, out[group])
        distance2 = misfit(self._values, x0, y0, cell, points, pose, config.smooth_m)
        wipe(self._values, self._plane, row, col, self._cells[:count])
        return config.gain * out, distance2

    def _draw(
        self, grids: ParticleGrids, particle: int, points: Array, pose: Array
    ) -> tuple[int, int, int, float, float]:
        """Draw what a particle's map has near the beams' ends; return as :meth:`_window`, and its corner [m]."""
        count, row, col = self._window(grids, points, pose)
        cells, evidence = self._cells[:count], self._evidence[:count]
        grids.read(particle, cells, evidence)
        draw_surfaces(self._values, self._plane, row, col, cells, evidence, stamps_of(self.config))
        lattice, cell = grids.lattice, grids.lattice.cell_m
        return count, row, col, (lattice.col + col + 0.5) * cell, (lattice.row + row + 0.5) * cell

    def _window(self, grids: ParticleGrids, points: Array, pose: Array) -> tuple[int, int, int]:
        """List the wanted cells; return how many, and the array cell that the window begins at."""
        cell, lattice = grids.lattice.cell_m, grids.lattice
        reach = float(np.sqrt((points * points).sum(axis=1).max(initial=0.0)))
        blocks = 2 * (math.ceil(reach / cell / _BLOCK) + 4)
        side = blocks * _BLOCK
        if self._values.shape[0] < side:
            self._values, self._plane = np.zeros((side, side), np.float32), np.zeros((side, side), np.uint8)
        most = 9 * (len(points) + 1) * _BLOCK * _BLOCK
        if len(self._cells) < most:
            self._cells, self._evidence = np.zeros((most, 2), np.int32), np.zeros((most, 4), np.float32)
        row = math.floor(pose[1] / cell) - lattice.row - side // 2
        col = math.floor(pose[0] / cell) - lattice.col - side // 2
        rows, cols = lattice.shape
        count = wanted_cells(points, pose, cell, lattice.row, lattice.col, rows, cols, row, col, side,
                             self._plane, self._cells)  # fmt: skip
        return count, row, col


@njit(cache=True, nogil=True, error_model="numpy")
def wanted_cells(
    points: Array, pose: Array, cell: float, row0: int, col0: int, rows: int, cols: int, row: int, col: int,
    side: int, plane: Bytes, cells: Ints,
) -> int:  # fmt: skip
    """List the array cells of the blocks around the beams' ends, and mark them unknown in the window's plane."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = 0
    for k in range(points.shape[0]):
        j = math.floor((pose[0] + c * points[k, 0] - s * points[k, 1]) / cell) - col0 - col
        i = math.floor((pose[1] + s * points[k, 0] + c * points[k, 1]) / cell) - row0 - row
        for bi in range(i // _BLOCK - 1, i // _BLOCK + 2):
            for bj in range(j // _BLOCK - 1, j // _BLOCK + 2):
                if not (0 <= bi < side // _BLOCK and 0 <= bj < side // _BLOCK):
                    continue
                top, left = bi * _BLOCK, bj * _BLOCK
                if plane[top, left] != _UNWANTED:
                    continue
                for y in range(top, top + _BLOCK):
                    for x in range(left, left + _BLOCK):
                        if 0 <= y + row < rows and 0 <= x + col < cols:
                            plane[y, x] = _UNKNOWN
                            cells[n, 0], cells[n, 1] = y + row, x + col
                            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def draw_surfaces(
    values: Floats, plane: Bytes, row: int, col: int, cells: Ints, evidence: Floats, stamps: Floats
) -> None:
    """Draw the surfaces among the cells into the wanted part of the window."""
    phases, half = stamps.shape[0], stamps.shape[2] // 2
    rows, cols = values.shape
    for k in range(cells.shape[0]):
        stops, passes = evidence[k, STOPS], evidence[k, PASSES]
        if stops + passes <= 0.0:
            continue
        i, j = cells[k, 0] - row, cells[k, 1] - col
        plane[i, j] = _KNOWN
        if stops < OCCUPIED_SHARE * (stops + passes):
            continue
        u = min(int(evidence[k, SUM_X] / stops * phases), phases - 1)
        v = min(int(evidence[k, SUM_Y] / stops * phases), phases - 1)
        stamp = stamps[v, u]
        for y in range(max(i - half, 0), min(i + half + 1, rows)):
            line = stamp[y - i + half]
            for x in range(max(j - half, 0), min(j + half + 1, cols)):
                if plane[y, x] != _UNWANTED:
                    values[y, x] = max(values[y, x], line[x - j + half])


@njit(cache=True, nogil=True, error_model="numpy")
def through_known(plane: Bytes, x0: float, y0: float, cell: float, points: Array, pose: Array, held: Array) -> int:
    """Write the ends ``(n, 2)`` of the beams that the map knows something of just before they end; return n."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = 0
    for k in range(points.shape[0]):
        reach = math.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2)
        share = max(1.0 - _BEFORE * cell / reach, 0.0) if reach > 0.0 else 0.0
        x, y = share * points[k, 0], share * points[k, 1]
        j = math.floor((pose[0] + c * x - s * y - x0) / cell + 0.5)
        i = math.floor((pose[1] + s * x + c * y - y0) / cell + 0.5)
        known = False
        for v in range(max(i - 1, 0), min(i + 2, plane.shape[0])):  # beams leave cells out between them
            for u in range(max(j - 1, 0), min(j + 2, plane.shape[1])):
                known = known or plane[v, u] == _KNOWN
        if known:
            held[n, 0], held[n, 1] = points[k, 0], points[k, 1]
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def weigh(
    values: Floats, plane: Bytes, x0: float, y0: float, cell: float, points: Array, pose: Array, prior: Array,
    info: Array, beam_weight: float, unknown: float, free: float,
) -> float:  # fmt: skip
    """Return the log-likelihood of the beams' ends, less what the pose's own prior loses."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    total = 0.0
    for k in range(points.shape[0]):
        u = (pose[0] + c * points[k, 0] - s * points[k, 1] - x0) / cell + 0.5
        v = (pose[1] + s * points[k, 0] + c * points[k, 1] - y0) / cell + 0.5
        i, j = math.floor(v), math.floor(u)
        value, state = 0.0, _UNKNOWN
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1]:
            value, state = values[i, j], plane[i, j]
        floor = free if state == _KNOWN else unknown
        total += math.log(floor + (1.0 - floor) * value)
    dx, dy, dt = pose[0] - prior[0], pose[1] - prior[1], wrap_scalar(pose[2] - prior[2])
    return beam_weight * total - prior_loss(info, dx, dy, dt)


@njit(cache=True, nogil=True, error_model="numpy")
def wipe(values: Floats, plane: Bytes, row: int, col: int, cells: Ints) -> None:
    """Make the window as it was: blocks that hold a listed cell are all there is in it."""
    for k in range(cells.shape[0]):
        values[cells[k, 0] - row, cells[k, 1] - col] = 0.0
        plane[cells[k, 0] - row, cells[k, 1] - col] = _UNWANTED


@njit(cache=True, nogil=True, error_model="numpy")
def misfit(values: Floats, x0: float, y0: float, cell: float, points: Array, pose: Array, smooth: float) -> float:
    """Return the mean d² of the field's exp(-d²/2s²) under the beams' ends, each weighed by the field itself.

    So a beam counts as much as it does in the fit, and one that met something unknown does not.
    """
    c, s = math.cos(pose[2]), math.sin(pose[2])
    total = weight = 0.0
    for k in range(points.shape[0]):
        j = math.floor((pose[0] + c * points[k, 0] - s * points[k, 1] - x0) / cell + 0.5)
        i = math.floor((pose[1] + s * points[k, 0] + c * points[k, 1] - y0) / cell + 0.5)
        if 0 <= i < values.shape[0] and 0 <= j < values.shape[1] and values[i, j] > 0.1:
            total -= 2.0 * smooth * smooth * values[i, j] * math.log(values[i, j])
            weight += values[i, j]
    return total / weight if weight > 0.0 else 0.0
