"""What the maps of DP-SLAM's particles are made of, however they are stored: evidence in cells, scans as cells.

A cell counts the scans in which a beam ended in it and those in which beams only passed, and where in it they
ended on the average: DP-SLAM's density (stops over traversals) with a scan as the unit instead of the way within
the cell. Against log-odds it has no limits to saturate at, it tells "never seen" from "seen both ways", and the
mean place of the ends gives walls to a fraction of a cell, which is what a scan is matched against.
"""

from __future__ import annotations

import abc
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.types import Array, Floats, Indices

__all__ = ["PASSES", "STOPS", "SUM_X", "SUM_Y", "Lattice", "ParticleGrids", "ScanCells", "scan_cells"]

Ints = NDArray[np.int32]

STOPS, SUM_X, SUM_Y, PASSES = range(4)
"""Evidence of a cell: scans that ended there, the sums of where [cells from its corner], scans that passed."""

OCCUPIED_SHARE = 0.3  # a cell is a surface where at least this share of the scans stopped
_CHUNK = 64


class Lattice:
    """The box of lattice cells that all maps lie in; it grows, and its cells keep their lattice indices."""

    def __init__(self, cell_m: float) -> None:
        self.cell_m = cell_m
        self.row, self.col = -_CHUNK, -_CHUNK  # lattice index of array cell (0, 0)
        self.shape = (2 * _CHUNK, 2 * _CHUNK)
        self._empty = True

    def enclose(self, low: Array, high: Array) -> tuple[int, int, int, int] | None:
        """Make room for a box [m] with a margin; return by how much it grew (below, left) and its old shape."""
        margin = 16  # what is read around a beam's end, and how far a match may move it
        col0, row0 = (math.floor(v / self.cell_m) - margin for v in low.tolist())
        col1, row1 = (math.floor(v / self.cell_m) + margin for v in high.tolist())
        rows, cols = self.shape
        if self._empty and not (
            self.row <= row1 and row0 <= self.row + rows and self.col <= col1 and col0 <= self.col + cols
        ):  # begin there: it may be kilometres away
            self.row, self.col = row0 // _CHUNK * _CHUNK, col0 // _CHUNK * _CHUNK
        self._empty = False
        new_row, new_col = min(self.row, row0 // _CHUNK * _CHUNK), min(self.col, col0 // _CHUNK * _CHUNK)
        end_row = max(self.row + rows, -(-row1 // _CHUNK) * _CHUNK)
        end_col = max(self.col + cols, -(-col1 // _CHUNK) * _CHUNK)
        below, left = self.row - new_row, self.col - new_col
        shape = (end_row - new_row, end_col - new_col)
        if shape == self.shape:
            return None
        self.row, self.col, self.shape = new_row, new_col, shape
        return below, left, rows, cols


class ScanCells:
    """The array cells that a scan touched ``(count, 2)``, and the ``evidence`` ``(count, 4)`` to be added."""

    def __init__(self) -> None:
        self.cells = np.zeros((0, 2), np.int32)
        self.evidence = np.zeros((0, 4), np.float32)
        self.count = 0
        self._stamp = np.zeros((1, 1), np.int32)
        self._slot = np.zeros((1, 1), np.int32)
        self._serial = 0

    def trace(self, lattice: Lattice, pose: Array, offset_m: float, points: Array) -> None:
        """List the cells of beams from the sensor to ``points`` ``(n, 2)`` [m, body frame], seen from a pose."""
        if self._stamp.shape != lattice.shape:
            self._stamp, self._slot = np.zeros(lattice.shape, np.int32), np.zeros(lattice.shape, np.int32)
            self._serial = 0
        reach = 2.0 * float(np.abs(points).max(initial=0.0)) / lattice.cell_m
        most = (len(points) + 1) * (int(2 * reach) + 8)
        if len(self.cells) < most:
            self.cells, self.evidence = np.zeros((most, 2), np.int32), np.zeros((most, 4), np.float32)
        self._serial += 1
        self.count = scan_cells(
            points, pose, offset_m, lattice.cell_m, lattice.row, lattice.col, self._stamp, self._slot,
            self._serial, self.cells, self.evidence,
        )  # fmt: skip


class ParticleGrids(abc.ABC):
    """A map for every particle, in whatever form."""

    def __init__(self, particles: int, cell_m: float) -> None:
        self.particles = particles
        self.lattice = Lattice(cell_m)

    @abc.abstractmethod
    def enclose(self, low: Array, high: Array) -> None:
        """Make room for the box from ``low`` to ``high`` ``(2,)`` [m]."""

    @abc.abstractmethod
    def write(self, particle: int, scan: ScanCells) -> None:
        """Add a scan's evidence to a particle's map."""

    @abc.abstractmethod
    def resample(self, ancestors: Indices) -> None:
        """Let particle i have the map of particle ``ancestors[i]``."""

    @abc.abstractmethod
    def read(self, particle: int, cells: Ints, out: Floats) -> None:
        """Write the evidence ``(n, 4)`` that a particle has of array cells ``(n, 2)``, zeros where none."""

    @property
    @abc.abstractmethod
    def nbytes(self) -> int:
        """Memory that the maps take [bytes]."""

    def whole(self, particle: int) -> Floats:
        """Return a particle's map ``(rows, cols, 4)``."""
        rows, cols = self.lattice.shape
        cells = np.stack(np.meshgrid(np.arange(rows), np.arange(cols), indexing="ij"), axis=-1)
        out = np.zeros((rows * cols, 4), np.float32)
        self.read(particle, cells.reshape(-1, 2).astype(np.int32), out)
        return out.reshape(rows, cols, 4)


@njit(cache=True, nogil=True, error_model="numpy")
def scan_cells(
    points: Array, pose: Array, offset: float, cell: float, row0: int, col0: int, stamp: Ints, slot: Ints,
    serial: int, cells: Ints, evidence: Floats,
) -> int:  # fmt: skip
    """List every cell once: where beams ended first, with the mean place, then where they passed; return how many.

    ``stamp`` and ``slot`` have the lattice's shape; a cell was listed by this scan if its stamp is ``serial``.
    """
    rows, cols = stamp.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = 0
    for k in range(points.shape[0]):
        u = (pose[0] + c * points[k, 0] - s * points[k, 1]) / cell - col0
        v = (pose[1] + s * points[k, 0] + c * points[k, 1]) / cell - row0
        i, j = math.floor(v), math.floor(u)
        if not (0 <= i < rows and 0 <= j < cols):
            continue
        if stamp[i, j] != serial:
            stamp[i, j], slot[i, j] = serial, n
            cells[n, 0], cells[n, 1] = i, j
            evidence[n, 0] = evidence[n, 1] = evidence[n, 2] = evidence[n, 3] = 0.0
            n += 1
        m = slot[i, j]
        evidence[m, 0] += 1.0
        evidence[m, 1] += u - j
        evidence[m, 2] += v - i
    for m in range(n):  # one stop a scan, at the mean place
        evidence[m, 1] /= evidence[m, 0]
        evidence[m, 2] /= evidence[m, 0]
        evidence[m, 0] = 1.0
    x0, y0 = (pose[0] + c * offset) / cell - col0, (pose[1] + s * offset) / cell - row0
    for k in range(points.shape[0]):
        dx = (pose[0] + c * points[k, 0] - s * points[k, 1]) / cell - col0 - x0
        dy = (pose[1] + s * points[k, 0] + c * points[k, 1]) / cell - row0 - y0
        i, j = math.floor(y0), math.floor(x0)
        end_i, end_j = math.floor(y0 + dy), math.floor(x0 + dx)
        step_i, step_j = (1 if dy > 0.0 else -1), (1 if dx > 0.0 else -1)
        per_i = 1.0 / abs(dy) if dy != 0.0 else math.inf  # of the beam, a cell (Amanatides and Woo 1987)
        per_j = 1.0 / abs(dx) if dx != 0.0 else math.inf
        next_i = (i + 1 - y0 if dy > 0.0 else y0 - i) * per_i if dy != 0.0 else math.inf
        next_j = (j + 1 - x0 if dx > 0.0 else x0 - j) * per_j if dx != 0.0 else math.inf
        for _ in range(abs(end_i - i) + abs(end_j - j)):
            if 0 <= i < rows and 0 <= j < cols and stamp[i, j] != serial and n < cells.shape[0]:
                stamp[i, j] = serial
                cells[n, 0], cells[n, 1] = i, j
                evidence[n, 0] = evidence[n, 1] = evidence[n, 2] = 0.0
                evidence[n, 3] = 1.0
                n += 1
            if next_i < next_j:
                i, next_i = i + step_i, next_i + per_i
            else:
                j, next_j = j + step_j, next_j + per_j
    return n
