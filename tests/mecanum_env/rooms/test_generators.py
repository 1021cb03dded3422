"""What every generated plan keeps to, over seeds; and what each kind of room promises besides."""

from __future__ import annotations

import hashlib
import itertools
import math
import multiprocessing

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mecanum_env import rooms
from mecanum_env.rooms import registry
from mecanum_env.rooms.layout.apartment_layout import ApartmentConfig, draw_layout
from mecanum_env.rooms.layout.assembly import generator
from mecanum_env.rooms.outlines.distance import distance_to_zero
from mecanum_env.rooms.rectangular import RectangularConfig

seeds = st.integers(0, 2**32 - 1)
every_kind = pytest.mark.parametrize("kind", rooms.names())
furnished = pytest.mark.parametrize("kind", ["rectangular", "apartment"])
few = settings(max_examples=25, deadline=None)


def digest(kind, seed):
    plan = rooms.make(kind, seed=seed)
    parts = [plan.walls, *plan.polygons, plan.circles, plan.free, np.array(plan.start)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(p).tobytes() for p in parts)).hexdigest()


def disc_reach(plan, radius):
    """Where a disc's centre gets to from the start, and what the disc then sweeps, by scipy."""
    padded = np.pad(plan.free, 1)
    clear = ndimage.distance_transform_edt(padded)[1:-1, 1:-1] - 0.5
    labels, _ = ndimage.label(clear * plan.resolution >= radius)
    col, row = (int(v / plan.resolution) for v in plan.start[:2])
    assert labels[row, col], "the disc does not fit at the start"
    reach = labels == labels[row, col]
    return reach, ndimage.distance_transform_edt(~reach) * plan.resolution <= radius + 0.5 * plan.resolution


def cast(plan, origin, angle):
    """Distance to the first surface along a ray, by solving for each: inf where it hits none."""
    d = np.array([math.cos(angle), math.sin(angle)])
    a, e = plan.segments[:, :2] - origin, plan.segments[:, 2:] - plan.segments[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        det = d[0] * e[:, 1] - d[1] * e[:, 0]
        t = (a[:, 0] * e[:, 1] - a[:, 1] * e[:, 0]) / det
        s = (a[:, 0] * d[1] - a[:, 1] * d[0]) / det
    hits = t[(np.abs(det) > 1e-12) & (t >= 0) & (s >= -1e-9) & (s <= 1 + 1e-9)]
    best = hits.min(initial=np.inf)
    for x, y, r in plan.circles:
        c = np.array([x, y]) - origin
        along, off = c @ d, abs(c[0] * d[1] - c[1] * d[0])
        if off <= r and along > 0:
            best = min(best, along - math.sqrt(r * r - off * off))
    return best


def outlines(plan):
    """Every obstacle as a convex polygon; a round one as one of 32 corners."""
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return [*plan.polygons, *(np.array([x, y]) + r * ring for x, y, r in plan.circles)]


def separation(a, b):
    """The widest gap between two convex polygons along their edges' normals; negative if they overlap."""
    gaps = []
    for polygon in (a, b):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.hypot(*edges.T)[:, None]
        pa, pb = a @ normals.T, b @ normals.T
        gaps += [pb.min(axis=0) - pa.max(axis=0), pa.min(axis=0) - pb.max(axis=0)]
    return max(g.max() for g in gaps)


@every_kind
@few
@given(seed=seeds)
def test_a_disc_of_40_cm_gets_everywhere(kind, seed):
    plan = rooms.make(kind, seed=seed)
    assert ndimage.label(plan.free)[1] == 1, "the free area is not connected"
    _, swept = disc_reach(plan, 0.40)
    missed, count = ndimage.label(plan.free & ~swept)
    areas = ndimage.sum_labels(np.ones(missed.shape), missed, np.arange(1, count + 1)) * plan.resolution**2
    assert max(areas, default=0.0) <= 0.25


@every_kind
@few
@given(seed=seeds)
def test_obstacles_overlap_neither_each_other_nor_walls(kind, seed):
    plan = rooms.make(kind, seed=seed)
    shapes = outlines(plan)
    gaps = {(i, j): separation(shapes[i], shapes[j]) for i, j in itertools.combinations(range(len(shapes)), 2)}
    assert min(gaps.values(), default=0.0) > -1e-6
    if kind == "rectangular":
        # What does not touch, itself or through others (chairs at a table), is 0.95 m apart: along the normals of
        # two boxes that stand diagonally, at least 0.95 m / √2.
        group = list(range(len(shapes)))
        for (i, j), gap in gaps.items():
            if gap < 1e-6:
                group = [group[i] if g == group[j] else g for g in group]
        assert all(gap > 0.67 for (i, j), gap in gaps.items() if group[i] != group[j])
    for polygon in plan.polygons:
        x, y = polygon.T
        assert np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0, "not counter-clockwise"
    # Floor, by the shoelace formula over its directed walls, is free cells and obstacles and nothing twice.
    x1, y1, x2, y2 = plan.walls.T
    floor = 0.5 * np.sum(x1 * y2 - x2 * y1)
    areas = [
        0.5 * abs(np.sum(p[:, 0] * np.roll(p[:, 1], -1) - p[:, 1] * np.roll(p[:, 0], -1))) for p in plan.polygons
    ]
    areas += list(math.pi * plan.circles[:, 2] ** 2)
    # A curved wall cuts its cells anywhere: what that makes of a cave's 100 m of them is some 0.05 m².
    slack = 0.25 if kind == "cave" else 0.0
    assert plan.area_m2 + sum(areas) == pytest.approx(floor, abs=slack + 0.02 * (1 + len(areas)))


@every_kind
@few
@given(seed=seeds)
def test_rays_end_where_the_raster_says(kind, seed):
    """Walls are closed, and the surfaces are those of the raster: what lidar sees is what coverage counts."""
    plan = rooms.make(kind, seed=seed)
    rng = np.random.default_rng(seed)
    cells = np.argwhere(plan.clearance() > 0.1)
    for row, col in cells[rng.integers(len(cells), size=6)]:
        origin = (np.array([col, row]) + 0.5) * plan.resolution
        for angle in rng.uniform(-np.pi, np.pi, 4):
            distance = cast(plan, origin, angle)
            assert distance < 30.0
            steps = np.arange(0.0, distance, 0.01)
            ray = origin + steps[:, None] * np.array([math.cos(angle), math.sin(angle)])
            # Round and turned pieces are rastered by cell centres, so a grazing ray may run along inside a cell.
            inside = ~plan.is_free(ray)
            assert np.all(plan.distance_to_surfaces(ray[inside]) < 0.75 * plan.resolution)
            behind = origin + (distance + 0.04) * np.array([[math.cos(angle), math.sin(angle)]])
            assert not plan.is_free(behind)[0] or plan.distance_to_surfaces(behind)[0] < 0.041


@every_kind
@few
@given(seed=seeds)
def test_the_start_is_clear_and_square(kind, seed):
    plan = rooms.make(kind, seed=seed)
    assert plan.distance_to_surfaces(np.array([plan.start[:2]]))[0] >= 0.5
    assert min(abs(plan.start[2] - h) for h in (-math.pi, -math.pi / 2, 0.0, math.pi / 2)) < 1e-12
    if kind == "cave":
        return
    # Every surface of the others lies on the 5 cm lattice.
    assert plan.walls * 20 == pytest.approx(np.round(plan.walls * 20), abs=1e-6)


@every_kind
def test_the_same_seed_gives_the_same_plan_in_another_process(kind):
    here = [digest(kind, seed) for seed in range(4)]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.starmap(digest, [(kind, seed) for seed in range(4)])
    assert here == there
    assert len(set(here)) == 4


@every_kind
def test_a_plan_does_not_depend_on_opencvs_threads(kind):
    """Trials and benchmarks run with one thread, a script with as many as there are cores."""
    before = cv2.getNumThreads()
    try:
        digests = []
        for threads in (1, 2, 8):
            cv2.setNumThreads(threads)
            digests.append([digest(kind, seed) for seed in range(12)])
    finally:
        cv2.setNumThreads(before)
    assert digests[0] == digests[1] == digests[2]


@settings(max_examples=60, deadline=None)
@given(
    seed=seeds, rows=st.integers(1, 80), cols=st.integers(1, 80), share=st.sampled_from([0.001, 0.02, 0.5, 0.95])
)
def test_distances_are_exact_wherever_the_mask_lies_in_memory(seed, rows, cols, share):
    rng = np.random.default_rng(seed)
    mask = rng.random((rows, cols)) >= share
    mask[rng.integers(rows), rng.integers(cols)] = False
    expected = ndimage.distance_transform_edt(mask).astype(np.float32)
    for shift in range(4):
        moved = np.zeros(mask.size + shift, np.uint8)[shift:].reshape(mask.shape)
        moved[:] = mask
        np.testing.assert_array_equal(distance_to_zero(moved), expected)


def test_distances_are_exact_up_to_800_cells():
    mask = np.ones((561, 571), np.bool_)
    mask[0, 0] = False
    expected = ndimage.distance_transform_edt(mask).astype(np.float32)
    assert expected.max() > 799.0
    np.testing.assert_array_equal(distance_to_zero(mask), expected)


@every_kind
def test_most_starts_have_60_cm(kind):
    distances = [
        p.distance_to_surfaces(np.array([p.start[:2]]))[0] for p in (rooms.make(kind, seed=s) for s in range(40))
    ]
    assert np.mean(np.array(distances) >= 0.6) > 0.9


@few
@given(seed=seeds)
def test_a_flat_has_rooms_doors_and_loops(seed):
    config = ApartmentConfig()
    layout, _ = draw_layout(config, generator(seed))
    assert 5 <= len(layout.rooms) <= 8
    assert 70 <= layout.area * 0.05**2 <= 130
    for a, b in itertools.combinations(layout.rooms, 2):
        gap = max(a[0] - b[2], b[0] - a[2], a[1] - b[3], b[1] - a[3])
        assert gap >= 2, "a wall is thinner than 10 cm"
    corridor = layout.corridors[0]
    assert 24 <= min(corridor[2] - corridor[0], corridor[3] - corridor[1]) <= 36
    joined = {-1}
    for door in layout.doors:
        x0, y0, x1, y1 = door.box
        thickness, width = sorted((x1 - x0, y1 - y0))
        assert 2 <= thickness <= 4
        assert 18 <= width <= 24
        for room in door.rooms:
            bx0, by0, bx1, by1 = corridor if room < 0 else layout.rooms[room]
            touching_x = (x0 == bx1 or x1 == bx0) and by0 <= y0 and y1 <= by1
            touching_y = (y0 == by1 or y1 == by0) and bx0 <= x0 and x1 <= bx1
            assert touching_x or touching_y
        joined |= {r for r in door.rooms if -1 in door.rooms}
    assert joined == set(range(-1, len(layout.rooms))), "a room has no door to the corridor"
    assert any(-1 not in door.rooms for door in layout.doors), "no loop"


def test_a_flat_keeps_the_floor_before_its_doors_free():
    for seed in range(20):
        layout, _ = draw_layout(ApartmentConfig(), generator(seed))
        plan = rooms.make("apartment", seed=seed)
        for door in layout.doors:
            x0, y0, x1, y1 = door.box
            upright = (x1 - x0) < (y1 - y0)
            dx, dy = (20, 0) if upright else (0, 20)
            assert plan.free[y0 - dy : y1 + dy, x0 - dx : x1 + dx].all()


@few
@given(seed=seeds)
def test_a_rectangular_room_has_its_size(seed):
    plan = rooms.make("rectangular", seed=seed)
    assert len(plan.walls) == 4
    x0, y0, x1, y1 = plan.bounds
    assert 5.0 <= round(x1 - x0, 6) <= 10.0
    assert 4.0 <= round(y1 - y0, 6) <= 8.0


def test_rooms_are_furnished_in_all_shapes():
    flats = [rooms.make("apartment", seed=s) for s in range(20)]
    plain = [rooms.make("rectangular", seed=s) for s in range(20)]
    assert min(len(p.polygons) + len(p.circles) for p in flats) >= 8
    assert min(len(p.polygons) + len(p.circles) for p in plain) >= 2
    for plans in (flats, plain):
        edges = np.vstack([p.segments[len(p.walls) :, 2:] - p.segments[len(p.walls) :, :2] for p in plans])
        turned = np.abs(edges).min(axis=1) > 1e-6
        assert turned.any() and not turned.all()
        assert any(len(p.circles) for p in plans)
    for kind in ("apartment", "rectangular"):  # corridors are empty
        empty = rooms.make(kind, seed=1, config={"furniture": 0.0})
        assert not empty.polygons and not len(empty.circles)


@furnished
@few
@given(seed=seeds)
def test_even_the_fullest_rooms_can_be_driven(kind, seed):
    plan = rooms.make(kind, seed=seed, config={"furniture": 1.0})
    _, swept = disc_reach(plan, 0.40)
    missed, _ = ndimage.label(plan.free & ~swept)
    assert np.bincount(missed.ravel())[1:].max(initial=0) * plan.resolution**2 <= 0.25


def test_a_cell_that_is_run_again_registers_again(monkeypatch):
    monkeypatch.setattr(registry, "_GENERATORS", dict(registry._GENERATORS))
    for k in range(2):

        class MineConfig(RectangularConfig): ...

        def mine(config, /, *, seed, run=k):
            return rooms.make("rectangular", seed=run)

        rooms.register("mine", mine, MineConfig)
    assert np.array_equal(rooms.make("mine", seed=7).walls, rooms.make("rectangular", seed=1).walls)


def test_the_registry_names_what_there_is():
    assert {"apartment", "cave", "corridors", "maze", "rectangular"} <= set(rooms.names())
    with pytest.raises(ValueError, match=r"unknown rooms 'apartement' .did you mean 'apartment'.*rectangular"):
        rooms.make("apartement", seed=0)
    with pytest.raises(ValueError, match="unknown key of ApartmentConfig 'dors_m'"):
        rooms.make("apartment", seed=0, config={"dors_m": (1, 2)})
    with pytest.raises(ValueError, match="registered already"):
        rooms.register("apartment", lambda config, *, seed: None, RectangularConfig)
    with pytest.raises(ValueError, match="registered already"):
        rooms.register("rectangular", registry._GENERATORS["rectangular"][0], ApartmentConfig)
    wide = rooms.make("rectangular", seed=5, config=RectangularConfig(length_m=(9.0, 9.0)))
    assert round(wide.bounds[2] - wide.bounds[0], 6) == 9.0


@pytest.mark.parametrize("seed", [-1, 1.5, "1", True, None])
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(ValueError, match="seed must be an integer"):
        rooms.make("rectangular", seed=seed)


@pytest.mark.parametrize(
    ("kind", "config"),
    [
        ("rectangular", {"length_m": (5.0, 4.0)}),
        ("rectangular", {"length_m": (5.0,)}),
        ("rectangular", {"width_m": (math.nan, 6.0)}),
        ("rectangular", {"width_m": 4.0}),
        ("rectangular", {"furniture": 1.5}),
        ("rectangular", {"turned": 0.7, "round": 0.7}),
        ("apartment", {"door_m": (0.7, 0.8)}),
        ("apartment", {"area_m2": (10.0, 20.0)}),
        ("apartment", {"rooms": (5.5, 8.0)}),
        ("apartment", {"links": -0.1}),
        ("apartment", {"corridor_m": (math.inf, math.inf)}),
        ("cave", {"area_m2": (100.0, 60.0)}),
        ("cave", {"chamber_m": (0.5, 1.0)}),
        ("cave", {"passage_m": (0.9, 1.2)}),
        ("cave", {"pillars": (0.5, 2)}),
        ("cave", {"roughness": 1.5}),
        ("cave", {"loops": math.nan}),
        ("maze", {"columns": (1, 4)}),
        ("maze", {"rows": (6.0, 8.0)}),
        ("maze", {"corridor_m": (0.8, 1.0)}),
        ("maze", {"wall_m": (0.0, 0.1)}),
        ("maze", {"loops": -0.1}),
    ],
)
def test_a_bad_config_is_refused(kind, config):
    with pytest.raises(ValueError) as caught:
        rooms.make(kind, seed=0, config=config)
    assert "\n" not in str(caught.value)
