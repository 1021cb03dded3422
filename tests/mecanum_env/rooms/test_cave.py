"""Caves: smooth walls without corners, chambers joined by passages, and of the size that was asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mecanum_env import rooms
from mecanum_env.rooms.cave import CaveConfig
from mecanum_env.rooms.outlines.smooth_outline import MOST_TURN_DEG, bends_deg, facets, level_loops, rasterise

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=15, deadline=None)


def wall_loops(plan) -> list[np.ndarray]:
    """The closed loops of a cave's walls, as vertices (k, 2)."""
    ends = np.flatnonzero(np.any(plan.walls[:, 2:] != np.roll(plan.walls[:, :2], -1, axis=0), axis=1)) + 1
    loops = np.split(plan.walls, ends) if len(ends) else [plan.walls]
    loops = [loop for loop in loops if len(loop)]
    for loop in loops:
        assert np.array_equal(loop[-1, 2:], loop[0, :2]), "walls that do not close"
    return [loop[:, :2] for loop in loops]


def crossings(walls: np.ndarray) -> int:
    """How many pairs of segments cross."""

    def side(a, b, c):
        return (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1]) - (b[..., 1] - a[..., 1]) * (
            c[..., 0] - a[..., 0]
        )

    a, b, c, d = walls[:, None, :2], walls[:, None, 2:], walls[None, :, :2], walls[None, :, 2:]
    across = (side(a, b, c) * side(a, b, d) < 0) & (side(c, d, a) * side(c, d, b) < 0)
    return int(np.count_nonzero(across & (np.abs(side(a, b, c)) > 1e-9)))


@few
@given(seed=seeds)
def test_a_cave_has_no_corners_where_a_flat_has_many(seed):
    assert len(rooms.make("cave", seed=seed).corners) == 0
    assert len(rooms.make("apartment", seed=seed).corners) > 40


@few
@given(seed=seeds)
def test_the_walls_of_a_cave_are_smooth(seed):
    plan = rooms.make("cave", seed=seed)
    loops = wall_loops(plan)
    assert max(bends_deg(loop).max() for loop in loops) <= 5.0
    assert crossings(plan.walls) == 0
    # Few straight ones: a flat's are metres long; and not so many pieces that ray casting would be slow.
    lengths = np.hypot(*(plan.walls[:, 2:] - plan.walls[:, :2]).T)
    assert lengths.max() < 3.0
    assert np.median(lengths) < 0.3
    assert len(plan.walls) < 2000


@few
@given(seed=seeds)
def test_a_cave_has_its_size_and_pillars_that_can_be_passed(seed):
    plan = rooms.make("cave", seed=seed)
    assert 60.0 <= plan.area_m2 <= 150.0
    assert len(plan.circles) <= 3
    for i, (x, y, radius) in enumerate(plan.circles):
        others = np.delete(plan.circles, i, axis=0)
        rims = np.hypot(others[:, 0] - x, others[:, 1] - y) - others[:, 2] - radius
        assert rims.min(initial=np.inf) > 0.85
        bare = np.hypot(*(plan.walls[:, :2] - (x, y)).T) - radius
        assert bare.min() > 0.85


def test_caves_have_chambers_passages_and_loops():
    widths, islands = [], []
    for seed in range(12):
        plan = rooms.make("cave", seed=seed)
        clearance = plan.clearance()
        widths.append(clearance.max())
        # Chambers: what a disc of 0.95 m fits in; passages: what lies between, or leads to nowhere.
        wide = ndimage.distance_transform_edt(clearance < 0.95) * plan.resolution <= 0.95
        assert np.count_nonzero(plan.free & ~wide) * plan.resolution**2 > 2.0
        islands.append(len(wall_loops(plan)) - 1)
    assert min(widths) > 1.0
    assert np.mean(np.array(islands) > 0) >= 0.5


def test_the_config_of_a_cave_is_kept_to():
    small = rooms.make("cave", seed=1, config={"area_m2": (40.0, 60.0), "pillars": (0, 0)})
    assert 40.0 <= small.area_m2 <= 60.0 and not len(small.circles)

    def mean(count, **config):
        return np.mean([count(rooms.make("cave", seed=seed, config=config)) for seed in range(5)])

    assert mean(lambda plan: len(plan.walls), roughness=0.0) < mean(lambda plan: len(plan.walls), roughness=1.0)
    assert mean(lambda plan: len(wall_loops(plan)), loops=0.0) < mean(
        lambda plan: len(wall_loops(plan)), loops=1.0
    )


def test_an_area_that_can_hardly_be_met_is_refused_at_once():
    for area in ((30.0, 30.0), (100.0, 104.9)):
        with pytest.raises(ValueError, match=r"area_m2 needs most ≥ 1.05 · least, got .*; widen it"):
            CaveConfig(area_m2=area)
    for seed in range(3):
        assert 30.0 <= rooms.make("cave", seed=seed, config={"area_m2": (30.0, 31.5)}).area_m2 <= 31.5


def disc_field(radius_m: float, cell_m: float) -> np.ndarray:
    at = (np.arange(100) + 0.5) * cell_m - 50 * cell_m
    return radius_m - np.hypot(at, at[:, None])


@given(radius=st.floats(0.5, 2.0))
def test_the_outline_of_a_disc_is_round(radius):
    (line,) = level_loops(disc_field(radius, 0.05), 0.05, smooth_m=0.1)
    middle = np.array([2.5, 2.5])
    # A Gaussian along a circle draws it in by the share 1 - exp(-σ² / 2r²).
    drawn_in = radius * (1.0 - math.exp(-0.5 * (0.1 / radius) ** 2))
    assert np.hypot(*(line - middle).T) == pytest.approx(radius - drawn_in, abs=2e-3)
    corners = facets(line)
    assert 360 / MOST_TURN_DEG <= len(corners) <= 110
    assert bends_deg(corners).max() <= MOST_TURN_DEG
    edges = np.hstack([corners, np.roll(corners, -1, axis=0)])
    x, y = corners.T
    inside = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert inside > 0, "free space must be on the left"
    # Nowhere further from the line than 5 mm.
    assert math.sqrt(inside / math.pi) == pytest.approx(radius - drawn_in, abs=5e-3)
    free = rasterise(edges, (100, 100), 0.05)
    gaps = np.hypot(*(np.argwhere(free)[:, ::-1] * 0.05 + 0.025 - middle).T)
    assert gaps.max() <= radius
    assert np.count_nonzero(free) * 0.0025 == pytest.approx(inside, abs=0.12)


def test_a_raster_of_loops_has_holes():
    outer = np.array([(0.1, 0.1), (0.9, 0.1), (0.9, 0.7), (0.1, 0.7)])
    hole = np.array([(0.3, 0.3), (0.3, 0.5), (0.6, 0.5), (0.6, 0.3)])
    walls = np.vstack([np.hstack([p, np.roll(p, -1, axis=0)]) for p in (outer, hole)])
    expected = np.zeros((8, 10), bool)
    expected[1:7, 1:9] = True
    expected[3:5, 3:6] = False
    assert np.array_equal(rasterise(walls, (10, 8), 0.1), expected)
