"""Floors of stations, and what there is to do on them."""

from __future__ import annotations

import numpy as np

from agents.stations.sensor import SENSORS, rays
from agents.stations.survey import find_pieces, no_pieces, survey
from agents.ways.routing import draw_luck
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN

LUCK = draw_luck(6, 200)
CELL_M = 0.4


def rooms(seed: int, side: int = 130) -> np.ndarray:
    """Random rectangles that are free or unknown, between walls; the middle is free."""
    rng = np.random.default_rng(seed)
    known = np.full((side, side), OCCUPIED, np.int8)
    for value, count in ((FREE, 16), (UNKNOWN, 6)):
        for _ in range(count):
            row, col, rows, cols = (*rng.integers(2, side - 40, 2), *rng.integers(8, 38, 2))
            known[row : row + rows, col : col + cols] = value
    known[side // 2 - 6 : side // 2 + 6, 5 : side - 5] = FREE
    return known


def stop(known: np.ndarray, robot: tuple[int, int]):
    """What there is to do on a station of a grid, nothing having been looked from but that."""
    visited = np.zeros(known.shape, np.bool_)
    visited[robot] = True
    pieces = no_pieces(known.shape)
    find_pieces(known, pieces, np.array([0, known.shape[0] - 1, 0, known.shape[1] - 1]))
    return survey(known, pieces, visited, robot, robot, CELL_M, 30.0, rays(SENSORS[0])), visited
