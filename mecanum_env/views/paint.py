"""What the pictures of an episode share: colours, the true plan, landmarks, paths, and the part to show."""

from __future__ import annotations

import math

import cv2
import numpy as np

from mecanum_env.ground_truth import GroundTruth
from mecanum_env.rooms.floor_plan import FloorPlan
from mecanum_env.rooms.outlines.smooth_outline import signed_area
from mecanum_env.views.canvas import FLOOR, FURNITURE, FURNITURE_EDGE, WALL, Canvas, Colour, View
from slam.belief import Belief
from slam.geometry import transform_points
from slam.types import Array, Flags

__all__ = [
    "BEAM", "BELIEVED_PATH", "FRONTIER", "LANDMARK", "PLANNED_PATH", "SIGMAS", "TRUE_PATH", "UNSEEN", "Box",
    "extent", "extent_of_truth", "paint_landmarks", "paint_plan", "thinned", "with_margin",
]  # fmt: skip

Box = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max [m]."""

# Blue, green, red.
UNSEEN: Colour = (228, 225, 222)
TRUE_PATH: Colour = (112, 140, 22)
BELIEVED_PATH: Colour = (205, 96, 44)
PLANNED_PATH: Colour = (42, 92, 222)
FRONTIER: Colour = (20, 160, 248)
LANDMARK: Colour = (128, 38, 178)
BEAM: Colour = (214, 196, 92)

SIGMAS = 3.0  # of every covariance ellipse
_WALL_M = 0.22  # how deep solid matter is drawn behind its surface
_MARGIN_M = 0.5
_PATH_SPACING_PX = 8.0


def paint_plan(canvas: Canvas, plan: FloorPlan, frame: Array, *, ground: Colour = UNSEEN) -> None:
    """Paint a plan whose frame has the pose ``frame`` ``(3,)`` in the view's, on a ground of one colour."""

    def seen(points: Array) -> Array:
        return transform_points(frame, points)

    canvas.image[:] = ground
    canvas.bands(seen(plan.walls.reshape(-1, 2)).reshape(-1, 4), WALL, _WALL_M)
    loops = _loops(plan.walls)
    if loops is None:
        # Walls that do not close: the free cells themselves.
        view = canvas.view
        matrix = view.raster_matrix(plan.resolution, plan.origin, frame)
        free = cv2.warpAffine(plan.free.astype(np.float32), matrix, (view.width, view.height))
        canvas.image[free > 0.5] = FLOOR
    else:
        # Free space lies on the left of every wall: a loop that runs clockwise goes around something solid.
        for loop in loops:
            if signed_area(loop) < 0:
                canvas.fill([seen(loop)], WALL)
        canvas.fill([seen(loop) for loop in loops], FLOOR)
    angles = np.linspace(0.0, 2.0 * math.pi, 64, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rims = [np.array([x, y]) + radius * circle for x, y, radius in plan.circles]
    for outline in (*plan.polygons, *rims):
        canvas.fill([seen(outline)], FURNITURE)
        canvas.line(seen(outline), FURNITURE_EDGE, px=canvas.width(0.02), closed=True)


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


def paint_landmarks(canvas: Canvas, belief: Belief, *, dot_px: float) -> None:
    """Paint each landmark's 3σ ellipse, never smaller than the dot of ``dot_px`` pixels in its middle."""
    canvas.ellipses(
        belief.landmarks, belief.landmark_cov, LANDMARK, sigmas=SIGMAS, least_px=dot_px, px=canvas.width(0.015)
    )
    canvas.dots(belief.landmarks, LANDMARK, px=dot_px)


def thinned(path: Array, view: View) -> Array:
    """Return positions ``(n, 2)`` of a path about eight pixels apart, both ends among them.

    Lines through points that are closer come out beaded.
    """
    points = np.asarray(path, np.float64)[:, :2]
    steps = np.hypot(*np.diff(points, axis=0).T)
    if not len(steps):
        return points
    pieces = np.floor(np.cumsum(steps) * (view.scale / _PATH_SPACING_PX))
    keep = np.flatnonzero(np.diff(pieces)) + 2
    return np.vstack([points[:1], points[keep], points[-1:]])


def extent_of_truth(ground: GroundTruth) -> Box:
    """Return the box around all that can be mapped, in the start frame."""
    row, col = ground.lattice_origin
    origin = (col * ground.resolution, row * ground.resolution)
    return extent(ground.mappable, ground.resolution, origin) or (-1.0, -1.0, 1.0, 1.0)


def extent(mask: Flags, resolution: float, origin: tuple[float, float]) -> Box | None:
    """Return the box x_min, y_min, x_max, y_max [m] around the cells that are set."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    x, y = origin
    return (
        x + cols[0] * resolution, y + rows[0] * resolution,
        x + (cols[-1] + 1) * resolution, y + (rows[-1] + 1) * resolution,
    )  # fmt: skip


def with_margin(box: Box) -> Box:
    """Return the box with half a metre more on every side."""
    x0, y0, x1, y1 = box
    return x0 - _MARGIN_M, y0 - _MARGIN_M, x1 + _MARGIN_M, y1 + _MARGIN_M
