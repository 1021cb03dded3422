"""Corridors: the lengths that were asked for, measured on the plan itself, and room for the robot everywhere."""

from __future__ import annotations

import hashlib
import math
import multiprocessing

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import ndimage

from mecanum_env import rooms
from mecanum_env.config import ROBOT_PRESETS
from mecanum_env.rooms.layout.assembly import generator
from mecanum_env.rooms.layout.corridor_layout import PAPER_D, Corridor, CorridorsConfig, draw_layout, sizes_of
from slam.types import CONCAVE, CONVEX

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=30, deadline=None)
every_map = pytest.mark.parametrize("config", [{}, *({"map": number} for number in PAPER_D)], ids=str)


def centre_lines(plan, width_m: float) -> np.ndarray:
    """Where a square of the corridors' width fits: lattice points (rows + 1, cols + 1), the centre lines alone."""
    side = round(width_m / plan.resolution)
    total = np.pad(np.cumsum(np.cumsum(plan.free.astype(np.int64), axis=0), axis=1), ((1, 0), (1, 0)))
    inside = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    return inside == side * side


def corridor_lengths(plan, width_m: float) -> np.ndarray:
    """Lengths [m] of the straight runs of the centre lines: by the raster, not by how it was made."""
    lengths = []
    for lines in (centre_lines(plan, width_m), centre_lines(plan, width_m).T):
        for line in np.pad(lines, ((0, 0), (1, 1))).astype(np.int8):
            change = np.diff(line)
            runs = np.flatnonzero(change == -1) - np.flatnonzero(change == 1)
            lengths += [(run - 1) * plan.resolution for run in runs if run > 1]
    return np.array(lengths)


def width_of(config: CorridorsConfig) -> float:
    sizes = sizes_of(config)
    return 2 * sizes.half * sizes.cell_m


@pytest.mark.parametrize("number", PAPER_D)
def test_paper_d_maps_have_their_lengths(number):
    total, longest = PAPER_D[number]
    assert (total, longest) == {1: (19.46, 3.67), 2: (31.11, 1.80), 3: (33.83, 2.61)}[number]
    walls = set()
    for seed in range(20):
        plan = rooms.make("corridors", seed=seed, config={"map": number})
        lengths = corridor_lengths(plan, 0.6)
        assert lengths.sum() == pytest.approx(total, abs=0.01)
        assert lengths.max() == pytest.approx(longest, abs=0.01)
        walls.add(plan.walls.tobytes())
    assert len(walls) == 20


@every_map
@few
@given(seed=seeds)
def test_corridors_are_connected_and_wide_enough_all_along(config, seed):
    plan = rooms.make("corridors", seed=seed, config=config)
    width = width_of(CorridorsConfig(**config))
    robot = ROBOT_PRESETS["cavity" if config else "youbot"]
    assert ndimage.label(plan.free)[1] == 1
    rows, cols = np.nonzero(centre_lines(plan, width))
    assert ndimage.label(centre_lines(plan, width))[1] == 1
    points = np.stack([cols, rows], axis=1) * plan.resolution + 0.5 * width
    distances = plan.distance_to_surfaces(points[:: max(1, len(points) // 200)])
    assert distances.min() == pytest.approx(0.5 * width, abs=1e-6)
    # It can turn on the spot, with a hand's breadth to spare.
    assert distances.min() > robot.circumscribed_radius_m + 0.1


@every_map
@few
@given(seed=seeds)
def test_the_start_is_on_a_centre_line_and_looks_along_it(config, seed):
    plan = rooms.make("corridors", seed=seed, config=config)
    width = width_of(CorridorsConfig(**config))
    x, y, theta = plan.start
    lines = centre_lines(plan, width)
    beside = np.abs(np.argwhere(lines)[:, ::-1] * plan.resolution + 0.5 * width - (x, y)).max(axis=1)
    assert beside.min() <= 0.5 * plan.resolution + 1e-6
    assert plan.distance_to_surfaces(np.array([[x, y]]))[0] >= 0.5 * width - 0.5 * plan.resolution - 1e-4
    assert plan.start_clearance_m > 0
    assert theta in (0.0, 0.5 * math.pi, -math.pi, -0.5 * math.pi)
    # The corridor runs on for a length of its own one way or the other.
    ahead = np.array([math.cos(theta), math.sin(theta)])
    run = sum(
        int(plan.is_free(np.array([[x, y] + sign * step * ahead]))[0])
        for sign in (-1, 1)
        for step in np.arange(0.0, 2.0 * width, 0.1 * width)
    )
    assert run * 0.1 >= 1.9


def joints(network: list[Corridor]) -> tuple[int, int, int, int]:
    """Crossings, junctions, bends and dead ends of a layout."""
    crossings = junctions = bends = 0
    joined = set()
    for i, a in enumerate(network):
        for b in network[:i]:
            if a.upright == b.upright or not (a.low <= b.line <= a.high and b.low <= a.line <= b.high):
                continue
            ends = (b.line in (a.low, a.high)) + (a.line in (b.low, b.high))
            crossings, junctions, bends = crossings + (ends == 0), junctions + (ends == 1), bends + (ends == 2)
            joined |= {(a, b.line)} | {(b, a.line)}
    dead_ends = sum((c, end) not in joined for c in network for end in (c.low, c.high))
    return crossings, junctions, bends, dead_ends


@every_map
@few
@given(seed=seeds)
def test_corners_are_those_of_the_crossings(config, seed):
    plan = rooms.make("corridors", seed=seed, config=config)
    network = draw_layout(CorridorsConfig(**config), generator(seed))
    crossings, junctions, bends, dead_ends = joints(network)
    assert np.count_nonzero(plan.corner_kinds == CONVEX) == 4 * crossings + 2 * junctions + bends
    assert np.count_nonzero(plan.corner_kinds == CONCAVE) == bends + 2 * dead_ends
    assert len(plan.corners) == len(plan.walls)


@every_map
@few
@given(seed=seeds)
def test_walls_are_closed_round_the_free_cells(config, seed):
    plan = rooms.make("corridors", seed=seed, config=config)
    x1, y1, x2, y2 = plan.walls.T
    assert 0.5 * np.sum(x1 * y2 - x2 * y1) == pytest.approx(plan.area_m2, abs=1e-4)
    ends = sorted(map(tuple, plan.walls[:, 2:]))
    assert ends == sorted(map(tuple, plan.walls[:, :2]))
    assert not plan.free[[0, -1]].any() and not plan.free[:, [0, -1]].any()
    # Between two corridors stands a wall of its thickness: no solid run is thinner.
    thin = round(0.2 / plan.resolution)
    for raster in (plan.free, plan.free.T):
        for line in np.pad(raster, ((0, 0), (1, 1)), constant_values=True).astype(np.int8):
            change = np.diff(line)
            assert np.all(np.flatnonzero(change == 1) - np.flatnonzero(change == -1) >= thin)


@few
@given(seed=seeds)
def test_without_loops_it_is_a_tree(seed):
    network = draw_layout(CorridorsConfig(map=3, loops=0.0), generator(seed))
    assert sum(joints(network)[:3]) == len(network) - 1


def test_with_loops_there_are_some():
    networks = [draw_layout(CorridorsConfig(loops=1.0), generator(seed)) for seed in range(40)]
    assert np.mean([sum(joints(n)[:3]) >= len(n) for n in networks]) > 0.4


@few
@given(
    seed=seeds,
    width_cm=st.integers(12, 80),
    wall_cm=st.integers(10, 40),
    longest_cm=st.integers(100, 900),
    total_cm=st.integers(100, 5000),
    loops=st.floats(0.0, 1.0),
)
def test_any_lengths_that_fit_are_kept(seed, width_cm, wall_cm, longest_cm, total_cm, loops):
    pitch_cm = 2 * width_cm + wall_cm
    assume(longest_cm >= 2 * pitch_cm)
    assume(total_cm == longest_cm or total_cm >= longest_cm + pitch_cm)
    config = CorridorsConfig(
        total_length_m=total_cm / 100,
        longest_m=longest_cm / 100,
        width_m=2 * width_cm / 100,
        wall_m=wall_cm / 100,
        loops=loops,
    )
    plan = rooms.make("corridors", seed=seed, config=config)
    lengths = corridor_lengths(plan, 2 * width_cm / 100)
    assert lengths.sum() == pytest.approx(total_cm / 100, abs=0.01)
    assert lengths.max() == pytest.approx(longest_cm / 100, abs=0.01)


def test_round_lengths_lie_on_the_lattice_of_the_other_rooms():
    assert sizes_of(CorridorsConfig()).cell_m == 0.05
    assert sizes_of(CorridorsConfig(map=1)).cell_m == 0.01
    assert rooms.make("corridors", seed=1).name == "corridors-1"
    assert rooms.make("corridors", seed=1, config={"map": 2}).name == "corridors-map2-1"


def digest(config, seed):
    plan = rooms.make("corridors", seed=seed, config=config)
    parts = [plan.walls, plan.free, np.array(plan.start)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(p).tobytes() for p in parts)).hexdigest()


def test_the_same_seed_gives_the_same_plan_in_another_process():
    jobs = [(config, seed) for config in ({}, {"map": 2}) for seed in range(3)]
    here = [digest(*job) for job in jobs]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.starmap(digest, jobs)
    assert here == there
    assert len(set(here)) == len(jobs)


@pytest.mark.parametrize(
    ("config", "remedy"),
    [
        ({"total_length_m": 5.0, "longest_m": 6.0}, "raise the total to at least 6"),
        (
            {"map": 2, "width_m": 1.2},
            r"too short for corridors 1.2 m wide: raise it to .* = 2.8 or make width_m smaller",
        ),
        ({"total_length_m": 12.5}, "make it 12, or at least 13.6"),
        ({"total_length_m": -3.0}, r"total_length_m must be in \[0.5, 300\], or None, got -3"),
        ({"longest_m": math.nan}, "longest_m must be in"),
        ({"longest_m": math.inf}, "longest_m must be in"),
        ({"width_m": 0.0}, r"width_m must be in \[0.2, 5\]"),
        ({"wall_m": 0.0}, "wall_m must be in"),
        ({"loops": 1.5}, "loops must be in"),
        ({"map": 4}, r"map must be a whole number in \[1, 3\], or None, got 4"),
        ({"map": True}, r"map must be a whole number in \[1, 3\], or None, got True"),
        ({"map": 1, "total_length_m": 20.0}, "leave out one of the two"),
        ({"lenght_m": 3.0}, "longest_m"),
    ],
)
def test_a_bad_config_is_refused_with_what_to_do(config, remedy):
    with pytest.raises(ValueError, match=remedy) as caught:
        rooms.make("corridors", seed=0, config=config)
    assert "\n" not in str(caught.value)
