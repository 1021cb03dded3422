"""Boxes of cells: what was drawn, what of it matters how far around, and what is new when a map has grown."""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam.types import Flags

__all__ = ["NOTHING", "Box", "carried"]

Kind = TypeVar("Kind", bound=np.generic)


class Box(NamedTuple):
    """Rows [row0, row1) and columns [col0, col1); nothing is in it where either are none."""

    row0: int
    col0: int
    row1: int
    col1: int

    @property
    def empty(self) -> bool:
        """Whether no cell is in it."""
        return self.row0 >= self.row1 or self.col0 >= self.col1

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.row1 - self.row0, self.col1 - self.col0

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns, to index an array with that begins at (0, 0)."""
        return slice(self.row0, self.row1), slice(self.col0, self.col1)

    def grown(self, cells: int) -> Box:
        """Return it with so many cells more on every side; an empty one stays empty."""
        row0, col0, row1, col1 = self
        return self if self.empty else Box(row0 - cells, col0 - cells, row1 + cells, col1 + cells)

    def moved(self, rows: int, cols: int) -> Box:
        """Return it as far away as this."""
        return Box(self.row0 + rows, self.col0 + cols, self.row1 + rows, self.col1 + cols)

    def seen_from(self, other: Box) -> Box:
        """Return it as counted from another's corner."""
        return self.moved(-other.row0, -other.col0)

    def within(self, other: Box) -> Box:
        """Return what of it is in another."""
        (row0, col0, row1, col1), (r0, c0, r1, c1) = self, other
        return Box(max(row0, r0), max(col0, c0), min(row1, r1), min(col1, c1))

    def around(self, other: Box) -> Box:
        """Return the least box that holds it and another."""
        if self.empty or other.empty:
            return other if self.empty else self
        (row0, col0, row1, col1), (r0, c0, r1, c1) = self, other
        return Box(min(row0, r0), min(col0, c0), max(row1, r1), max(col1, c1))

    def without(self, other: Box) -> list[Box]:
        """Return what of it is not in another: bands below and above of that, to the left and to the right."""
        inner = other.within(self)
        if inner.empty:
            return [self]
        row0, col0, row1, col1 = self
        bands = [
            Box(row0, col0, inner.row0, col1), Box(inner.row1, col0, row1, col1),
            Box(inner.row0, col0, inner.row1, inner.col0), Box(inner.row0, inner.col1, inner.row1, col1),
        ]  # fmt: skip
        return [band for band in bands if not band.empty]

    @classmethod
    def of(cls, marks: Flags) -> Box:
        """Return the box around the marks of a plane ``(rows, cols)``."""
        rows, cols = np.flatnonzero(marks.any(axis=1)), np.flatnonzero(marks.any(axis=0))
        return cls(int(rows[0]), int(cols[0]), int(rows[-1]) + 1, int(cols[-1]) + 1) if len(rows) else NOTHING


NOTHING = Box(0, 0, 0, 0)


def carried(plane: NDArray[Kind], old: Box, new: Box, kept: Box, blank: Any) -> NDArray[Kind]:
    """Return a plane over the box ``new``, ``blank`` but for what is ``kept`` of one over ``old``."""
    out = np.full(new.shape, blank, dtype=plane.dtype)
    if not kept.empty:
        out[kept.seen_from(new).slices] = plane[kept.seen_from(old).slices]
    return out
