"""What a look shows, against the rays one by one as the benchmark's public code walks them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from agents.stations.sensor import BLIND, SENSORS, look, rays
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN


def public_ray(free: np.ndarray, row: int, col: int, angle: float, shown: np.ndarray) -> None:
    """One ray: through the first wall cell, up to a second in a row or the first free cell behind."""
    end = row + round(50.0 * math.sin(angle)), col + round(50.0 * math.cos(angle))
    step = [1 if e > b else -1 for e, b in zip(end, (row, col), strict=True)]
    dr, dc = abs(end[0] - row), abs(end[1] - col)
    error, walls = dc - dr, 0
    r, c = row, col
    while 0 <= r < free.shape[0] and 0 <= c < free.shape[1]:
        if not free[r, c]:
            walls += 1
            if walls == 2:
                return
        elif walls:
            return
        if (r, c) == end:
            return
        shown[r, c] = True
        if error > 0:
            c, error = c + step[1], error - 2 * dr
        else:
            r, error = r + step[0], error + 2 * dc


def wide_ray(free: np.ndarray, row: int, col: int, angle: float, shown: np.ndarray) -> None:
    """One ray: the cells nearest to the line, and those around them, up to before the first wall."""
    end = np.floor(50.0 * np.array([math.sin(angle), math.cos(angle)]) + 0.5).astype(int)
    count = int(max(abs(end)))
    for i in range(count):
        r, c = np.floor(np.array([row, col]) + i / count * end + 0.5).astype(int)
        if not (0 <= r < free.shape[0] and 0 <= c < free.shape[1]) or not free[r, c]:
            return
        shown[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2] = True


@pytest.mark.parametrize("sensor", SENSORS)
def test_a_look_is_its_rays_one_by_one(sensor):
    rng = np.random.default_rng(1)
    free = np.zeros((120, 120), bool)
    for _ in range(14):
        row, col, rows, cols = (*rng.integers(2, 80, 2), *rng.integers(6, 36, 2))
        free[row : row + rows, col : col + cols] = True
    free[:3, 40:80] = True  # open to the rim
    free[rng.random(free.shape) < 0.01] = False  # pillars that rays pass
    places = rng.permutation(np.argwhere(free))[:5].tolist()
    for row, col in [*places, [1, 60]]:
        shown = np.zeros(free.shape, bool)
        for k in range(720):
            {"public": public_ray, "wide": wide_ray}[sensor](free, row, col, math.radians(0.5 * k), shown)
        known = np.full(free.shape, UNKNOWN, np.int8)
        box = look(free, row, col, rays(sensor), known)
        np.testing.assert_array_equal(known != UNKNOWN, shown)
        np.testing.assert_array_equal(known[shown] == FREE, free[shown])
        np.testing.assert_array_equal(known[shown] == OCCUPIED, ~free[shown])
        at = np.argwhere(shown)
        assert box.tolist() == [at[:, 0].min(), at[:, 0].max(), at[:, 1].min(), at[:, 1].max()]
        assert look(free, row, col, rays(sensor), known)[1] == -1  # a second look shows nothing


def test_in_the_open_a_look_is_a_disc_without_its_rim():
    free = np.ones((121, 121), bool)
    known = np.full(free.shape, UNKNOWN, np.int8)
    look(free, 60, 60, rays("public"), known)
    away = np.hypot(*(np.argwhere(known == FREE) - 60).T)
    assert away.max() < 50.0 and known[60, 109] == FREE and known[60, 110] == UNKNOWN
    look(free, 20, 20, BLIND, known)
    assert known[20, 20] == UNKNOWN
