"""The ancestry tree of DP-SLAM's particles (Eliazar and Parr 2003): who descends from whom, kept minimal.

Every particle is a leaf. A node holds what its particle observed while it was a leaf: its descendants share it.
When particles are resampled, leaves without descendants are removed with all that only they had observed, up to
the nearest node that still has a descendant, and a node with a single child left is merged with it. So inner
nodes have at least two children, and n particles have at most 2n - 1 nodes, however long the history.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slam.types import Indices

__all__ = ["Ancestry"]

_FREE = -2
_NOBODY = -1


class Ancestry:
    """A tree whose nodes are small numbers, used again once their node is gone.

    Attributes
    ----------
    parent : NDArray[np.int32]
        ``(2 particles,)``: a node's parent, -1 of the root, -2 of a number not in use.
    leaf : NDArray[np.int64]
        ``(particles,)``: each particle's node.
    """

    def __init__(self, particles: int) -> None:
        self.parent = np.full(2 * particles, _FREE, np.int32)
        self.leaf = np.zeros(particles, np.int64)
        self._children = np.zeros(2 * particles, np.int32)
        self.parent[0] = _NOBODY
        self._unused = list(range(2 * particles - 1, 0, -1))
        if particles > 1:
            self._split(0, np.arange(particles))

    @property
    def nodes(self) -> Indices:
        """The nodes there are, the inner ones included."""
        return np.flatnonzero(self.parent != _FREE)

    def lineage(self, particle: int) -> list[int]:
        """Return a particle's nodes from its leaf to the root."""
        nodes, node = [], int(self.leaf[particle])
        while node != _NOBODY:
            nodes.append(node)
            node = int(self.parent[node])
        return nodes

    def resample(
        self, ancestors: Indices, *, forget: Callable[[int], None], merge: Callable[[int, int], int],
    ) -> None:  # fmt: skip
        """Let particle i descend from particle ``ancestors[i]`` ``(particles,)``.

        Parameters
        ----------
        ancestors : NDArray[np.int64]
            A particle that survives must have a descendant; it need not be itself.
        forget : callable
            Called with each node that is removed.
        merge : callable
            Called with a node and its only child, after which both are one; returns which of the two numbers
            goes on. What the child observed goes before what its parent did.
        """
        copies = np.bincount(ancestors, minlength=len(self.leaf))
        before = self.leaf.copy()
        for particle in np.flatnonzero(copies == 0):
            self._die(int(before[particle]), before, forget, merge)
        self.leaf[:] = before[ancestors]
        for particle in np.flatnonzero(copies > 1):
            self._split(int(before[particle]), np.flatnonzero(ancestors == particle))

    def _split(self, node: int, particles: Indices) -> None:
        for particle in particles:
            new = self._unused.pop()
            self.parent[new], self.leaf[particle] = node, new
            self._children[new] = 0
        self._children[node] = len(particles)

    def _die(
        self, node: int, leaves: Indices, forget: Callable[[int], None], merge: Callable[[int, int], int]
    ) -> None:
        parent = int(self.parent[node])
        forget(node)
        self._release(node)
        # Inner nodes have two children at least, so the parent has one left at least.
        self._children[parent] -= 1
        if self._children[parent] > 1:
            return
        child = int(np.flatnonzero(self.parent == parent)[0])
        kept = merge(parent, child)
        gone, above = (child if kept == parent else parent), int(self.parent[parent])
        children = int(self._children[child])
        self.parent[self.parent == child] = kept
        leaves[leaves == child] = kept
        self._release(gone)
        self.parent[kept], self._children[kept] = above, children

    def _release(self, node: int) -> None:
        self.parent[node] = _FREE
        self._unused.append(node)
