"""Floor plans as pictures: one, or many on a sheet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from mecanum_env.config import RobotConfig
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.views.canvas import INK, PAGE, ROBOT, Canvas, View, put_text, text_width
from mecanum_env.views.paint import paint_plan, with_margin
from slam.types import Bytes

__all__ = ["contact_sheet", "draw_plan"]

Image = Bytes

_MAX_SIDE_PX = 8192
_OVERSAMPLING = 4  # drawn so much larger, then averaged: OpenCV's own anti-aliasing swells every outline
_CAPTION_PX = 24
_LEAST_BAR_SCALE = 20.0  # pixels per metre; below that there is no room for a scale bar


def draw_plan(plan: FloorPlan, *, pixels_per_m: float = 40.0, robot: RobotConfig | None = None) -> Image:
    """Return a picture ``(h, w, 3)`` of a plan, blue-green-red, y upwards.

    Walls are dark, free space white, furniture toned; the robot stands at the start; from 20 pixels per metre on
    a bar shows the scale. A plan so large that a side would pass 8192 pixels is drawn smaller.

    Raises
    ------
    ValueError
        If ``pixels_per_m`` is not a positive number.
    """
    if not (math.isfinite(pixels_per_m) and pixels_per_m > 0):
        raise ValueError(f"pixels_per_m must be > 0, got {pixels_per_m}")
    page = View.around(with_margin(plan.bounds), longest_px=_MAX_SIDE_PX, max_scale=pixels_per_m)
    times = max(1, min(_OVERSAMPLING, _MAX_SIDE_PX // max(page.width, page.height)))
    view = View(page.left, page.top, times * page.scale, times * page.width, times * page.height)
    canvas = Canvas(np.empty((view.height, view.width, 3), np.uint8), view)
    paint_plan(canvas, plan, np.zeros(3), ground=PAGE)
    canvas.robot(np.array(plan.start), robot or RobotConfig(), ROBOT)
    image = np.asarray(cv2.resize(canvas.image, (page.width, page.height), interpolation=cv2.INTER_AREA), np.uint8)
    if page.scale >= _LEAST_BAR_SCALE:
        x, y = 0.4 * page.scale, page.height - 0.14 * page.scale
        Canvas(image, page).scale_bar(
            x_px=round(x), y_px=round(y), longest_px=0.4 * page.width, size=min(0.24 * page.scale, 18.0)
        )
    return image


def contact_sheet(plans: Sequence[FloorPlan], columns: int = 4, *, pixels_per_m: float = 20.0) -> Image:
    """Return pictures of plans, all to one scale, side by side in ``columns``, row by row, with their names.

    Raises
    ------
    ValueError
        If there is no plan or no column.
    """
    if not plans or columns < 1:
        raise ValueError("a contact sheet needs at least one plan and one column")
    pictures = [draw_plan(plan, pixels_per_m=pixels_per_m) for plan in plans]
    height, width = (max(p.shape[axis] for p in pictures) for axis in (0, 1))
    columns = min(columns, len(plans))
    rows = -(-len(plans) // columns)
    sheet = np.empty((rows * (height + _CAPTION_PX), columns * width, 3), np.uint8)
    sheet[:] = PAGE
    for i, (plan, picture) in enumerate(zip(plans, pictures, strict=True)):
        y, x = (i // columns) * (height + _CAPTION_PX), (i % columns) * width
        dy, dx = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
        sheet[y + dy : y + dy + picture.shape[0], x + dx : x + dx + picture.shape[1]] = picture
        at = (x + (width - text_width(plan.name, size=14)) // 2, y + height + 12)
        put_text(sheet, plan.name, at, INK, size=14)
    return sheet
