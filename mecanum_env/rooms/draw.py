"""Floor plans as pictures, drawn with OpenCV."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.config import RobotConfig
from mecanum_env.rooms.floor_plan import FloorPlan
from slam.geometry import transform_points

__all__ = ["contact_sheet", "draw_plan"]

Image = NDArray[np.uint8]
Array = NDArray[np.float64]
Colour = tuple[int, int, int]

# Blue, green, red.
PAGE: Colour = (244, 246, 247)
FLOOR: Colour = (255, 255, 255)
WALL: Colour = (74, 62, 54)
FURNITURE: Colour = (176, 205, 224)
FURNITURE_EDGE: Colour = (96, 134, 158)
ROBOT: Colour = (42, 92, 222)
INK: Colour = (110, 100, 92)

_WALL_M = 0.22  # how deep solid matter is drawn behind its surface
_BORDER_M = 0.5
_MAX_SIDE_PX = 8192
_OVERSAMPLING = 4  # drawn so much larger, then averaged: OpenCV's own anti-aliasing swells every outline
_SHIFT = 4  # OpenCV's fixed-point fraction bits: anti-aliased to 1/16 pixel


def draw_plan(plan: FloorPlan, *, pixels_per_m: float = 40.0, robot: RobotConfig | None = None) -> Image:
    """Return a picture ``(h, w, 3)`` of a plan, blue-green-red, y upwards.

    Walls are dark, free space white, furniture toned; the robot's outline and heading stand at the start, and a
    bar shows one metre. A plan so large that a side would pass 8192 pixels is drawn smaller.

    Raises
    ------
    ValueError
        If ``pixels_per_m`` is not a positive number.
    """
    if not (math.isfinite(pixels_per_m) and pixels_per_m > 0):
        raise ValueError(f"pixels_per_m must be > 0, got {pixels_per_m}")
    canvas = _Canvas(plan, pixels_per_m)
    canvas.bands(plan.walls, WALL, _WALL_M)
    loops = _loops(plan.walls)
    if loops is None:
        canvas.raster(plan)
    else:
        canvas.fill(loops, FLOOR)
    for polygon in plan.polygons:
        canvas.outlined(polygon, FURNITURE, FURNITURE_EDGE)
    for x, y, radius in plan.circles:
        angle = np.linspace(0.0, 2.0 * math.pi, 64, endpoint=False)
        rim = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
        canvas.outlined(rim, FURNITURE, FURNITURE_EDGE)
    _draw_robot(canvas, plan, robot or RobotConfig())
    return _with_scale(canvas)


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
    rows, caption, text = -(-len(plans) // columns), 24, 0.45
    sheet = np.empty((rows * (height + caption), columns * width, 3), np.uint8)
    sheet[:] = PAGE
    for i, (plan, picture) in enumerate(zip(plans, pictures, strict=True)):
        y, x = (i // columns) * (height + caption), (i % columns) * width
        dy, dx = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
        sheet[y + dy : y + dy + picture.shape[0], x + dx : x + dx + picture.shape[1]] = picture
        (label, _), _ = cv2.getTextSize(plan.name, cv2.FONT_HERSHEY_SIMPLEX, text, 1)
        at = (x + (width - label) // 2, y + height + 12)
        cv2.putText(sheet, plan.name, at, cv2.FONT_HERSHEY_SIMPLEX, text, INK, 1, cv2.LINE_AA)
    return sheet


class _Canvas:
    """A picture in which positions are given in metres, y upwards."""

    def __init__(self, plan: FloorPlan, pixels_per_m: float) -> None:
        x0, y0, x1, y1 = plan.bounds
        side = max(x1 - x0, y1 - y0) + 2 * _BORDER_M
        self.page_scale = min(pixels_per_m, _MAX_SIDE_PX / side)
        self.oversampling = max(1, min(_OVERSAMPLING, int(_MAX_SIDE_PX / (side * self.page_scale))))
        self.line_type = cv2.LINE_8 if self.oversampling > 1 else cv2.LINE_AA
        self.scale = self.page_scale * self.oversampling
        self.left, self.top = x0 - _BORDER_M, y1 + _BORDER_M
        size = (math.ceil((v + 2 * _BORDER_M) * self.page_scale) * self.oversampling for v in (y1 - y0, x1 - x0))
        self.image: Image = np.empty((*size, 3), np.uint8)
        self.image[:] = PAGE

    def page(self) -> Image:
        """Return the picture at its final size."""
        rows, cols = (v // self.oversampling for v in self.image.shape[:2])
        return np.asarray(cv2.resize(self.image, (cols, rows), interpolation=cv2.INTER_AREA), np.uint8)

    def pixels(self, points: Array) -> NDArray[np.int32]:
        """Fixed-point pixel positions of points ``(n, 2)`` [m]."""
        # A pixel's centre, not its corner, has whole coordinates.
        pixel = np.stack([points[:, 0] - self.left, self.top - points[:, 1]], axis=1) * self.scale - 0.5
        return np.round(pixel * (1 << _SHIFT)).astype(np.int32)

    def line_width(self, metres: float) -> int:
        return max(1, round(metres * self.scale))

    def lines(self, segments: Array, colour: Colour, width_m: float) -> None:
        pairs = self.pixels(segments.reshape(-1, 2)).reshape(-1, 2, 2)
        cv2.polylines(
            self.image, list(pairs), False, colour, self.line_width(width_m), self.line_type, shift=_SHIFT
        )

    def bands(self, segments: Array, colour: Colour, width_m: float) -> None:
        """Draw segments this wide to either side and beyond either end: corners come out square."""
        along = segments[:, 2:] - segments[:, :2]
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        ahead = along / length * width_m
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        a, b = segments[:, :2] - ahead, segments[:, 2:] + ahead
        outlines = np.stack([a - left, b - left, b + left, a + left], axis=1)
        for outline in self.pixels(outlines.reshape(-1, 2)).reshape(-1, 4, 2):
            cv2.fillConvexPoly(self.image, outline, colour, self.line_type, shift=_SHIFT)

    def fill(self, loops: list[Array], colour: Colour) -> None:
        cv2.fillPoly(self.image, [self.pixels(p) for p in loops], colour, self.line_type, shift=_SHIFT)

    def outlined(self, polygon: Array, colour: Colour, edge: Colour) -> None:
        points = [self.pixels(polygon)]
        cv2.fillPoly(self.image, points, colour, self.line_type, shift=_SHIFT)
        cv2.polylines(self.image, points, True, edge, self.line_width(0.025), self.line_type, shift=_SHIFT)

    def raster(self, plan: FloorPlan) -> None:
        """Paint the free cells, for walls that do not close."""
        rows, cols = self.image.shape[:2]
        x = self.left + (np.arange(cols) + 0.5) / self.scale
        y = self.top - (np.arange(rows) + 0.5) / self.scale
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        self.image[plan.is_free(grid).reshape(rows, cols)] = FLOOR


def _draw_robot(canvas: _Canvas, plan: FloorPlan, robot: RobotConfig) -> None:
    pose = np.array(plan.start)
    a, b = 0.5 * robot.length_m, 0.5 * robot.width_m
    body = np.array([(-a, -b), (a, -b), (a, b), (-a, b)])
    canvas.outlined(transform_points(pose, body), ROBOT, ROBOT)
    arrow = np.array([(-0.45 * a, 0.6 * b), (0.7 * a, 0.0), (-0.45 * a, -0.6 * b), (-0.15 * a, 0.0)])
    canvas.fill([transform_points(pose, arrow)], FLOOR)


def _with_scale(canvas: _Canvas) -> Image:
    """Return the page with a bar of one metre (ten, a hundred, … on a large plan) below the plan, on the left."""
    rows, cols = canvas.image.shape[:2]
    metres = 10 ** max(0, math.floor(math.log10(0.4 * cols / canvas.scale)))
    x, y = canvas.left + _BORDER_M, canvas.top - rows / canvas.scale + 0.14
    ends = np.array([[x, y, x + metres, y], [x, y - 0.06, x, y + 0.06]])
    canvas.lines(np.vstack([ends, ends[1] + [metres, 0, metres, 0]]), INK, 0.025)
    page, scale = canvas.page(), canvas.page_scale
    if scale >= 20:
        at = (round((x + metres - canvas.left + 0.1) * scale), page.shape[0] - round(0.08 * scale))
        cv2.putText(page, f"{metres} m", at, cv2.FONT_HERSHEY_SIMPLEX, 0.01 * scale, INK, 1, cv2.LINE_AA)
    return page


def _loops(walls: Array) -> list[Array] | None:
    """Chain walls into closed loops ``(k, 2)``; None where they do not close."""
    following: dict[tuple[float, float], list[int]] = {}
    for i, (x, y) in enumerate(np.round(walls[:, :2], 4).tolist()):
        following.setdefault((x, y), []).append(i)
    ends = [(x, y) for x, y in np.round(walls[:, 2:], 4).tolist()]
    loops: list[Array] = []
    used = np.zeros(len(walls), np.bool_)
    for first in range(len(walls)):
        chain, i = [], first
        while not used[i]:
            used[i] = True
            chain.append(i)
            options = following.get(ends[i], [])
            open_ones = [j for j in options if not used[j]]
            if not open_ones:
                if first not in options:
                    return None
                break
            i = open_ones[0]
        if chain:
            loops.append(walls[chain, :2])
    return loops or None
