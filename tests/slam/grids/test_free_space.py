"""Cells inside a scan's polygon: against the definition in exact arithmetic, and against OpenCV."""

from __future__ import annotations

import math
from fractions import Fraction

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slam.grids.free_space import SUBCELL_BITS, crossings_of, fill_inside

SIZE = 96
Mask = NDArray[np.uint8]
Polygon = NDArray[np.int32]


def filled(polygon: Polygon) -> Mask:
    mask = np.zeros((SIZE, SIZE), np.uint8)
    fill_inside(mask, polygon, len(polygon), crossings_of(SIZE, len(polygon)), 0, SIZE - 1)
    return mask


def star(rng: np.random.Generator, vertices: int) -> Polygon:
    """Return what the ends of beams all round span, some of which go back to the sensor."""
    angles = np.sort(rng.uniform(-math.pi, math.pi, vertices))
    ranges = rng.uniform(3.0, SIZE / 2 - 3, vertices) * (rng.random(vertices) > 0.1)
    points = SIZE / 2 + ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.round(points * (1 << SUBCELL_BITS)).astype(np.int32)


def tangle(rng: np.random.Generator, vertices: int) -> Polygon:
    return rng.integers(3 << SUBCELL_BITS, (SIZE - 3) << SUBCELL_BITS, (vertices, 2)).astype(np.int32)


def halves(rng: np.random.Generator, vertices: int) -> Polygon:
    """Vertices half way between two cells, where a rim is rounded farthest from its edge."""
    return (tangle(rng, vertices) >> SUBCELL_BITS << SUBCELL_BITS) + np.array([1 << SUBCELL_BITS - 1, 0], np.int32)


def line(ax: int, ay: int, bx: int, by: int) -> list[tuple[int, int]]:
    """Return the cells (row, column) of Bresenham's line from left to right, half way up to the farther row."""
    if ax > bx:
        ax, ay, bx, by = bx, by, ax, ay
    dx, dy, down = bx - ax, abs(by - ay), -1 if by < ay else 1
    if dy <= dx:
        return [(ay + down * ((2 * k * dy + dx - 1) // (2 * dx) if dx else 0), ax + k) for k in range(dx + 1)]
    return [(ay + down * k, ax + (2 * k * dx + dy - 1) // (2 * dy)) for k in range(dy + 1)]


def defined(polygon: Polygon) -> Mask:
    """Cells between exact crossings of each row's middle, less those on the lines between the vertices' cells."""
    one, half = 1 << SUBCELL_BITS, 1 << SUBCELL_BITS - 1
    mask = np.zeros((SIZE, SIZE), np.uint8)
    edges = [(polygon[k - 1].tolist(), polygon[k].tolist()) for k in range(len(polygon))]
    for row in range(SIZE):
        crossed = []
        for (ax, ay), (bx, by) in edges:
            a, b = (ay + half) // one, (by + half) // one
            if min(a, b) <= row < max(a, b):
                crossed.append(Fraction(ax, one) + Fraction(bx - ax, one) * Fraction(row - a, b - a))
        crossed.sort()
        for first, last in zip(crossed[::2], crossed[1::2], strict=True):
            mask[row, math.ceil(first) : math.floor(last) + 1] = 1
    for (ax, ay), (bx, by) in edges:
        for cell in line((ax + half) // one, (ay + half) // one, (bx + half) // one, (by + half) // one):
            mask[cell] = 0
    return mask


@pytest.mark.parametrize("shape", [star, tangle, halves])
@pytest.mark.parametrize("vertices", [3, 4, 9, 40])
def test_inside_is_between_exact_crossings_and_off_the_rim(shape, vertices: int) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(vertices)
    for _ in range(8):
        polygon = shape(rng, vertices)
        np.testing.assert_array_equal(filled(polygon), defined(polygon))


@pytest.mark.skipif(int(cv2.__version__.split(".")[0]) < 5, reason="OpenCV 4 draws another rim")
@pytest.mark.parametrize("shape", [star, tangle, halves])
def test_inside_is_what_opencv_fills_less_the_rim_that_it_draws(shape) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(1)
    for _ in range(2000):
        polygon = shape(rng, int(rng.integers(3, 40)))
        want = np.zeros((SIZE, SIZE), np.uint8)
        cv2.fillPoly(want, [polygon], 1, cv2.LINE_8, SUBCELL_BITS)
        cv2.polylines(want, [polygon], True, 0, 1, cv2.LINE_8, SUBCELL_BITS)
        np.testing.assert_array_equal(filled(polygon), want)
