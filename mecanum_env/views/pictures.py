"""The large pictures of an episode's end: what was believed, and what is true, to be laid beside each other.

Both are drawn in the start frame, which is the belief's; blue, green, red as :func:`cv2.imwrite` takes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from mecanum_env.config import RobotConfig
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.views.canvas import FLOOR, INK, PAGE, ROBOT, WALL, Canvas, Colour, View, put_text, text_width
from mecanum_env.views.paint import (
    BELIEVED_PATH,
    LANDMARK,
    TRUE_PATH,
    UNSEEN,
    extent,
    extent_of_truth,
    paint_landmarks,
    paint_plan,
    thinned,
    with_margin,
)
from slam.belief import Belief
from slam.geometry import inverse
from slam.grids.occupancy import OCCUPIED, UNKNOWN, OccupancyGrid
from slam.types import Array, Bytes

__all__ = ["draw_map", "draw_truth", "episode_view"]

Image = Bytes

_FOOTER_PX = 64
_TITLE_GAP = " " * 3


def episode_view(ground: GroundTruth, belief: Belief, *, longest_px: int = 1600) -> View:
    """Return the view that shows all that can be mapped and all that was, for both pictures of an episode."""
    boxes = [extent_of_truth(ground)]
    grid = belief.grid
    known = extent(grid.classes() != UNKNOWN, grid.resolution, grid.origin)
    boxes += [known] if known is not None else []
    x0, y0, x1, y1 = zip(*boxes, strict=True)
    return View.around(with_margin((min(x0), min(y0), max(x1), max(y1))), longest_px=longest_px)


def draw_map(
    belief: Belief, path: Array, *, view: View, robot: RobotConfig | None = None, title: str = ""
) -> Image:
    """Return what was believed at the end as a picture ``(view.height + 64, view.width, 3)``.

    Unknown is light grey, free white, walls dark; landmarks with their 3σ ellipses, the believed path from
    pale at the start to full at the end, the start a ring and the end the robot; below, a scale bar and legend.

    Parameters
    ----------
    belief : Belief
        In the start frame.
    path : (n, ≥ 2) array
        The believed positions [m].
    view : View
        See :func:`episode_view`.
    robot : RobotConfig, optional
        The youBot by default.
    title : str
        Written at the right below the picture; where there is no room, only as far as its first three spaces.
    """
    image = _blank(view)
    canvas = Canvas(image[: view.height], view)
    canvas.image[:] = UNSEEN
    _paint_smooth_grid(canvas, belief.grid)
    _paint_path(canvas, path, BELIEVED_PATH)
    paint_landmarks(canvas, belief, dot_px=max(2.2, 0.025 * view.scale))
    canvas.robot(belief.pose, robot or RobotConfig(), ROBOT)
    legend = [("believed path", BELIEVED_PATH), ("landmark, 3σ", LANDMARK)]
    _write_footer(image, canvas, legend, title)
    return image


def draw_truth(
    ground: GroundTruth, path: Array, *, view: View, robot: RobotConfig | None = None, title: str = ""
) -> Image:
    """Return the true plan with the true path, in the frame, scale and size of :func:`draw_map`.

    Parameters
    ----------
    ground : GroundTruth
        The episode's.
    path : (n, 3) array
        The true poses in the start frame.
    view, robot, title
        As for :func:`draw_map`.
    """
    image = _blank(view)
    canvas = Canvas(image[: view.height], view)
    paint_plan(canvas, ground.plan, inverse(ground.start))
    _paint_path(canvas, path, TRUE_PATH)
    canvas.robot(np.asarray(path[-1], np.float64), robot or RobotConfig(), ROBOT)
    _write_footer(image, canvas, [("true path", TRUE_PATH)], title)
    return image


def _paint_smooth_grid(canvas: Canvas, grid: OccupancyGrid) -> None:
    """Paint the cells' classes with their steps rounded off, as a draughtsman would ink them."""
    classes = grid.classes()
    matrix = canvas.view.raster_matrix(grid.resolution, grid.origin)
    # Where an interpolated class passes these, its ink begins and is full. A wall one cell wide keeps its width,
    # and cells that touch at their corners stay joined.
    for mask, colour, begin, full in (
        (classes != UNKNOWN, FLOOR, 0.40, 0.60),
        (classes == OCCUPIED, WALL, 0.28, 0.52),
    ):
        size = (canvas.view.width, canvas.view.height)
        share = cv2.warpAffine(mask.astype(np.float32), matrix, size, flags=cv2.INTER_LINEAR)
        ink = np.clip((share - begin) / (full - begin), 0.0, 1.0)[..., None]
        canvas.image[:] = np.round(canvas.image * (1.0 - ink) + np.array(colour) * ink)


def _paint_path(canvas: Canvas, path: Array, colour: Colour) -> None:
    """Draw a path that grows from pale to full, with a ring where it starts."""
    points = thinned(path, canvas.view)
    width = canvas.width(0.035, least=2)
    pieces = 64
    ends = np.linspace(0, len(points) - 1, pieces + 1).astype(int)
    for k, (a, b) in enumerate(pairwise(ends)):
        share = 0.35 + 0.65 * (k + 1) / pieces
        b_tone, g_tone, r_tone = (round(255 - share * (255 - value)) for value in colour)
        canvas.line(points[a : b + 1], (b_tone, g_tone, r_tone), px=width)
    radius = max(4.0, 0.09 * canvas.view.scale)
    canvas.dots(points[:1], colour, px=radius)
    canvas.dots(points[:1], FLOOR, px=0.6 * radius)


def _write_footer(image: Image, canvas: Canvas, legend: Sequence[tuple[str, Colour]], title: str) -> None:
    """Write scale bar, legend and title below the picture, as far as there is room for each."""
    height, width = image.shape[:2]
    y, size = height - _FOOTER_PX // 2, 18
    canvas_below = Canvas(image, canvas.view)
    canvas_below.scale_bar(x_px=20, y_px=y, longest_px=min(0.15 * width, 220.0), size=size)
    x = 20 + round(min(0.15 * width, 220.0)) + 90
    entries = [("start", None), *legend]
    for name, colour in entries:
        needed = 42 + text_width(name, size=size) + 24
        if x + needed > width - 20:
            break
        if colour is None:
            tone = legend[0][1]
            cv2.circle(image, (x + 16, y), 8, tone, cv2.FILLED, cv2.LINE_AA)
            cv2.circle(image, (x + 16, y), 5, FLOOR, cv2.FILLED, cv2.LINE_AA)
        elif colour == LANDMARK:
            cv2.ellipse(image, (x + 16, y), (11, 7), 20.0, 0.0, 360.0, colour, 2, cv2.LINE_AA)
            cv2.circle(image, (x + 16, y), 3, colour, cv2.FILLED, cv2.LINE_AA)
        else:
            cv2.line(image, (x, y), (x + 32, y), colour, 4, cv2.LINE_AA)
        put_text(image, name, (x + 42, y + 6), INK, size=size)
        x += needed
    for text in (title, title.partition(_TITLE_GAP)[0]):
        left = width - 20 - text_width(text, size=size)
        if left > x:
            put_text(image, text, (left, y + 6), INK, size=size)
            break


def _blank(view: View) -> Image:
    image = np.empty((view.height + _FOOTER_PX, view.width, 3), np.uint8)
    image[:] = PAGE
    return image
