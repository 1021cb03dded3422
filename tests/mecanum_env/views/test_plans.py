"""Pictures of plans: the right size, the right colours in the right places."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mecanum_env import rooms
from mecanum_env.rooms.files.importers import from_raster
from mecanum_env.views.canvas import FLOOR, FURNITURE, ROBOT, WALL
from mecanum_env.views.plans import contact_sheet, draw_plan


def test_a_picture_shows_free_space_walls_and_furniture_where_they_are():
    plan = rooms.make("apartment", seed=4)
    scale = 40
    image = draw_plan(plan, pixels_per_m=scale)
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
    x0, y0, x1, y1 = plan.bounds
    assert image.shape[:2] == pytest.approx(((y1 - y0 + 1.0) * scale, (x1 - x0 + 1.0) * scale), abs=1.5)

    def colour(x, y):
        return tuple(int(v) for v in image[int((y1 + 0.5 - y) * scale), int((x - x0 + 0.5) * scale)])

    rows, cols = np.nonzero(plan.clearance() > 0.1)
    away = np.hypot((cols + 0.5) * 0.05 - plan.start[0], (rows + 0.5) * 0.05 - plan.start[1]) > 0.5
    for row, col in list(zip(rows[away], cols[away], strict=True))[::97]:
        assert colour((col + 0.5) * 0.05, (row + 0.5) * 0.05) == FLOOR
    for polygon in plan.polygons:
        assert colour(*polygon.mean(axis=0)) == FURNITURE
    for wall in plan.walls:
        along = wall[2:] - wall[:2]
        behind = 0.5 * (wall[:2] + wall[2:]) + 0.05 * np.array([along[1], -along[0]]) / np.hypot(*along)
        assert colour(*behind) == WALL
    assert (image == ROBOT).all(axis=2).sum() > 0.4 * 0.58 * 0.38 * scale**2


def test_walls_that_do_not_close_are_drawn_too():
    closed = from_raster(np.ones((40, 40), bool), name="box", resolution=0.05)
    open_plan = dataclasses.replace(closed, walls=closed.walls[:3])
    image = draw_plan(open_plan)
    assert tuple(image[image.shape[0] // 2 - 25, image.shape[1] // 2 - 30]) == FLOOR


def test_a_huge_plan_gets_a_picture_of_bounded_size():
    plan = from_raster(np.ones((20, 200), bool), name="huge", resolution=10.0)
    assert max(draw_plan(plan).shape) <= 8193


def test_a_contact_sheet_holds_all_plans():
    plans = [rooms.make("rectangular", seed=s) for s in range(5)]
    sheet = contact_sheet(plans, 3, pixels_per_m=10)
    heights, widths = zip(*(draw_plan(p, pixels_per_m=10).shape[:2] for p in plans), strict=True)
    assert sheet.shape[1] == 3 * max(widths)
    assert sheet.shape[0] >= 2 * max(heights)
    with pytest.raises(ValueError, match="at least one plan"):
        contact_sheet([], 3)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_a_scale_is_positive(scale):
    with pytest.raises(ValueError, match="pixels_per_m"):
        draw_plan(rooms.make("rectangular", seed=0), pixels_per_m=scale)
