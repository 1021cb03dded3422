"""Walls true to the raster that they are traced from."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from mecanum_env.rooms.outlines.outline import outline_segments, trace
from mecanum_env.rooms.outlines.rectilinear import surfaces


def dense(segments, step=0.1):
    """Points along segments, end points included."""
    a, d = segments[:, :2], segments[:, 2:] - segments[:, :2]
    counts = np.ceil(np.hypot(*d.T) / step).astype(int) + 1
    which = np.repeat(np.arange(len(segments)), counts)
    k = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return a[which] + (k / np.maximum(counts - 1, 1)[which])[:, None] * d[which]


def distance(points, segments):
    """Distance of each point to the nearest segment, in batches."""
    a, d = segments[:, :2], segments[:, 2:] - segments[:, :2]
    squared = (d**2).sum(axis=1)
    out = []
    for part in np.array_split(points, max(1, len(points) * len(segments) // 2_000_000)):
        o = part[:, None] - a
        share = np.clip((o * d).sum(axis=2) / squared, 0, 1)
        out.append(np.hypot(*np.moveaxis(o - share[..., None] * d, 2, 0)).min(axis=1))
    return np.concatenate(out)


def near(points, segments):
    """The largest distance of points to segments, by points 0.05 apart along them: at 0.5 it errs by 6e-4."""
    return cKDTree(dense(segments, 0.05)).query(points)[0].max()


def cell_edges(free):
    """The edges between free and other cells, one by one, without the code under test."""
    padded = np.pad(free, 1)
    rows, cols = np.nonzero(padded[1:] != padded[:-1])
    level = np.stack([cols, rows + 1, cols + 1, rows + 1], axis=1)
    rows, cols = np.nonzero(padded[:, 1:] != padded[:, :-1])
    upright = np.stack([cols + 1, rows, cols + 1, rows + 1], axis=1)
    return np.vstack([level, upright]).astype(float) - 1.0


def hausdorff(free, walls_in_cells):
    """The largest distance from a surface to a cell edge, and from a cell edge to a surface [cells]."""
    edges = cell_edges(free)
    return distance(dense(walls_in_cells), edges).max(), distance(dense(edges, 0.5), walls_in_cells).max()


rasters = arrays(np.bool_, st.tuples(st.integers(1, 14), st.integers(1, 14))).filter(np.any)


@given(rasters)
def test_walls_are_within_half_a_cell_of_the_edges_both_ways(free):
    there, back = hausdorff(free, outline_segments(free))
    assert there <= 0.5 + 1e-6
    assert back <= 0.5 + 1e-6


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.floats(0.8, 3.0), st.floats(0.35, 0.65))
def test_smooth_shapes_stay_within_half_a_cell_too(seed, blur, level):
    """Blobs have the slants and arcs that noise lacks."""
    noise = np.random.default_rng(seed).random((24, 30)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur)
    free = smooth > np.quantile(smooth, level)
    there, back = hausdorff(free, outline_segments(free))
    assert max(there, back) <= 0.5 + 1e-6


@given(rasters)
def test_walls_are_closed_and_have_length(free):
    walls = outline_segments(free)
    assert np.all(np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > 0)
    # As many walls leave each point as come to it.
    starts, ends = (sorted(map(tuple, np.round(part, 9))) for part in (walls[:, :2], walls[:, 2:]))
    assert starts == ends


@given(rasters)
def test_the_exact_outline_is_every_edge_once_with_free_space_on_the_left(free):
    walls = outline_segments(free, simplify=False)
    corners, first = trace(free)
    assert len(walls) == len(corners) == first[-1]
    edges = []
    padded = np.pad(free, 2)
    for x1, y1, x2, y2 in walls.astype(int):
        d = np.array([np.sign(x2 - x1), np.sign(y2 - y1)])
        for k in range(abs(x2 - x1) + abs(y2 - y1)):
            a = np.array([x1, y1]) + k * d
            left = np.floor(a + 0.5 * d + 0.5 * np.array([-d[1], d[0]])).astype(int) + 2
            right = np.floor(a + 0.5 * d - 0.5 * np.array([-d[1], d[0]])).astype(int) + 2
            assert padded[left[1], left[0]] and not padded[right[1], right[0]]
            edges.append((*np.minimum(a, a + d), *np.maximum(a, a + d)))
    assert sorted(edges) == sorted(map(tuple, cell_edges(free).astype(int)))


def test_rectangles_come_out_exact():
    free = np.zeros((30, 40), bool)
    free[3:12, 5:30] = True
    free[8:25, 20:28] = True
    expected = surfaces(np.array([(5, 3, 30, 12), (20, 8, 28, 25)], float))
    assert sorted(map(tuple, outline_segments(free))) == sorted(map(tuple, expected))


def test_slants_become_straight():
    row, col = np.mgrid[0:60, 0:60]
    for free, most in [(row > col, 6), (2 * row > col + 20, 6)]:
        assert len(outline_segments(free)) <= most
        assert len(outline_segments(free, simplify=False)) > 40
    disc = (row - 30) ** 2 + (col - 30) ** 2 < 25**2
    assert len(outline_segments(disc)) < 0.4 * len(outline_segments(disc, simplify=False))


@pytest.mark.parametrize("slanting", [False, True])
def test_a_wall_one_pixel_thick_survives_with_two_surfaces_and_shuts(slanting):
    free = np.ones((40, 40), bool)
    free[np.arange(40), np.arange(40) if slanting else 20] = False
    walls = outline_segments(free)
    across = np.array([[5.0, 35.0, 35.0, 5.0]]) if slanting else np.array([[5.0, 10.2, 35.0, 10.2]])
    (x1, y1, x2, y2), hits = across[0], 0
    for a, b, c, d in walls:
        s = (x2 - x1) * (d - b) - (y2 - y1) * (c - a)
        if s:
            t, u = (
                ((a - x1) * (d - b) - (b - y1) * (c - a)) / s,
                ((a - x1) * (y2 - y1) - (b - y1) * (x2 - x1)) / s,
            )
            hits += 0 <= t <= 1 and 0 <= u < 1
    assert hits == 2
    assert len(walls) <= 12
