"""DP-SLAM's one grid that all particles share (Eliazar and Parr 2003, 2004), and the naive copies it stands for.

A tile of 8 × 8 cells holds a list of (node of the ancestry, evidence of its cells). A particle's evidence is that
of its nearest ancestor in the list; what a particle adds goes under its own leaf, on top of a copy of what it had
inherited. So maps are copied nowhere: resampling touches the tree, and what only the dead had seen.

The paper keeps a list a cell. A scan touches thousands of neighbouring cells, most of them with entries of the
same particles: one list for 64 of them is walked once instead of 64 times, for a little more memory at the seams.

Merging a node with its only child relabels the entries of whichever has fewer, and drops those of the parent that
the child had overwritten. (The paper relabels the parent's, which most often are the whole map.)
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from slam.ancestry import Ancestry
from slam.particle_grids import Floats, Ints, ParticleGrids, ScanCells

__all__ = ["TILE", "CopiedGrids", "SharedGrid"]

Array = NDArray[np.float64]

TILE = 8
"""Cells a side of what is shared or copied as one."""

_SHIFT, _MASK = 3, 7  # of a cell's index: its tile, and its place there
_ROW, _COL, _NODE, _NEXT_IN_TILE, _NEXT, _PREVIOUS = range(6)
_NONE = -1


class SharedGrid(ParticleGrids):
    """All particles' maps in one grid.

    ``live`` is the number of entries, ``ancestry`` the tree. An entry is row and column of its tile, node, the
    next entry of its tile, and the next and previous of its node; its evidence lies beside it.
    """

    def __init__(self, particles: int, cell_m: float) -> None:
        super().__init__(particles, cell_m)
        self.ancestry = Ancestry(particles)
        self._head = self._blank()  # first entry of each tile
        self._found = np.zeros(
            (*self._head.shape, 2), np.int32
        )  # of each tile: who looked last, and what was found
        self._entries = np.zeros((0, 6), np.int32)
        self._evidence = np.zeros((0, TILE, TILE, 4), np.float32)
        self._first = np.full(2 * particles, _NONE, np.int32)  # entry of each node …
        self._held = np.zeros(2 * particles, np.int32)  # … and how many it has
        self._free = np.array([_NONE, 0], np.int32)  # first unused entry, and how many there are
        self._ranks = np.zeros(2 * particles, np.int32)
        self._look = 0
        self._more(256)

    def _blank(self) -> Ints:
        rows, cols = self.lattice.shape
        return np.full((rows // TILE, cols // TILE), _NONE, np.int32)

    @property
    def live(self) -> int:
        """Number of entries in use."""
        return len(self._entries) - int(self._free[1])

    @property
    def nbytes(self) -> int:
        """Memory [bytes] of the grid and of the entries, those not in use included."""
        return sum(a.nbytes for a in (self._head, self._found, self._entries, self._evidence, self._first))

    def entries_of(self, node: int) -> int:
        """Return how many entries a node has."""
        return int(np.count_nonzero(self._listed()[:, _NODE] == node))

    def _listed(self) -> Ints:
        """Return the entries ``(n, 6)`` that the tiles' lists hold."""
        rows, level = [], self._head[self._head != _NONE]
        while len(level):
            rows.append(level)
            level = self._entries[level, _NEXT_IN_TILE]
            level = level[level != _NONE]
        return self._entries[np.concatenate(rows)] if rows else self._entries[:0]

    def enclose(self, low: Array, high: Array) -> None:
        """Make room for the box from ``low`` to ``high`` ``(2,)`` [m]."""
        grown = self.lattice.enclose(low, high)
        if grown is not None:
            below, left, rows, cols = (v // TILE for v in grown)
            head = self._blank()
            head[below : below + rows, left : left + cols] = self._head
            self._head, self._found = head, np.zeros((*head.shape, 2), np.int32)
            self._entries[:, _ROW] += below
            self._entries[:, _COL] += left

    def write(self, particle: int, scan: ScanCells) -> None:
        """Add a scan's evidence to a particle's map."""
        self.ancestry.ranks(particle, self._ranks)
        self._look += 1
        tiles = count_tiles(self._found, self._look, scan.cells, scan.count)
        if self._free[1] < tiles:
            self._more(max(tiles, len(self._entries) // 2))
        self._look += 1
        write_entries(
            self._head, self._found, self._look, self._entries, self._evidence, self._first, self._held,
            self._free, self._ranks, int(self.ancestry.leaf[particle]), scan.cells, scan.evidence, scan.count,
        )  # fmt: skip

    def resample(self, ancestors: NDArray[np.int64]) -> None:
        """Let particle i have the map of particle ``ancestors[i]``."""
        self.ancestry.resample(ancestors, forget=self._forget, merge=self._merge)

    def read(self, particle: int, cells: Ints, out: Floats) -> None:
        """Write the evidence ``(n, 4)`` that a particle has of array cells ``(n, 2)``."""
        self.ancestry.ranks(particle, self._ranks)
        self._look += 1
        read_entries(self._head, self._found, self._look, self._entries, self._evidence, self._ranks, cells, out)

    def _forget(self, node: int) -> None:
        forget_node(node, self._head, self._entries, self._first, self._held, self._free)

    def _merge(self, parent: int, child: int) -> int:
        gone, kept = (child, parent) if self._held[child] <= self._held[parent] else (parent, child)
        relabel(gone, kept, kept == parent, self._head, self._entries, self._first, self._held, self._free)
        return kept

    def _more(self, count: int) -> None:
        size = len(self._entries)
        fresh = np.zeros((count, 6), np.int32)
        fresh[:, _NEXT_IN_TILE] = np.append(np.arange(size + 1, size + count), self._free[0])
        self._entries = np.vstack([self._entries, fresh])
        self._evidence = np.concatenate([self._evidence, np.zeros((count, TILE, TILE, 4), np.float32)])
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
    """Return the entry of the nearest ancestor in a tile's list, or -1."""
    best, rank, e = _NONE, -1, first
    while e != _NONE:
        r = ranks[entries[e, _NODE]]
        if r > rank:
            best, rank = e, r
        e = entries[e, _NEXT_IN_TILE]
    return best


@njit(cache=True, nogil=True, error_model="numpy")
def read_entries(
    head: Ints, found: Ints, look: int, entries: Ints, evidence: Floats, ranks: Ints, cells: Ints, out: Floats
) -> None:
    """Write what a particle of these ``ranks`` has of each cell; every tile's list is walked once a ``look``."""
    for k in range(cells.shape[0]):
        i, j = cells[k, 0] >> _SHIFT, cells[k, 1] >> _SHIFT
        if found[i, j, 0] != look:
            found[i, j, 0], found[i, j, 1] = look, _find(head[i, j], entries, ranks)
        e = found[i, j, 1]
        for a in range(4):
            out[k, a] = evidence[e, cells[k, 0] & _MASK, cells[k, 1] & _MASK, a] if e != _NONE else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def count_tiles(found: Ints, look: int, cells: Ints, count: int) -> int:
    """Return how many tiles a scan touches."""
    tiles = 0
    for k in range(count):
        i, j = cells[k, 0] >> _SHIFT, cells[k, 1] >> _SHIFT
        if found[i, j, 0] != look:
            found[i, j, 0] = look
            tiles += 1
    return tiles


@njit(cache=True, nogil=True, error_model="numpy")
def write_entries(
    head: Ints, found: Ints, look: int, entries: Ints, evidence: Floats, first: Ints, held: Ints, free: Ints,
    ranks: Ints, leaf: int, cells: Ints, added: Floats, count: int,
) -> None:  # fmt: skip
    """Add a scan under a leaf; ``free`` must have room for a new entry in every tile that it touches."""
    for k in range(count):
        i, j = cells[k, 0] >> _SHIFT, cells[k, 1] >> _SHIFT
        if found[i, j, 0] != look:
            e = _find(head[i, j], entries, ranks)
            if e == _NONE or entries[e, _NODE] != leaf:
                new = free[0]
                free[0] = entries[new, _NEXT_IN_TILE]
                free[1] -= 1
                if e != _NONE:
                    evidence[new] = evidence[e]
                else:
                    evidence[new] = 0.0
                entries[new, _ROW], entries[new, _COL], entries[new, _NODE] = i, j, leaf
                entries[new, _NEXT_IN_TILE] = head[i, j]
                head[i, j] = new
                _link(new, leaf, entries, first, held)
                e = new
            found[i, j, 0], found[i, j, 1] = look, e
        e = found[i, j, 1]
        for a in range(4):
            evidence[e, cells[k, 0] & _MASK, cells[k, 1] & _MASK, a] += added[k, a]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _link(e: int, node: int, entries: Ints, first: Ints, held: Ints) -> None:
    entries[e, _NEXT], entries[e, _PREVIOUS] = first[node], _NONE
    if first[node] != _NONE:
        entries[first[node], _PREVIOUS] = e
    first[node] = e
    held[node] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _remove(e: int, head: Ints, entries: Ints, first: Ints, held: Ints, free: Ints) -> None:
    """Take an entry out of its tile's list and its node's, and give it back."""
    i, j, node = entries[e, _ROW], entries[e, _COL], entries[e, _NODE]
    if head[i, j] == e:
        head[i, j] = entries[e, _NEXT_IN_TILE]
    else:
        before = head[i, j]
        while entries[before, _NEXT_IN_TILE] != e:
            before = entries[before, _NEXT_IN_TILE]
        entries[before, _NEXT_IN_TILE] = entries[e, _NEXT_IN_TILE]
    after, previous = entries[e, _NEXT], entries[e, _PREVIOUS]
    if after != _NONE:
        entries[after, _PREVIOUS] = previous
    if previous != _NONE:
        entries[previous, _NEXT] = after
    else:
        first[node] = after
    held[node] -= 1
    entries[e, _NEXT_IN_TILE] = free[0]
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
            other = entries[other, _NEXT_IN_TILE]
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
