"""Pictures of an episode: truth beside belief for video, and the two as large pictures of the end.

Everything is drawn in the start frame, which is the belief's, so that pictures can be laid beside each other.
Colours are blue, green, red as :func:`cv2.imwrite` takes them, except where a function says RGB.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.canvas import Canvas, Colour, View, blend, put_text, text_width
from mecanum_env.config import RobotConfig
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.rooms.draw import FLOOR, FURNITURE, FURNITURE_EDGE, INK, PAGE, ROBOT, WALL, _loops
from mecanum_env.rooms.floor_plan import FloorPlan
from slam.geometry import compose, inverse, transform_points
from slam.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.types import Belief, Scan

if TYPE_CHECKING:
    from mecanum_env.env import ExploreEnv

__all__ = ["draw_map", "draw_truth", "episode_view", "frontier_cells", "render_frame"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FRAME_SHAPE = (720, 1280)
"""Height and width of a video frame [pixels]."""

UNSEEN: Colour = (228, 225, 222)
TRUE_PATH: Colour = (112, 140, 22)
BELIEVED_PATH: Colour = (205, 96, 44)
PLANNED_PATH: Colour = (42, 92, 222)
FRONTIER: Colour = (20, 160, 248)
LANDMARK: Colour = (128, 38, 178)
BEAM: Colour = (214, 196, 92)

_SIGMAS = 3.0  # of every covariance ellipse
_WALL_M = 0.22  # how deep solid matter is drawn behind its surface
_MARGIN_M = 0.5
_PATH_POINTS = 1500  # a longer path is thinned out before it is drawn
_LEAST_FRONTIER = 5  # cells; smaller specks are noise at the rim of what was seen
_FOOTER_PX = 64

# A frame: two panels side by side, titles above, a caption below.
_PANEL = (620, 624)  # width, height
_LEFT, _RIGHT, _TOP = 14, 646, 44

_FIXED: WeakKeyDictionary[GroundTruth, tuple[View, Image]] = WeakKeyDictionary()

# What a byte of log-odds looks like: white where free, dark where occupied, grey between.
_P = 1.0 / (1.0 + np.exp(-0.05 * np.arange(256, dtype=np.uint8).view(np.int8).astype(np.float64)))
_SHADES = np.empty((256, 3))
for _channel in range(3):
    _SHADES[:, _channel] = np.interp(
        _P, (0.3, 0.5, 0.75), (FLOOR[_channel], UNSEEN[_channel], WALL[_channel])
    )
_LOOK_UP = np.round(_SHADES).astype(np.uint8)


# ---- a video frame ---------------------------------------------------------------------------------------------


def render_frame(env: ExploreEnv, *, planned_path: Array | None = None) -> Image:
    """Return truth beside belief as an RGB image ``(720, 1280, 3)``.

    Left: the true plan, the robot, where it really drove, and the scan. Right: the belief's grid with frontier
    cells, landmarks and pose with their 3σ ellipses, and the believed path. Both in the start frame, to the
    same scale, which stays for the episode.

    Parameters
    ----------
    env : ExploreEnv
        After ``reset``.
    planned_path : (n, 2) array, optional
        The way an agent means to go [m]; by default the environment's attribute ``planned_path``, if it has one.
    """
    ground, record = env.truth.ground, env.truth.record
    view, plan_image = _fixed_parts(ground)
    if planned_path is None:
        planned_path = getattr(env, "planned_path", None)
    frame = np.empty((*FRAME_SHAPE, 3), np.uint8)
    frame[:] = PAGE
    width, height = _PANEL
    left = frame[_TOP : _TOP + height, _LEFT : _LEFT + width]
    right = frame[_TOP : _TOP + height, _RIGHT : _RIGHT + width]
    left[:] = plan_image
    robot, pose = env.config.robot, env.truth.pose
    true_poses, estimates, belief = record.true_poses, record.estimates, env.belief

    canvas = Canvas(left, view)
    _paint_scan(canvas, env.truth.scan, compose(pose, np.array([env.config.lidar.offset_m, 0.0, 0.0])))
    canvas.line(_thinned(true_poses), TRUE_PATH, px=2)
    canvas.robot(pose, robot, ROBOT)

    canvas = Canvas(right, view)
    _paint_grid(canvas, belief.grid)
    _paint_landmarks(canvas, belief, dot_px=2.0)
    canvas.line(_thinned(estimates), BELIEVED_PATH, px=2)
    if planned_path is not None and len(planned_path):
        way = np.asarray(planned_path, np.float64)[:, :2]
        canvas.line(way, PLANNED_PATH, px=1)
        canvas.dot(way[-1], PLANNED_PATH, px=4.0)
    canvas.robot(belief.pose, robot, BELIEVED_PATH, wheels=False)
    canvas.ellipses(
        belief.pose[None, :2], belief.pose_cov[None, :2, :2], LANDMARK, sigmas=_SIGMAS, least_px=1.0, px=2
    )
    error = float(np.hypot(*(true_poses[-1, :2] - estimates[-1, :2])))
    _write_caption(frame, env, coverage=float(record.coverage[-1]), time_s=float(record.times[-1]), error=error)
    return np.ascontiguousarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)


def frontier_cells(grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Return ``(rows, cols)``: free cells beside cells never observed, in pieces of some size (for drawing)."""
    free = (grid.classes() == FREE).astype(np.uint8)
    unseen = cv2.dilate((grid.log_odds == 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    edge = free & unseen
    _, labels, stats, _ = cv2.connectedComponentsWithStats(edge, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_FRONTIER
    large[0] = False
    return np.asarray(large[labels], np.bool_)


def _fixed_parts(ground: GroundTruth) -> tuple[View, Image]:
    """Return the view of an episode's frames and the true plan drawn in it: both stay for the episode."""
    if ground not in _FIXED:
        view = View.fit(_with_margin(_extent_of_truth(ground)), *_PANEL)
        image = np.empty((_PANEL[1], _PANEL[0], 3), np.uint8)
        _paint_plan(Canvas(image, view), ground.plan, inverse(ground.start))
        _FIXED[ground] = (view, image)
    return _FIXED[ground]


def _paint_scan(canvas: Canvas, scan: Scan, sensor_pose: Array) -> None:
    """Tint what the scan sees, with faint beams and a dot where each ended."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    known = ~np.isnan(scan.ranges)
    ranges = np.minimum(scan.ranges[known], scan.range_max)
    rays = np.stack([np.cos(angles[known]), np.sin(angles[known])], axis=1)
    ends = transform_points(sensor_pose, rays * ranges[:, None])
    if len(ends) < 3:
        return
    over = canvas.image.copy()
    tinted = Canvas(over, canvas.view)
    tinted.fill([np.vstack([sensor_pose[None, :2], ends])], BEAM)
    blend(canvas.image, over, 0.25)
    for end in ends[::6]:
        tinted.line(np.stack([sensor_pose[:2], end]), BEAM)
    blend(canvas.image, over, 0.18)
    for end in ends[np.isfinite(scan.ranges[known])]:
        canvas.dot(end, TRUE_PATH, px=1.2)


def _paint_grid(canvas: Canvas, grid: OccupancyGrid) -> None:
    cells = _LOOK_UP[grid.log_odds.view(np.uint8)]
    cells[frontier_cells(grid)] = FRONTIER
    _warp(canvas, cells, canvas.view.raster_matrix(grid.resolution, grid.origin), UNSEEN)


def _write_caption(frame: Image, env: ExploreEnv, *, coverage: float, time_s: float, error: float) -> None:
    put_text(frame, "World", (_LEFT, 30), INK, size=19, bold=True)
    put_text(frame, "Belief", (_RIGHT, 30), INK, size=19, bold=True)
    at = _RIGHT + text_width("Belief", size=19, bold=True) + 12
    put_text(frame, env.config.slam, (at, 30), INK, size=17)
    height, width = FRAME_SHAPE
    y = height - 24
    entries = (
        ("time", f"{time_s:.1f} s", 0),
        ("coverage", f"{100.0 * coverage:.1f} %", 190),
        ("path", f"{env.truth.record.path_length_m:.1f} m", 420),
        ("collisions", f"{env.truth.record.collisions}", 632),
        ("position error", f"{100.0 * error:.1f} cm", 830),
        ("landmarks", f"{env.backend.landmark_count}", 1100),
    )
    for name, value, x in entries:
        put_text(frame, name, (_LEFT + x, y), INK, size=17)
        at = _LEFT + x + text_width(name, size=17) + 9
        put_text(frame, value, (at, y), WALL, size=17, bold=True)
    frame[height - 8 :] = UNSEEN
    frame[height - 8 :, : round(width * min(max(coverage, 0.0), 1.0))] = TRUE_PATH


# ---- the pictures of the end -----------------------------------------------------------------------------------


def episode_view(ground: GroundTruth, belief: Belief, *, longest_px: int = 1600) -> View:
    """Return the view that shows all that can be mapped and all that was, for both pictures of an episode."""
    boxes = [_extent_of_truth(ground)]
    grid = belief.grid
    extent = _extent(grid.classes() != UNKNOWN, grid.resolution, grid.origin)
    boxes += [extent] if extent is not None else []
    x0, y0, x1, y1 = zip(*boxes, strict=True)
    return View.around(_with_margin((min(x0), min(y0), max(x1), max(y1))), longest_px=longest_px)


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
        Written at the right below the picture.
    """
    image = _blank(view)
    canvas = Canvas(image[: view.height], view)
    canvas.image[:] = UNSEEN
    _paint_smooth_grid(canvas, belief.grid)
    _paint_path(canvas, path, BELIEVED_PATH)
    _paint_landmarks(canvas, belief, dot_px=max(2.2, 0.025 * view.scale))
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
    _paint_plan(canvas, ground.plan, inverse(ground.start))
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
    points = _thinned(path)
    width = canvas.width(0.035, least=2)
    pieces = 64
    ends = np.linspace(0, len(points) - 1, pieces + 1).astype(int)
    for k, (a, b) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        share = 0.35 + 0.65 * (k + 1) / pieces
        tone = (round(255 - share * (255 - colour[0])), round(255 - share * (255 - colour[1])),
                round(255 - share * (255 - colour[2])))  # fmt: skip
        canvas.line(points[a : b + 1], tone, px=width)
    radius = max(4.0, 0.09 * canvas.view.scale)
    canvas.dot(points[0], colour, px=radius)
    canvas.dot(points[0], FLOOR, px=0.6 * radius)


def _write_footer(image: Image, canvas: Canvas, legend: Sequence[tuple[str, Colour]], title: str) -> None:
    """Write scale bar, legend and title below the picture, as far as there is room for each."""
    height, width = image.shape[:2]
    y, size = height - _FOOTER_PX // 2, 18
    canvas_below = Canvas(image, canvas.view)
    canvas_below.scale_bar(x_px=20, y_px=y, longest_px=min(0.15 * width, 220.0), size=size)
    right = width - 20 - text_width(title, size=size)
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
    if title and right > x:
        put_text(image, title, (right, y + 6), INK, size=size)


# ---- what both share -------------------------------------------------------------------------------------------


def _paint_plan(canvas: Canvas, plan: FloorPlan, frame: Array) -> None:
    """Paint a plan whose frame has the pose ``frame`` ``(3,)`` in the view's."""

    def seen(points: Array) -> Array:
        return transform_points(frame, points)

    canvas.image[:] = PAGE
    canvas.bands(seen(plan.walls.reshape(-1, 2)).reshape(-1, 4), WALL, _WALL_M)
    loops = _loops(plan.walls)
    if loops is None:
        # Walls that do not close: the free cells themselves.
        view = canvas.view
        matrix = view.raster_matrix(plan.resolution, plan.origin, frame)
        free = cv2.warpAffine(plan.free.astype(np.float32), matrix, (view.width, view.height))
        canvas.image[free > 0.5] = FLOOR
    else:
        canvas.fill([seen(loop) for loop in loops], FLOOR)
    angles = np.linspace(0.0, 2.0 * math.pi, 64, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rims = [np.array([x, y]) + radius * circle for x, y, radius in plan.circles]
    for outline in (*plan.polygons, *rims):
        canvas.fill([seen(outline)], FURNITURE)
        canvas.line(seen(outline), FURNITURE_EDGE, px=canvas.width(0.02), closed=True)


def _paint_landmarks(canvas: Canvas, belief: Belief, *, dot_px: float) -> None:
    canvas.ellipses(
        belief.landmarks, belief.landmark_cov, LANDMARK, sigmas=_SIGMAS, least_px=dot_px, px=canvas.width(0.015)
    )
    for point in belief.landmarks:
        canvas.dot(point, LANDMARK, px=dot_px)


def _warp(canvas: Canvas, cells: Image, matrix: Array, outside: Colour) -> None:
    size = (canvas.view.width, canvas.view.height)
    canvas.image[:] = cv2.warpAffine(
        cells, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside
    )


def _blank(view: View) -> Image:
    image = np.empty((view.height + _FOOTER_PX, view.width, 3), np.uint8)
    image[:] = PAGE
    return image


def _thinned(path: Array) -> Array:
    """Return at most some 1500 positions ``(n, 2)`` of a path, both ends among them."""
    points = np.asarray(path, np.float64)[:, :2]
    stride = max(1, len(points) // _PATH_POINTS)
    return np.vstack([points[:-1:stride], points[-1:]])


def _extent_of_truth(ground: GroundTruth) -> tuple[float, float, float, float]:
    row, col = ground.lattice_origin
    origin = (col * ground.resolution, row * ground.resolution)
    return _extent(ground.mappable, ground.resolution, origin) or (-1.0, -1.0, 1.0, 1.0)


def _extent(
    mask: NDArray[np.bool_], resolution: float, origin: tuple[float, float]
) -> tuple[float, float, float, float] | None:
    """Return the box x_min, y_min, x_max, y_max [m] around the cells that are set."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    x, y = origin
    return (
        x + cols[0] * resolution, y + rows[0] * resolution,
        x + (cols[-1] + 1) * resolution, y + (rows[-1] + 1) * resolution,
    )  # fmt: skip


def _with_margin(box: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    x0, y0, x1, y1 = box
    return x0 - _MARGIN_M, y0 - _MARGIN_M, x1 + _MARGIN_M, y1 + _MARGIN_M
