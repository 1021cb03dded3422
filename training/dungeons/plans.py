"""Plans like the dungeons protocol's maps, as many as are wanted: what the learned tour is taught on.

The published maps are made of 20 × 20 tiles of 5 m: rooms of two to four tiles a side, a wall of one tile between
them with a door of one tile in it, and exactly one loop. So these are grown: from a first room on, rooms are put
behind doors in the walls of those that stand, while there is space; then one more door closes a loop. Over 100
plans each, tiles that are free (published maps 42.6 %, these 42 %), doors (17.8, 18) and tiles of wall that part
two rooms (34, 32) come out alike. No published map is read.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from training.dungeons.world import Dungeon

__all__ = ["dungeon_plan", "loops"]

Tiles = NDArray[np.bool_]
Room = tuple[int, int, int, int]
"""First row and column, rows, columns [tiles]."""

_SIDE = 20  # tiles
_PIXELS = 25  # of 0.2 m, a tile
_ROOM = 2, 5  # tiles a side: from, below
_FREE = 0.36, 0.5  # share of the tiles
_STREAM = 77


def dungeon_plan(seed: int) -> Dungeon:
    """Return the plan of a seed: 250 × 250 cells of 0.4 m, one of eight ways round."""
    rng = np.random.default_rng([_STREAM, seed])
    tiles: Tiles | None = None
    while tiles is None or not _FREE[0] < tiles.mean() < _FREE[1]:
        most = int(rng.integers(15, 21))
        stay = float(rng.choice([0.0, 0.0, 0.5]))
        tiles, first = _grown(rng, most, stay, tries=int(rng.integers(500, 1500)))
    row, col, rows, cols = first
    start = np.zeros((_SIDE, _SIDE), dtype=np.bool_)
    start[rng.integers(row, row + rows), rng.integers(col, col + cols)] = True
    turns = int(rng.integers(4))
    tiles, start = np.rot90(tiles, turns), np.rot90(start, turns)
    if rng.random() < 0.5:
        tiles, start = tiles[:, ::-1], start[:, ::-1]
    # As in the benchmark, the eleventh cell of the start's tile.
    at = np.argwhere(_pooled(start))[10]
    return Dungeon(f"plan {seed}", _pooled(tiles), (int(at[0]), int(at[1])))


def loops(tiles: Tiles) -> int:
    """Return how many pieces of wall stand apart from the outer one."""
    return int(cv2.connectedComponents((~tiles).astype(np.uint8), connectivity=8)[0]) - 2


def _grown(rng: np.random.Generator, most: int, stay: float, *, tries: int) -> tuple[Tiles | None, Room]:
    """Return tiles with up to ``most`` rooms and one loop, ``None`` where none can be made, and the first room.

    ``stay`` is how often the next room is put to the last one in place of any.
    """
    free = np.zeros((_SIDE, _SIDE), dtype=np.bool_)
    rows, cols = (int(n) for n in rng.integers(3, 5, 2))
    # Where the benchmark's maps begin, up to turning them.
    row, col = max(int(rng.integers(13 - rows, 13)), 1), max(int(rng.integers(7 - cols, 7)), 1)
    free[row : row + rows, col : col + cols] = True
    rooms: list[Room] = [(row, col, rows, cols)]
    for _ in range(tries):
        if len(rooms) >= most:
            break
        beside = rooms[-1] if rng.random() < stay else rooms[int(rng.integers(len(rooms)))]
        door, room = _next_room(rng, beside)
        row, col, rows, cols = room
        if row < 1 or col < 1 or row + rows > _SIDE - 1 or col + cols > _SIDE - 1:
            continue
        if free[row - 1 : row + rows + 1, col - 1 : col + cols + 1].any():
            continue
        free[row : row + rows, col : col + cols] = True
        free[door] = True
        rooms.append(room)
    return _with_a_loop(rng, free), rooms[0]


def _next_room(rng: np.random.Generator, beside: Room) -> tuple[tuple[int, int], Room]:
    """Return a door in a wall of a room, and a room behind it."""
    row, col, rows, cols = beside
    height, width = (int(n) for n in rng.integers(*_ROOM, 2))
    side = int(rng.integers(4))
    if side < 2:
        door = (row - 1 if side == 0 else row + rows), col + int(rng.integers(cols))
        return door, (
            door[0] - height if side == 0 else door[0] + 1,
            door[1] - int(rng.integers(width)),
            height,
            width,
        )
    at = row + int(rng.integers(rows))
    door = at, (col - 1 if side == 2 else col + cols)
    return door, (at - int(rng.integers(height)), door[1] - width if side == 2 else door[1] + 1, height, width)


def _with_a_loop(rng: np.random.Generator, free: Tiles) -> Tiles | None:
    """Return the tiles with one door more, so that there is exactly one loop; ``None`` where no door makes one."""
    doors = []
    for row in range(1, _SIDE - 1):
        for col in range(1, _SIDE - 1):
            along = free[row - 1, col] and free[row + 1, col]
            across = free[row, col - 1] and free[row, col + 1]
            beside = free[row, col - 1] or free[row, col + 1], free[row - 1, col] or free[row + 1, col]
            if not free[row, col] and ((along and not beside[0]) or (across and not beside[1])):
                doors.append((row, col))
    rng.shuffle(doors)
    for door in doors:
        with_door = free.copy()
        with_door[door] = True
        if loops(with_door) == 1:
            return with_door
    return None


def _pooled(tiles: Tiles) -> Tiles:
    """Return the cells of 0.4 m whose four pixels of 0.2 m are all set."""
    pixels = np.kron(tiles, np.ones((_PIXELS, _PIXELS), dtype=np.bool_))
    half = len(pixels) // 2
    return np.ascontiguousarray(pixels.reshape(half, 2, half, 2).all(axis=(1, 3)))
