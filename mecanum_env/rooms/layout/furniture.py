"""Furniture: pieces placed in a rectangular room so that a robot is never trapped between them.

Everything is counted in cells of 0.05 m. Between a piece and a wall or another piece there is either no gap at
all or one wide enough to drive through, so the free space of a furnished room stays in one piece.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["CELL_M", "GAP", "Box", "Furnisher", "Piece", "cells"]

CELL_M = 0.05
"""Side of a cell [m]; all axis-aligned geometry of the generators lies on this lattice."""
GAP = 19
"""Least open gap between pieces, and between a piece and a wall [cells]: 0.95 m."""

_TRIES = 14  # random places for a piece

Box = tuple[int, int, int, int]
"""x_min, y_min, x_max, y_max [cells]."""


def cells(metres: float) -> int:
    """Return a length in whole cells, rounded to the nearest."""
    return round(metres / CELL_M)


@dataclass(frozen=True, slots=True)
class Piece:
    """One piece of furniture: a box, a box turned by an angle, or a round one."""

    box: Box  # its bounding box [cells]; for a plain box, its outline
    angle: float = 0.0  # [rad]; a turned box of ``size`` about the centre of ``box``
    size: tuple[float, float] = (0.0, 0.0)  # [cells] of a turned box
    radius: float = 0.0  # [cells] of a round piece

    @property
    def centre_m(self) -> tuple[float, float]:
        """Centre of the piece [m]."""
        x0, y0, x1, y1 = self.box
        return 0.5 * (x0 + x1) * CELL_M, 0.5 * (y0 + y1) * CELL_M

    def polygon(self) -> NDArray[np.float64]:
        """Return the outline of a piece that is not round: ``(4, 2)`` vertices [m], counter-clockwise."""
        if not self.angle:
            x0, y0, x1, y1 = self.box
            return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], np.float64) * CELL_M
        c, s = math.cos(self.angle), math.sin(self.angle)
        a, b = (0.5 * v * CELL_M for v in self.size)
        local = np.array([(-a, -b), (a, -b), (a, b), (-a, b)])
        return np.asarray(local @ np.array([[c, s], [-s, c]]) + self.centre_m, np.float64)


@dataclass(slots=True)
class Furnisher:
    """Places furniture in one rectangular room.

    Each method tries some random places and takes the first that fits; it returns whether one did.
    """

    room: Box  # the floor [cells]
    rng: np.random.Generator
    keep_clear: list[Box] = field(default_factory=list)  # before doors
    pieces: list[Piece] = field(default_factory=list, init=False)

    @property
    def covered(self) -> float:
        """Share of the floor under the pieces' bounding boxes."""
        x0, y0, x1, y1 = self.room
        area = sum((b[2] - b[0]) * (b[3] - b[1]) for b in (p.box for p in self.pieces))
        return area / float((x1 - x0) * (y1 - y0))

    def against_wall(self, width_m: float, depth_m: float, *, corner: float = 0.35) -> bool:
        """Place a box with its back to a wall; ``corner`` is the probability that it fills a corner."""
        return self._try_sides([(0.0, width_m, 0.0, depth_m)], width_m, corner)

    def bed(self, width_m: float, length_m: float, *, tables: int) -> bool:
        """Place a bed, head to a wall, with bedside tables 0.45 m square on 0, 1 or 2 sides."""
        group = [(0.0, width_m, 0.0, length_m)]
        if tables >= 1:
            group.append((width_m, width_m + 0.45, 0.0, 0.4))
        if tables >= 2:
            group.append((-0.45, 0.0, 0.0, 0.4))
        return self._try_sides(group, width_m, 0.25 if tables < 2 else 0.0)

    def desk(self, width_m: float, depth_m: float) -> bool:
        """Place a desk against a wall with a chair pushed up to its middle."""
        left = CELL_M * cells(0.5 * (width_m - 0.45))
        group = [(0.0, width_m, 0.0, depth_m), (left, left + 0.45, depth_m, depth_m + 0.4)]
        return self._try_sides(group, width_m, 0.0)

    def corner_sofa(self, width_m: float, leg_m: float) -> bool:
        """Place an L-shaped sofa 0.9 m deep, its back in a corner where one is free."""
        group = [(0.0, width_m, 0.0, 0.9), (0.0, 0.9, 0.9, 0.9 + leg_m)]
        return self._try_sides(group, width_m, 0.6)

    def kitchen(self, width_m: float, leg_m: float) -> bool:
        """Place a worktop 0.6 m deep along a wall and round the room's corner."""
        group = [(0.0, width_m, 0.0, 0.6), (0.0, 0.6, 0.6, 0.6 + leg_m)]
        return self._try_sides(group if leg_m > 0 else group[:1], width_m, 1.0)

    def island(self, width_m: float, depth_m: float, *, chairs: int = 0) -> bool:
        """Place a free-standing table, along the room, with chairs in the middle of 0, 2 or 4 of its sides."""
        x0, y0, x1, y1 = self.room
        w, d = cells(width_m), cells(depth_m)
        if (x1 - x0 < y1 - y0) != bool(self.rng.random() < 0.15):
            w, d = d, w
        group: list[Box] = [(0, 0, w, d)]
        if chairs:
            side, long = 8, w >= d
            cx, cy = (w - 9) // 2, (d - 9) // 2
            if chairs == 4 or long:
                group += [(cx, -side, cx + 9, 0), (cx, d, cx + 9, d + side)]
            if chairs == 4 or not long:
                group += [(-side, cy, 0, cy + 9), (w, cy, w + side, cy + 9)]
        return self._try_free(group)

    def turned_box(self, width_m: float, depth_m: float) -> bool:
        """Place a free-standing box at a random angle of 15° to 75°, or that less 90°."""
        angle = math.radians(float(self.rng.uniform(15.0, 75.0)))
        w, d = width_m / CELL_M, depth_m / CELL_M
        c, s = math.cos(angle), math.sin(angle)
        span = math.ceil(w * c + d * s), math.ceil(w * s + d * c)
        if self.rng.random() < 0.5:
            angle, span = angle - 0.5 * math.pi, (span[1], span[0])
        return self._try_free([(0, 0, *span)], flush=False, angle=angle, size=(w, d))

    def round_table(self, radius_m: float) -> bool:
        """Place a free-standing round table or column."""
        r = cells(radius_m)
        return self._try_free([(0, 0, 2 * r, 2 * r)], flush=False, radius=float(r))

    def _try_free(self, group: list[Box], *, flush: bool = True, **shape: Any) -> bool:
        """Place pieces of a shape, given by their boxes about any origin, away from the walls."""
        left, below = min(b[0] for b in group), min(b[1] for b in group)
        right, above = max(b[2] for b in group), max(b[3] for b in group)
        for _ in range(_TRIES):
            place = self._free_place(right - left, above - below)
            if place is None:
                return False
            dx, dy = place[0] - left, place[1] - below
            if self._keep([(a + dx, b + dy, c + dx, d + dy) for a, b, c, d in group], flush, **shape):
                return True
        return False

    def _keep(self, boxes: list[Box], flush: bool = True, **shape: Any) -> bool:
        """Add pieces if they fit; return whether they do."""
        fit = self._fits(boxes, flush=flush)
        if fit:
            self.pieces += [Piece(box, **shape) for box in boxes]
        return fit

    def _free_place(self, width: int, depth: int) -> tuple[int, int] | None:
        """Random lower-left corner of a box that keeps the gap to all walls."""
        x0, y0, x1, y1 = self.room
        room_x, room_y = x1 - x0 - 2 * GAP - width, y1 - y0 - 2 * GAP - depth
        if room_x < 0 or room_y < 0:
            return None
        # Mean of two draws: tables stand in the middle of a room rather than at its edge.
        u, v = 0.5 * (self.rng.random(2) + self.rng.random(2))
        return x0 + GAP + int(u * (room_x + 1)), y0 + GAP + int(v * (room_y + 1))

    def _try_sides(self, group: list[tuple[float, float, float, float]], width_m: float, corner: float) -> bool:
        """Place boxes given as (along from, along to, off the wall from, to) [m] against a random wall."""
        local = [(cells(a), cells(b), cells(c), cells(d)) for a, b, c, d in group]
        width = cells(width_m)
        x0, y0, x1, y1 = self.room
        lengths = (x1 - x0, y1 - y0)
        for _ in range(_TRIES):
            side = int(self.rng.integers(4))
            length = lengths[side % 2]
            if length < width:
                continue
            mirrored = bool(self.rng.random() < 0.5)
            at = 0 if self.rng.random() < corner else int(self.rng.integers(length - width + 1))
            if self._keep([self._against(side, at, length, mirrored, piece) for piece in local]):
                return True
        return False

    def _against(self, side: int, at: int, length: int, mirrored: bool, piece: tuple[int, int, int, int]) -> Box:
        """Box of a piece in the frame of a wall (0 lower, 1 left, 2 upper, 3 right)."""
        x0, y0, x1, y1 = self.room
        a, b, near, far = at + piece[0], at + piece[1], piece[2], piece[3]
        if mirrored:
            a, b = length - b, length - a
        if side == 0:
            return x0 + a, y0 + near, x0 + b, y0 + far
        if side == 1:
            return x0 + near, y0 + a, x0 + far, y0 + b
        if side == 2:
            return x0 + a, y1 - far, x0 + b, y1 - near
        return x1 - far, y0 + a, x1 - near, y0 + b

    def _fits(self, boxes: list[Box], *, flush: bool = True) -> bool:
        """Whether boxes lie in the room, off the doors, and leave no gap that is neither shut nor wide."""
        x0, y0, x1, y1 = self.room
        for bx0, by0, bx1, by1 in boxes:
            to_walls = (
                (x0, by0, bx0, by1),
                (bx0, y0, bx1, by0),
                (bx1, by0, x1, by1),
                (bx0, by1, bx1, y1),
            )
            for i, strip in enumerate(to_walls):
                gap = strip[2 + i % 2] - strip[i % 2]
                if gap < 0 or (gap == 0 and not flush):
                    return False
                # A chair is as near to the wall as its desk is deep: what fills the gap is no gap.
                if 0 < gap < GAP and not any(_contains(box, strip) for box in boxes):
                    return False
            for zx0, zy0, zx1, zy1 in self.keep_clear:
                if bx0 < zx1 and zx0 < bx1 and by0 < zy1 and zy0 < by1:
                    return False
            for piece in self.pieces:
                px0, py0, px1, py1 = piece.box
                gap_x, gap_y = max(bx0 - px1, px0 - bx1), max(by0 - py1, py0 - by1)
                if gap_x < 0 and gap_y < 0:
                    return False
                touching = (gap_x == 0 and gap_y < 0) or (gap_y == 0 and gap_x < 0)
                if touching:
                    if not flush or piece.radius or piece.angle:
                        return False
                elif math.hypot(max(gap_x, 0), max(gap_y, 0)) < GAP:
                    return False
        return True


def _contains(box: Box, part: Box) -> bool:
    return box[0] <= part[0] and box[1] <= part[1] and part[2] <= box[2] and part[3] <= box[3]
