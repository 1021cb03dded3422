"""DP-SLAM's one grid that all particles share (Eliazar and Parr 2003, 2004), and the naive copies it stands for.

A cell holds a list of (node of the ancestry, evidence). A particle's evidence of the cell is that of its nearest
ancestor in the list; what a particle adds goes under its own leaf, on top of a copy of what it had inherited. So maps
are copied nowhere: resampling touches the tree, and what only the dead had seen.

Merging a node with its only child relabels the entries of whichever has fewer, and drops those of the parent that the
child had overwritten. (The paper relabels the child's ancestor into the child; most often that is the whole map.)
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.ancestry import Ancestry
from slam.particle_grids import Floats, Ints, ParticleGrids, ScanCells

__all__ = ["CopiedGrids", "SharedGrid"]

Array = NDArray[np.float64]

_ROW, _COL, _NODE, _NEXT_IN_CELL, _NEXT, _PREVIOUS = range(6)
_NONE = -1


class SharedGrid(ParticleGrids):
    """All particles' maps in one grid.

    ``live`` is the number of entries, ``ancestry`` the tree. An entry is array row and column, node, the next entry
    of its cell, and the next and previous of its node; its evidence lies beside it.
    """

    def __init__(self, particles: int, cell_m: float) -> None:
        super().__init__(particles, cell_m)
        self.ancestry = Ancestry(particles)
        self._head = np.full(self.lattice.shape, _NONE, np.int32)  # first entry of each cell
        self._entries = np.zeros((0, 6), np.int32)
        self._evidence = np.zeros((0, 4), np.float32)
        self._first = np.full(2 * particles, _NONE, np.int32)  # entry of each node …
        self._held = np.zeros(2 * particles, np.int32)  # … and how many it has
        self._free = np.array([_NONE, 0], np.int32)  # first unused entry, and how many there are
        self._ranks = np.zeros(2 * particles, np.int32)
        self._more(4096)

    @property
    def live(self) -> int:
        """Number of entries in use."""
        return len(self._entries) - int(self._free[1])

    @property
    def nbytes(self) -> int:
        """Memory [bytes] of the grid and of the entries, those not in use included."""
        return self._head.nbytes + self._entries.nbytes + self._evidence.nbytes + self._first.nbytes

    def enclose(self, low: Array, high: Array) -> None:
        """Make room for the box from ``low`` to ``high`` ``(2,)`` [m]."""
        grown = self.lattice.enclose(low, high)
        if grown is not None:
            below, left, rows, cols = grown
            head = np.full(self.lattice.shape, _NONE, np.int32)
            head[below : below + rows, left : left + cols] = self._head
            self._head = head
            self._entries[:, _ROW] += below
            self._entries[:, _COL] += left

    def write(self, particle: int, scan: ScanCells) -> None:
        """Add a scan's evidence to a particle's map."""
        if self._free[1] < scan.count:
            self._more(max(scan.count, len(self._entries)))
        self.ancestry.ranks(particle, self._ranks)
        write_entries(
            self._head, self._entries, self._evidence, self._first, self._held, self._free, self._ranks,
            int(self.ancestry.leaf[particle]), scan.cells, scan.evidence, scan.count,
        )  # fmt: skip

    def resample(self, ancestors: NDArray[np.int64]) -> None:
        """Let particle i have the map of particle ``ancestors[i]``."""
        self.ancestry.resample(ancestors, forget=self._forget, merge=self._merge)

    def read(self, particle: int, cells: Ints, out: Floats) -> None:
        """Write the evidence ``(n, 4)`` that a particle has of array cells ``(n, 2)``."""
        self.ancestry.ranks(particle, self._ranks)
        read_entries(self._head, self._entries, self._evidence, self._ranks, cells, out)

    def _forget(self, node: int) -> None:
        forget_node(node, self._head, self._entries, self._first, self._held, self._free)

    def _merge(self, parent: int, child: int) -> int:
        gone, kept = (child, parent) if self._held[child] <= self._held[parent] else (parent, child)
        relabel(
            gone, kept, kept == parent, self._head, self._entries, self._first, self._held, self._free
        )
        return kept

    def _more(self, count: int) -> None:
        size = len(self._entries)
        fresh = np.zeros((count, 6), np.int32)
        fresh[:, _NEXT_IN_CELL] = np.append(np.arange(size + 1, size + count), self._free[0])
        self._entries = np.vstack([self._entries, fresh])
        self._evidence = np.vstack([self._evidence, np.zeros((count, 4), np.float32)])
        self._free[:] = size, self._free[1] + count


class CopiedGrids(ParticleGrids):
    """A grid of its own for every particle, copied in full when particles are resampled: what DP-SLAM avoids."""

    def __init__(self, particles: int, cell_m: float) -> None:
        super().__init__(particles, cell_m)
        self._maps = np.zeros((particles, *self.lattice.shape, 4), np.float32)

    @property
    def nbytes(self) -> int:
        """Memory of all maps [bytes]."""
        return self._maps.nbytes

    def enclose(self, low: Array, high: Array) -> None:
        """Make room for the box from ``low`` to ``high`` ``(2,)`` [m]."""
        grown = self.lattice.enclose(low, high)
        if grown is not None:
            below, left, rows, cols = grown
            maps = np.zeros((self.particles, *self.lattice.shape, 4), np.float32)
            maps[:, below : below + rows, left : left + cols] = self._maps
            self._maps = maps

    def write(self, particle: int, scan: ScanCells) -> None:
        """Add a scan's evidence to a particle's map."""
        cells = scan.cells[: scan.count]
        self._maps[particle, cells[:, 0], cells[:, 1]] += scan.evidence[: scan.count]  # every cell is there once

    def resample(self, ancestors: NDArray[np.int64]) -> None:
        """Let particle i have the map of particle ``ancestors[i]``."""
        self._maps = self._maps[ancestors]

    def read(self, particle: int, cells: Ints, out: Floats) -> None:
        """Write the evidence ``(n, 4)`` that a particle has of array cells ``(n, 2)``."""
        out[:] = self._maps[particle, cells[:, 0], cells[:, 1]]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _find(first: int, entries: Ints, ranks: Ints) -> int:
    """Return the entry of the nearest ancestor in a cell's list, or -1."""
    best, rank, e = _NONE, -1, first
    while e != _NONE:
        r = ranks[entries[e, _NODE]]
        if r > rank:
            best, rank = e, r
        e = entries[e, _NEXT_IN_CELL]
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def read_entries(
    head: Ints, entries: Ints, evidence: Floats, ranks: Ints, cells: Ints, out: Floats
) -> None:
    """Write what a particle of these ``ranks`` has of each cell."""
    for k in range(cells.shape[0]):
        e = _find(head[cells[k, 0], cells[k, 1]], entries, ranks)
        for a in range(4):
            out[k, a] = evidence[e, a] if e != _NONE else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def write_entries(
    head: Ints, entries: Ints, evidence: Floats, first: Ints, held: Ints, free: Ints, ranks: Ints, leaf: int,
    cells: Ints, added: Floats, count: int,
) -> None:  # fmt: skip
    """Add a scan under a leaf; ``free`` must have room for ``count`` new entries."""
    for k in range(count):
        i, j = cells[k, 0], cells[k, 1]
        e = _find(head[i, j], entries, ranks)
        if e == _NONE or entries[e, _NODE] != leaf:
            new = free[0]
            free[0] = entries[new, _NEXT_IN_CELL]
            free[1] -= 1
            for a in range(4):
                evidence[new, a] = evidence[e, a] if e != _NONE else 0.0
            entries[new, _ROW], entries[new, _COL], entries[new, _NODE] = i, j, leaf
            entries[new, _NEXT_IN_CELL] = head[i, j]
            head[i, j] = new
            _link(new, leaf, entries, first, held)
            e = new
        for a in range(4):
            evidence[e, a] += added[k, a]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _link(e: int, node: int, entries: Ints, first: Ints, held: Ints) -> None:
    entries[e, _NEXT], entries[e, _PREVIOUS] = first[node], _NONE
    if first[node] != _NONE:
        entries[first[node], _PREVIOUS] = e
    first[node] = e
    held[node] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _remove(e: int, head: Ints, entries: Ints, first: Ints, held: Ints, free: Ints) -> None:
    """Take an entry out of its cell's list and its node's, and give it back."""
    i, j, node = entries[e, _ROW], entries[e, _COL], entries[e, _NODE]
    if head[i, j] == e:
        head[i, j] = entries[e, _NEXT_IN_CELL]
    else:
        before = head[i, j]
        while entries[before, _NEXT_IN_CELL] != e:
            before = entries[before, _NEXT_IN_CELL]
        entries[before, _NEXT_IN_CELL] = entries[e, _NEXT_IN_CELL]
    after, previous = entries[e, _NEXT], entries[e, _PREVIOUS]
    if after != _NONE:
        entries[after, _PREVIOUS] = previous
    if previous != _NONE:
        entries[previous, _NEXT] = after
    else:
        first[node] = after
    held[node] -= 1
    entries[e, _NEXT_IN_CELL] = free[0]
    free[0] = e
    free[1] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def forget_node(node: int, head: Ints, entries: Ints, first: Ints, held: Ints, free: Ints) -> None:
    """Remove all entries of a node."""
    while first[node] != _NONE:
        _remove(first[node], head, entries, first, held, free)


@njit(cache=True, nogil=True, error_model="numpy")
def relabel(
    gone: int, kept: int, gone_is_child: bool, head: Ints, entries: Ints, first: Ints, held: Ints, free: Ints
) -> None:
    """Give the entries of one node to another; where both have one, the child's is what both then have."""
    while first[gone] != _NONE:
        e = first[gone]
        other = head[entries[e, _ROW], entries[e, _COL]]
        while other != _NONE and entries[other, _NODE] != kept:
            other = entries[other, _NEXT_IN_CELL]
        if other != _NONE and not gone_is_child:
            _remove(e, head, entries, first, held, free)
            continue
        if other != _NONE:
            _remove(other, head, entries, first, held, free)
        first[gone] = entries[e, _NEXT]
        if first[gone] != _NONE:
            entries[first[gone], _PREVIOUS] = _NONE
        held[gone] -= 1
        entries[e, _NODE] = kept
        _link(e, kept, entries, first, held)
