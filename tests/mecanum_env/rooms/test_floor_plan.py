"""The floor plan itself: validation, queries, true corners, and surfaces of rectangles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mecanum_env.rooms.floor_plan import FloorPlan, FloorPlanError
from mecanum_env.rooms.outlines.rectilinear import surfaces
from slam.types import CONCAVE, CONVEX


def room(**changes):
    """A room of 4 m by 3 m with its lower-left corner at (1, 2), in a raster one cell larger all round."""
    free = np.zeros((32, 42), bool)
    free[1:-1, 1:-1] = True
    values = {
        "name": "room",
        "walls": surfaces(np.array([[1.0, 2.0, 5.0, 5.0]])),
        "polygons": (),
        "circles": np.zeros((0, 3)),
        "free": free,
        "resolution": 0.1,
        "origin": (0.9, 1.9),
        "start": (3.0, 3.5, 0.0),
    }
    return FloorPlan(**(values | changes))


def box(x0, y0, x1, y1):
    return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)


def corner_map(plan):
    return {(round(x, 3), round(y, 3)): int(k) for (x, y), k in zip(plan.corners, plan.corner_kinds, strict=True)}


def test_a_room_has_its_area_bounds_and_four_concave_corners():
    plan = room()
    assert plan.area_m2 == pytest.approx(12.0)
    assert plan.bounds == (1.0, 2.0, 5.0, 5.0)
    assert corner_map(plan) == dict.fromkeys([(1.0, 2.0), (5.0, 2.0), (5.0, 5.0), (1.0, 5.0)], CONCAVE)


@pytest.mark.parametrize("reverse", [False, True])
def test_furniture_against_walls_makes_true_corners_only(reverse):
    """A cupboard in the corner with another, as deep, beside it, and a pillar that stands free."""
    cupboards = (box(1.0, 2.0, 2.0, 2.6), box(2.0, 2.0, 2.8, 2.6))
    pillar = box(3.5, 3.5, 3.9, 3.9)
    free = room().free.copy()
    free[1:7, 1:19] = False
    free[16:20, 26:30] = False
    walls = room().walls
    walls = walls[:, [2, 3, 0, 1]] if reverse else walls  # the direction of a wall does not matter
    plan = room(polygons=(*cupboards, pillar), free=free, walls=walls, start=(4.5, 4.5, 0.0))
    expected = {
        (5.0, 2.0): CONCAVE,
        (5.0, 5.0): CONCAVE,
        (1.0, 5.0): CONCAVE,
        (1.0, 2.6): CONCAVE,  # where the cupboard's front meets the wall; (1, 2) is hidden, (2, 2.6) straight
        (2.8, 2.6): CONVEX,
        (2.8, 2.0): CONCAVE,
    } | {(float(x), float(y)): CONVEX for x, y in pillar}
    assert corner_map(plan) == expected


def test_a_bend_of_less_than_five_degrees_is_no_corner():
    def wall_kinds(degrees):
        bend = (3.0, 5.0 + 2.0 * math.tan(math.radians(degrees / 2)))
        points = [(1.0, 2.0), (5.0, 2.0), (5.0, 5.0), bend, (1.0, 5.0)]
        walls = np.array([(*a, *b) for a, b in zip(points, points[1:] + points[:1], strict=True)])
        return (3.0, round(bend[1], 3)) in corner_map(room(walls=walls))

    assert not wall_kinds(3.0)
    assert wall_kinds(8.0)


def test_thin_walls_make_a_corner_of_no_kind():
    thin = np.array([(3.0, 3.0, 4.0, 3.0), (4.0, 3.0, 4.0, 4.0)])
    plan = room(walls=np.vstack([room().walls, thin]))
    assert corner_map(plan)[(4.0, 3.0)] == 0
    assert (3.0, 3.0) not in corner_map(plan)  # the end of one surface: no corner


def test_is_free_follows_the_raster_and_is_false_outside():
    points = np.array(
        [(1.05, 2.05), (0.95, 2.05), (4.95, 4.95), (5.05, 3.0), (1e300, 0.0), (-50.0, 3.0), (np.nan, 3.0)]
    )
    assert room().is_free(points).tolist() == [True, False, True, False, False, False, False]


def test_clearance_is_the_distance_to_the_wall():
    clearance = room().clearance()
    row, col = 11, 1  # centre at (1.05, 3.05): 5 cm from the left wall
    assert clearance[row, col] == pytest.approx(0.05, abs=1e-5)
    assert clearance[16, 21] == pytest.approx(1.45, abs=1e-5)  # (3.05, 3.55): 1.45 m below the upper wall
    assert not clearance[~room().free].any()
    clearance[:] = 9.0
    assert room().clearance().max() < 9.0


def test_distance_to_surfaces_is_exact():
    plan = room(circles=np.array([(3.0, 4.0, 0.25)]), start=(1.5, 2.5, 0.0))
    points = np.array([(1.3, 3.0), (3.0, 3.5), (3.0 + 0.3, 4.0 + 0.4), (3.0, 4.1)])
    assert plan.distance_to_surfaces(points) == pytest.approx([0.3, 0.25, 0.25, 0.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"free": np.zeros((32, 42), bool)}, "no free space"),
        ({"start": (0.5, 0.5, 0.0)}, "not in free space"),
        ({"start": (0.95, 3.0, 0.0)}, "not in free space"),
        ({"start": (math.nan, 3.0, 0.0)}, "finite"),
        ({"start": (1.3, 3.0, 0.0), "start_clearance_m": 0.4}, "0.30 m from a surface"),
        ({"walls": np.array([[0.0, 0.0, math.inf, 1.0]])}, "walls must be finite"),
        ({"walls": np.zeros((2, 3))}, r"walls must have shape \(n, 4\)"),
        ({"polygons": (np.zeros((2, 2)),)}, "3 vertices"),
        ({"polygons": (box(2.0, 3.0, 3.0, 4.0)[[0, 0, 1, 2, 3]],)}, "two vertices in one place"),
        ({"polygons": (np.array([(2.0, 3.0), (3.0, 4.0), (4.0, 5.0)]),)}, "convex, of some area"),
        ({"polygons": (box(2.0, 3.0, 3.0, 4.0)[[0, 2, 1, 3]],)}, "convex"),  # crosses itself
        # A dent that the lidar would see, while the robot touched the hull.
        ({"polygons": (np.array([(2.0, 3.0), (4.0, 3.0), (4.0, 3.3), (2.3, 3.3), (2.0, 4.5)]),)}, "convex"),
        ({"circles": np.array([[3.0, 3.0, 0.0]])}, "radius > 0"),
        ({"circles": np.array([[3.0, 3.0, math.nan]])}, "circles must be finite"),
        ({"resolution": 0.0}, "resolution"),
        ({"origin": (math.nan, 0.0)}, "origin"),
    ],
)
def test_a_bad_plan_is_refused_in_one_line(changes, words):
    with pytest.raises(FloorPlanError, match=words) as caught:
        room(**changes)
    assert "\n" not in str(caught.value)


def test_with_start_checks_like_the_first_start():
    plan = room()
    moved = plan.with_start((1.5, 2.5, 1.0), clearance_m=0.4)
    assert moved.start == (1.5, 2.5, 1.0)
    for bad in [(0.0, 0.0, 0.0), (1.2, 3.0, 0.0), (1.0,), ("a", 1, 2), None]:
        with pytest.raises(FloorPlanError):
            plan.with_start(bad, clearance_m=0.4)


rectangles = st.lists(
    st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 5), st.integers(1, 5)), min_size=1, max_size=8
)


@given(rectangles)
def test_surfaces_are_the_edges_between_free_and_solid(boxes):
    """Painted cell by cell, the segments are the raster's edges, each once, free cells on the left."""
    free = np.zeros((20, 20), bool)
    for x, y, w, h in boxes:
        free[y + 1 : y + h + 1, x + 1 : x + w + 1] = True
    walls = surfaces(np.array([(x, y, x + w, y + h) for x, y, w, h in boxes], float))
    edges = set()
    for x1, y1, x2, y2 in walls.astype(int) + 1:
        dx, dy = np.sign(x2 - x1), np.sign(y2 - y1)
        for k in range(abs(x2 - x1) + abs(y2 - y1)):
            edge = (x1 + k * dx, y1 + k * dy, dx, dy)
            assert edge not in edges
            edges.add(edge)
            middle = np.array([edge[0] + 0.5 * dx, edge[1] + 0.5 * dy])
            left, right = middle + 0.5 * np.array([-dy, dx]), middle - 0.5 * np.array([-dy, dx])
            assert free[int(left[1]), int(left[0])]
            assert not free[int(right[1]), int(right[0])]
    assert len(edges) == np.count_nonzero(np.diff(free, axis=0)) + np.count_nonzero(np.diff(free, axis=1))
    # As long as can be: no two in line meet end to end with free space on the same side.
    ends = {tuple(w[2:]) + tuple(np.sign(w[2:] - w[:2])) for w in walls}
    assert not any(tuple(w[:2]) + tuple(np.sign(w[2:] - w[:2])) in ends for w in walls)
