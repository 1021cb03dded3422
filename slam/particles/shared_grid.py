"""DP-SLAM's one grid that all particles share (Eliazar and Parr 2003, 2004), and the naive copies it stands for.

A tile of 8 × 8 cells has evidence under the nodes of the ancestry that observed it. A particle's evidence is that
of its nearest ancestor that has any; what a particle adds goes under its own leaf, on top of a copy of what it
had inherited. So maps are copied nowhere: resampling touches the tree, and what only the dead had seen.

The paper keeps a list of observations in every cell. Here a hash table finds the entry of a tile and a node: a
scan touches thousands of neighbouring cells, for 64 of which the ancestors are asked once; and a list grows with
the particles, while a particle has few ancestors.

Merging a node with its only child relabels the entries of whichever has fewer, and drops those of the parent that
the child had overwritten. (The paper relabels the parent's, which most often are the whole map.)
"""

from __future__ import annotations

import numpy as np
from numba import njit

from slam.particles.ancestry import Ancestry
from slam.particles.grids import Ints, ParticleGrids, ScanCells
from slam.types import Array, Floats, Indices

__all__ = ["TILE", "CopiedGrids", "SharedGrid"]

TILE = 8
"""Cells a side of what is shared or copied as one."""

_SHIFT, _MASK = 3, 7  # of a cell's index: its tile, and its place there
_ROW, _COL, _NODE, _CHAIN, _NEXT, _PREVIOUS = range(6)
_NONE = -1


class SharedGrid(ParticleGrids):
    """All particles' maps in one grid.

    ``live`` is the number of entries, ``ancestry`` the tree. An entry is lattice row and column of its tile, its
    node (-1: not in use), the next entry of equal hash, and the next and previous of its node; its evidence lies
    beside it.
    """

    def __init__(self, particles: int, cell_m: float) -> None:
        super().__init__(particles, cell_m)
        self.ancestry = Ancestry(particles)
        self._head = np.full(2, _NONE, np.int32)  # first entry of each hash
        self._entries = np.zeros((0, 6), np.int32)
        self._evidence = np.zeros((0, TILE, TILE, 4), np.float32)
        self._first = np.full(2 * particles, _NONE, np.int32)  # entry of each node …
        self._held = np.zeros(2 * particles, np.int32)  # … and how many it has
        self._free = np.array([_NONE, 0], np.int32)  # first unused entry, and how many there are
        self._look = 0
        self._found = self._blank()
        self._more(256)

    def _blank(self) -> Ints:
        """Of each tile of the lattice: who looked last, and what was found."""
        rows, cols = self.lattice.shape
        return np.zeros((rows // TILE, cols // TILE, 2), np.int32)

    @property
    def live(self) -> int:
        """Number of entries in use."""
        return len(self._entries) - int(self._free[1])

    @property
    def nbytes(self) -> int:
        """Memory [bytes] of the grid and of the entries, those not in use included."""
        return sum(a.nbytes for a in (self._head, self._found, self._entries, self._evidence, self._first))

    def entries(self) -> Ints:
        """Return lattice row and column of the tile, and node, of every entry in use ``(live, 3)``."""
        return self._entries[self._entries[:, _NODE] != _NONE, :3].copy()

    def enclose(self, low: Array, high: Array) -> None:
        """Make room for the box from ``low`` to ``high`` ``(2,)`` [m]."""
        if self.lattice.enclose(low, high) is not None:
            self._found = self._blank()

    def write(self, particle: int, scan: ScanCells) -> None:
        """Add a scan's evidence to a particle's map."""
        self._look += 1
        tiles = count_tiles(self._found, self._look, scan.cells, scan.count)
        if self._free[1] < tiles:
            self._more(max(tiles, len(self._entries) // 2))
        self._look += 1
        write_entries(
            self._head, self._found, self._look, self._entries, self._evidence, self._first, self._held,
            self._free, self._lineage(particle), self.lattice.row >> _SHIFT, self.lattice.col >> _SHIFT,
            scan.cells, scan.evidence, scan.count,
        )  # fmt: skip

    def resample(self, ancestors: Indices) -> None:
        """Let particle i have the map of particle ``ancestors[i]``."""
        self.ancestry.resample(ancestors, forget=self._forget, merge=self._merge)

    def read(self, particle: int, cells: Ints, out: Floats) -> None:
        """Write the evidence ``(n, 4)`` that a particle has of array cells ``(n, 2)``."""
        self._look += 1
        read_entries(
            self._head, self._found, self._look, self._entries, self._evidence, self._lineage(particle),
            self.lattice.row >> _SHIFT, self.lattice.col >> _SHIFT, cells, out,
        )  # fmt: skip

    def _lineage(self, particle: int) -> Ints:
        return np.array(self.ancestry.lineage(particle), np.int32)

    def _forget(self, node: int) -> None:
        forget_node(node, self._head, self._entries, self._first, self._held, self._free)

    def _merge(self, parent: int, child: int) -> int:
        gone, kept = (child, parent) if self._held[child] <= self._held[parent] else (parent, child)
        relabel(gone, kept, kept == parent, self._head, self._entries, self._first, self._held, self._free)
        return kept

    def _more(self, count: int) -> None:
        size = len(self._entries)
        fresh = np.full((count, 6), _NONE, np.int32)
        fresh[:, _CHAIN] = np.append(np.arange(size + 1, size + count), self._free[0])
        self._entries = np.vstack([self._entries, fresh])
        self._evidence = np.concatenate([self._evidence, np.zeros((count, TILE, TILE, 4), np.float32)])
        self._free[:] = size, self._free[1] + count
        if len(self._head) < len(self._entries):
            self._head = np.full(1 << (2 * len(self._entries)).bit_length(), _NONE, np.int32)
            hash_again(self._head, self._entries)


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

    def resample(self, ancestors: Indices) -> None:
        """Let particle i have the map of particle ``ancestors[i]``."""
        self._maps = self._maps[ancestors]

    def read(self, particle: int, cells: Ints, out: Floats) -> None:
        """Write the evidence ``(n, 4)`` that a particle has of array cells ``(n, 2)``."""
        out[:] = self._maps[particle, cells[:, 0], cells[:, 1]]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _hash(row: int, col: int, node: int, size: int) -> int:
    """Return the place in a table of ``size``, a power of two (primes of Teschner et al. 2003)."""
    mixed = (row * 73856093) ^ (col * 19349663) ^ (node * 83492791)
    return (mixed ^ (mixed >> 15)) & (size - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def hash_again(head: Ints, entries: Ints) -> None:
    """Put all entries in use into an empty table."""
    for e in range(entries.shape[0]):
        if entries[e, _NODE] != _NONE:
            _enter(e, head, entries)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _enter(e: int, head: Ints, entries: Ints) -> None:
    place = _hash(entries[e, _ROW], entries[e, _COL], entries[e, _NODE], head.shape[0])
    entries[e, _CHAIN] = head[place]
    head[place] = e


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _leave(e: int, head: Ints, entries: Ints) -> None:
    place = _hash(entries[e, _ROW], entries[e, _COL], entries[e, _NODE], head.shape[0])
    if head[place] == e:
        head[place] = entries[e, _CHAIN]
        return
    before = head[place]
    while entries[before, _CHAIN] != e:
        before = entries[before, _CHAIN]
    entries[before, _CHAIN] = entries[e, _CHAIN]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _entry(row: int, col: int, node: int, head: Ints, entries: Ints) -> int:
    """Return the entry of a tile and a node, or -1."""
    e: int = head[_hash(row, col, node, head.shape[0])]
    while e != _NONE and not (entries[e, _ROW] == row and entries[e, _COL] == col and entries[e, _NODE] == node):
        e = entries[e, _CHAIN]
    return e


@njit(cache=True, nogil=True, error_model="numpy")
def _find(row: int, col: int, lineage: Ints, head: Ints, entries: Ints) -> int:
    """Return the entry of the nearest ancestor, ``lineage`` from the leaf to the root, or -1."""
    for k in range(lineage.shape[0]):
        e = _entry(row, col, lineage[k], head, entries)
        if e != _NONE:
            return e
    return _NONE


@njit(cache=True, nogil=True, error_model="numpy")
def read_entries(
    head: Ints, found: Ints, look: int, entries: Ints, evidence: Floats, lineage: Ints, row: int, col: int,
    cells: Ints, out: Floats,
) -> None:  # fmt: skip
    """Write what a particle of this lineage has of each cell; for every tile its ancestors are asked once a look.

    ``row`` and ``col`` are the lattice's first tile.
    """
    for k in range(cells.shape[0]):
        i, j = cells[k, 0] >> _SHIFT, cells[k, 1] >> _SHIFT
        if found[i, j, 0] != look:
            found[i, j, 0], found[i, j, 1] = look, _find(i + row, j + col, lineage, head, entries)
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
    lineage: Ints, row: int, col: int, cells: Ints, added: Floats, count: int,
) -> None:  # fmt: skip
    """Add a scan under a leaf; ``free`` must have room for a new entry in every tile that it touches."""
    leaf = lineage[0]
    for k in range(count):
        i, j = cells[k, 0] >> _SHIFT, cells[k, 1] >> _SHIFT
        if found[i, j, 0] != look:
            e = _find(i + row, j + col, lineage, head, entries)
            if e == _NONE or entries[e, _NODE] != leaf:
                new = free[0]
                free[0] = entries[new, _CHAIN]
                free[1] -= 1
                if e != _NONE:
                    evidence[new] = evidence[e]
                else:
                    evidence[new] = 0.0
                entries[new, _ROW], entries[new, _COL], entries[new, _NODE] = i + row, j + col, leaf
                _enter(new, head, entries)
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
    """Take an entry out of the table and of its node's list, and give it back."""
    _leave(e, head, entries)
    node, after, previous = entries[e, _NODE], entries[e, _NEXT], entries[e, _PREVIOUS]
    if after != _NONE:
        entries[after, _PREVIOUS] = previous
    if previous != _NONE:
        entries[previous, _NEXT] = after
    else:
        first[node] = after
    held[node] -= 1
    entries[e, _NODE] = _NONE
    entries[e, _CHAIN] = free[0]
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
        other = _entry(entries[e, _ROW], entries[e, _COL], kept, head, entries)
        if other != _NONE and not gone_is_child:
            _remove(e, head, entries, first, held, free)
            continue
        if other != _NONE:
            _remove(other, head, entries, first, held, free)
        _leave(e, head, entries)
        first[gone] = entries[e, _NEXT]
        if first[gone] != _NONE:
            entries[first[gone], _PREVIOUS] = _NONE
        held[gone] -= 1
        entries[e, _NODE] = kept
        _enter(e, head, entries)
        _link(e, kept, entries, first, held)
