"""The blocks of a belief's grid, kept from one decision to the next: what was not drawn since is not done anew.

Bit for bit the same as :func:`agents.ways.coarsening.fill_blocks` of the whole. A wall matters for distances no
farther than these say anything, so that a box of new walls is measured within a box grown by that much.
"""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np

from agents.ways.boxes import NOTHING, Box, carried
from agents.ways.coarsening import FAR_M, OCCUPIED_LEAST, Blocks, fill_blocks, known_extent, to_walls
from slam.grids.occupancy import OccupancyGrid
from slam.types import Floats

__all__ = ["KeptBlocks"]

# OpenCV's distances come from IPP on x86, which takes columns so many at a time (4 where it was tried, 16 at
# most): how the last bit is rounded depends on where a column lies among them, counted from the left edge, and on
# the columns left over at the right one.
_LANES = 16


class KeptBlocks:
    """Blocks of ``factor`` × ``factor`` cells of a grid, brought up to date by :meth:`follow`.

    Attributes
    ----------
    factor : int
        Fine cells to a side of a block.
    blocks : Blocks
        As of the last call. The arrays are written into by the next one.
    box : Box
        What they cover, the ring included, in blocks of the frame's lattice.
    """

    def __init__(self, factor: int) -> None:
        self.factor = factor
        self._grid: OccupancyGrid | None = None
        self._revision = self._drawing = -1
        self._known = NOTHING  # box of what is known or visited …
        self._extent = NOTHING  # … and the robot; both in cells of the lattice
        self._distance: Floats = np.zeros((0, 0), dtype=np.float32)
        self._frame = NOTHING  # what the distances cover, in cells of the lattice
        self.blocks, self.box = Blocks.blank(0, 0), NOTHING

    def follow(self, grid: OccupancyGrid, robot: tuple[int, int]) -> list[Box]:
        """Take in what was drawn; return the boxes of blocks that may be others, as seen from the box's corner.

        ``robot`` is its cell of the grid (row, column), which is covered, too.
        """
        frame = Box(0, 0, *grid.shape).moved(*grid.lattice_origin)
        same = grid is self._grid and grid.revision == self._revision
        drawn = Box(*grid.drawn_since(self._drawing if same else -1)).moved(*grid.lattice_origin)
        extent = self._extent_of(grid, drawn, frame, robot, same)
        same &= extent.around(self._extent) == extent and (extent.col0 - self._extent.col0) % _LANES == 0
        before = self._extent if same else NOTHING
        if frame != self._frame or not same:
            self._distance = carried(self._distance, self._frame, frame, before, np.inf)
        self._frame, self._extent = frame, extent
        self._grid, self._revision, self._drawing = grid, grid.revision, grid.drawings
        drawn = drawn.within(extent) if same else extent
        stale = self._stale(drawn, before)
        for box in stale:
            self._measure(box)
        if not any(drawn.within(box) == drawn for box in stale):
            stale.append(drawn)
        return self._fill(stale, before)

    @property
    def corner(self) -> tuple[int, int]:
        """Lattice row and column of the first fine cell that there is a block of."""
        return self._extent.row0, self._extent.col0

    def _extent_of(self, grid: OccupancyGrid, drawn: Box, frame: Box, robot: tuple[int, int], same: bool) -> Box:
        """Return the box of what is known and the robot: the grid's spare rim costs time."""
        here = drawn.seen_from(frame).slices
        known = Box(*known_extent(grid.log_odds[here], grid.visited[here])).moved(drawn.row0, drawn.col0)
        # Once known, a cell stays known until the whole is redrawn.
        self._known = known.around(self._known) if same else known
        at = Box(robot[0], robot[1], robot[0] + 1, robot[1] + 1).moved(frame.row0, frame.col0)
        return self._known.around(at)

    def _stale(self, drawn: Box, before: Box) -> list[Box]:
        """Return the boxes of cells whose distance may be another than before."""
        extent = self._extent
        if before.empty:
            return [extent]
        here = drawn.seen_from(self._frame).slices
        assert self._grid is not None
        walls = (self._grid.log_odds[here] >= OCCUPIED_LEAST) != (self._distance[here] == 0.0)
        boxes = [Box.of(walls).moved(drawn.row0, drawn.col0).grown(self._reach), *extent.without(before)]
        if extent.col1 != before.col1:
            boxes.append(Box(extent.row0, before.col1 - _LANES, extent.row1, extent.col1).grown(self._reach))
        return [box.within(extent) for box in boxes if not box.empty]

    @property
    def _reach(self) -> int:
        """How many cells off a wall may matter; a distance is never less than the columns or rows between."""
        assert self._grid is not None
        return math.ceil(FAR_M / self._grid.resolution) + 2 + _LANES

    def _measure(self, box: Box) -> None:
        """Measure the distances in a box, from the walls within reach."""
        window = box.grown(self._reach).within(self._extent)
        window = window._replace(col0=window.col0 - (window.col0 - self._extent.col0) % _LANES)
        assert self._grid is not None
        away = to_walls(self._grid.log_odds[window.seen_from(self._frame).slices])
        self._distance[box.seen_from(self._frame).slices] = away[box.seen_from(window).slices]

    def _fill(self, changed: list[Box], before: Box) -> list[Box]:
        """Fill the blocks that have a cell in a changed box, or were cut off at the rim; return their boxes."""
        factor, extent, grid = self.factor, self._extent, self._grid
        assert grid is not None
        box = _blocks_of(extent, factor).grown(1)
        boxes = [_blocks_of(cells, factor) for cells in changed if not cells.empty]
        if extent != before:
            # What was on the rim may have been cut off: those blocks are done anew.
            inner = NOTHING if before.empty else _blocks_of(before, factor).grown(-1)
            blocks, blank = self.blocks, Blocks.blank(1, 1)
            self.blocks = Blocks(*(
                carried(getattr(blocks, plane.name), self.box, box, inner, getattr(blank, plane.name)[0, 0])
                for plane in fields(Blocks)
            ))  # fmt: skip
            boxes += box.grown(-1).without(inner)
        self.box = box
        corner = extent.seen_from(self._frame)
        for part in boxes:
            fill_blocks(
                grid.log_odds, grid.visited, self._distance, corner, part.seen_from(box), grid.resolution, factor,
                extent.row0 % factor, extent.col0 % factor,
                self.blocks.classes, self.blocks.clearance, self.blocks.suspect,
            )  # fmt: skip
        return [part.seen_from(box) for part in boxes]


def _blocks_of(cells: Box, factor: int) -> Box:
    """Return the blocks that cells lie in, of the frame's lattice."""
    row0, col0, row1, col1 = cells
    return Box(row0 // factor, col0 // factor, -(-row1 // factor), -(-col1 // factor))
