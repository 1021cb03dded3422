"""From rooms and furniture to a checked floor plan: surfaces, raster, repair and start pose."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError, clearance_of
from mecanum_env.rooms.layout.furniture import CELL_M, Box, Piece
from mecanum_env.rooms.outlines.distance import distance_to_zero, largest_part
from mecanum_env.rooms.outlines.rectilinear import raster, surfaces
from slam.files import quoted
from slam.types import Flags, Floats

__all__ = ["DRIVE_RADIUS_M", "START_M", "assemble", "choose_start", "generator", "unreached"]

DRIVE_RADIUS_M = 0.40
"""Disc that can be driven everywhere in a generated plan [m]: a youBot, 0.347 m, with 5 cm to spare."""
START_M = 0.5
"""Clearance of a generated plan's start [m]: what is left where the raster cuts round and turned pieces short."""
_MAX_POCKET_M2 = 0.25  # largest patch of free space that the disc may leave unswept, such as a corner's rest
_START_CLEARANCES_M = (0.65, 0.60, 0.55)
_HEADINGS = (0.0, 0.5 * math.pi, -math.pi, -0.5 * math.pi)


def generator(seed: int) -> np.random.Generator:
    """Return the random generator of a plan's seed: PCG64, the same stream on every machine.

    Raises
    ------
    ValueError
        If the seed is not an integer ≥ 0.
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"a room's seed must be an integer ≥ 0, got {quoted(seed)}")
    return np.random.Generator(np.random.PCG64(int(seed)))


def assemble(
    name: str, floors: Sequence[Box], pieces: Sequence[Piece], *, size: tuple[int, int], rng: np.random.Generator
) -> FloorPlan:
    """Return the floor plan of free rectangles and furniture, after taking out what bars the way.

    Parameters
    ----------
    floors
        Rectangles of free space: rooms, corridors and doorways [cells].
    pieces
        The furniture that stands on them.
    size
        Columns and rows of the raster, whose lower-left corner is the world's origin.
    rng
        Draws the start pose.
    """
    floor = raster(floors, size)
    kept = list(pieces)
    stamps = [_stamp(piece, size) for piece in kept]
    while True:
        free = floor.copy()
        for (x0, y0, x1, y1), stamp in stamps:
            free[y0:y1, x0:x1] &= ~stamp
        clearance = clearance_of(free, CELL_M)
        reach, pocket = unreached(free, clearance)
        if pocket is None and clearance[reach].max() >= _START_CLEARANCES_M[-1]:
            break
        if not kept:
            raise FloorPlanError(f"{name}: the empty rooms cannot be driven through; make the doors wider")
        worst = len(kept) - 1 if pocket is None else _nearest_piece(kept, pocket)
        del kept[worst], stamps[worst]
    return FloorPlan(
        name=name,
        walls=np.round(surfaces(floors) * CELL_M, 6),
        polygons=tuple(np.round(piece.polygon(), 6) for piece in kept if not piece.radius),
        circles=np.array([(*p.centre_m, p.radius * CELL_M) for p in kept if p.radius]).reshape(-1, 3),
        free=free,
        resolution=CELL_M,
        start=choose_start(clearance, reach, rng),
        start_clearance_m=START_M,
    )


def unreached(free: Flags, clearance: Floats) -> tuple[Flags, Flags | None]:
    """Return the largest area that the disc's centre can move in, and the largest patch it leaves unswept.

    The patch is None if all is well: free space is in one piece, and no patch of it that the disc cannot sweep
    is larger than 0.25 m².
    """
    reach = largest_part(clearance >= DRIVE_RADIUS_M)
    if reach is None:
        return np.zeros_like(free), free
    missed = free & (distance_to_zero(~reach) * CELL_M > DRIVE_RADIUS_M + 0.5 * CELL_M)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(missed.astype(np.uint8), connectivity=4)
    if count > 1:
        worst = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        if stats[worst, cv2.CC_STAT_AREA] * CELL_M**2 > _MAX_POCKET_M2:
            return reach, labels == worst
    count, labels, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=4)
    if count > 2:
        return reach, labels == 1 + int(np.argmin(stats[1:, cv2.CC_STAT_AREA]))
    return reach, None


def choose_start(clearance: Floats, reach: Flags, rng: np.random.Generator) -> tuple[float, float, float]:
    """Return a random pose x, y [m], θ [rad] at a cell's centre with much clearance, along one of the axes."""
    for needed in _START_CLEARANCES_M:
        rooms = np.flatnonzero(reach & (clearance >= needed))
        if rooms.size:
            break
    else:
        best = np.where(reach, clearance, -1.0)
        rooms = np.flatnonzero(best == best.max())
    row, col = divmod(int(rooms[int(rng.integers(rooms.size))]), reach.shape[1])
    theta = _HEADINGS[int(rng.integers(4))]
    return round((col + 0.5) * CELL_M, 6), round((row + 0.5) * CELL_M, 6), theta


def _stamp(piece: Piece, size: tuple[int, int]) -> tuple[Box, Flags]:
    """Cells under a piece: those whose centre is within it."""
    x0, y0, x1, y1 = piece.box
    if not piece.radius and not piece.angle:
        return piece.box, np.ones((y1 - y0, x1 - x0), np.bool_)
    x = np.arange(x0, x1) + 0.5 - 0.5 * (x0 + x1)
    y = (np.arange(y0, y1) + 0.5 - 0.5 * (y0 + y1))[:, None]
    if piece.radius:
        return piece.box, x * x + y * y <= piece.radius**2
    c, s = math.cos(piece.angle), math.sin(piece.angle)
    along, across = np.abs(x * c + y * s), np.abs(y * c - x * s)
    return piece.box, (along <= 0.5 * piece.size[0]) & (across <= 0.5 * piece.size[1])


def _nearest_piece(pieces: Sequence[Piece], pocket: Flags) -> int:
    """Index of the piece nearest to the middle of a pocket."""
    rows, cols = np.nonzero(pocket)
    x, y = float(cols.mean()), float(rows.mean())
    boxes = np.array([piece.box for piece in pieces], np.float64)
    dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
    dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
    return int(np.argmin(np.hypot(dx, dy)))
