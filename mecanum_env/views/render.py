"""A frame of video: truth beside belief.

Everything is drawn in the start frame, which is the belief's, so that pictures can be laid beside each other.
Inside, colours are blue, green, red, as everywhere in OpenCV; the frame that is handed out is RGB.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from mecanum_env.config import EnvConfig
from mecanum_env.ground_truth import GroundTruth
from mecanum_env.views.canvas import FLOOR, INK, PAGE, ROBOT, WALL, Canvas, Colour, View, put_text, text_width
from mecanum_env.views.paint import (
    BEAM,
    BELIEVED_PATH,
    FRONTIER,
    LANDMARK,
    PLANNED_PATH,
    SIGMAS,
    TRUE_PATH,
    UNSEEN,
    extent_of_truth,
    paint_landmarks,
    paint_plan,
    thinned,
    with_margin,
)
from slam.belief import Belief
from slam.geometry import compose, inverse, transform_points
from slam.grids.occupancy import FREE, PROBABILITY_BYTE, OccupancyGrid
from slam.types import Array, Bytes, Flags, Scan

__all__ = [
    "FRAME_SHAPE", "Shown", "blank_frame", "frontier_cells", "panels", "render_frame", "view_of_truth",
    "write_backend", "write_readouts",
]  # fmt: skip

Image = Bytes

FRAME_SHAPE = (720, 1280)
"""Height and width of a video frame [pixels]."""

# A frame: two panels side by side, titles above, a caption below.
_PANEL = (620, 624)  # width, height
_LEFT, _RIGHT, _TOP = 14, 646, 44
_LEAST_FRONTIER = 5  # cells; smaller specks are noise at the rim of what was seen

_FIXED: WeakKeyDictionary[GroundTruth, tuple[View, Image]] = WeakKeyDictionary()


class Shown(Protocol):
    """What a frame is made of: an environment after ``reset``, or a moment put together from one."""

    @property
    def config(self) -> EnvConfig:
        """The environment's configuration."""

    @property
    def belief(self) -> Belief:
        """What the robot knows."""

    @property
    def truth(self) -> Any:
        """A :class:`mecanum_env.episode.Truth`, or what has its ``ground``, ``record``, ``pose`` and ``scan``."""


def _colours() -> Image:
    """Return what each probability × 255 of a cell looks like ``(256, 1, 3)``: white, grey where unsure, dark."""
    p = np.arange(256) / 255.0
    shades = [np.interp(p, (0.3, 0.5, 0.75), tones) for tones in zip(FLOOR, UNSEEN, WALL, strict=True)]
    return np.round(np.stack(shades, axis=1)).astype(np.uint8)[:, None]


_COLOURS = _colours()


def render_frame(env: Shown, *, planned_path: Array | None = None) -> Image:
    """Return truth beside belief as an RGB image ``(720, 1280, 3)``.

    Left: the true plan, the robot, where it really drove, and the scan. Right: the belief's grid with frontier
    cells, landmarks and pose with their 3σ ellipses, and the believed path. Both in the start frame, to the
    same scale, which stays for the episode.

    Parameters
    ----------
    env : ExploreEnv
        After ``reset``; or a moment of one.
    planned_path : (n, 2) array, optional
        The way an agent means to go [m]; by default the environment's attribute ``planned_path``, if it has one.
    """
    ground, record = env.truth.ground, env.truth.record
    view, template = _fixed_parts(ground)
    if planned_path is None:
        planned_path = getattr(env, "planned_path", None)
    frame = template.copy()
    left, right = panels(frame)
    robot, pose = env.config.robot, env.truth.pose
    true_poses, estimates, belief = record.true_poses, record.estimates, env.belief

    canvas = Canvas(left, view)
    _paint_scan(canvas, env.truth.scan, compose(pose, np.array([env.config.lidar.offset_m, 0.0, 0.0])))
    canvas.line(thinned(true_poses, view), TRUE_PATH, px=2)
    canvas.robot(pose, robot, ROBOT)

    canvas = Canvas(right, view)
    _paint_grid(canvas, belief.grid)
    paint_landmarks(canvas, belief, dot_px=2.0)
    canvas.line(thinned(estimates, view), BELIEVED_PATH, px=2)
    if planned_path is not None and len(planned_path):
        way = np.asarray(planned_path, np.float64)[:, :2]
        canvas.line(thinned(way, view), PLANNED_PATH, px=2)
        canvas.dots(way[-1:], PLANNED_PATH, px=4.0)
    canvas.robot(belief.pose, robot, BELIEVED_PATH)
    canvas.ellipses(
        belief.pose[None, :2], belief.pose_cov[None, :2, :2], LANDMARK, sigmas=SIGMAS, least_px=1.0, px=2
    )
    error = float(np.hypot(*(true_poses[-1, :2] - estimates[-1, :2])))
    # The longer half axis of the ellipse that is drawn.
    bound = SIGMAS * math.sqrt(max(float(np.linalg.eigvalsh(belief.pose_cov[:2, :2])[-1]), 0.0))
    _write_caption(
        frame, env, coverage=float(record.coverage[-1]), time_s=float(record.times[-1]),
        error=f"{100.0 * error:.1f} cm, {SIGMAS:g}σ {100.0 * bound:.1f} cm",
    )  # fmt: skip
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)


def frontier_cells(grid: OccupancyGrid) -> Flags:
    """Return ``(rows, cols)``: free cells beside cells never observed, in pieces of some size (for drawing)."""
    free = (grid.classes() == FREE).astype(np.uint8)
    unseen = cv2.dilate((grid.log_odds == 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    edge = free & unseen
    _, labels, stats, _ = cv2.connectedComponentsWithStats(edge, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_FRONTIER
    large[0] = False
    return np.asarray(large[labels], np.bool_)


def _fixed_parts(ground: GroundTruth) -> tuple[View, Image]:
    """Return the view of an episode's frames and a frame of what never changes in it."""
    if ground not in _FIXED:
        view, frame = view_of_truth(ground), blank_frame("Belief")
        paint_plan(Canvas(panels(frame)[0], view), ground.plan, inverse(ground.start))
        x = _RIGHT + _PANEL[0]
        for name, colour in (("landmark, 3σ", LANDMARK), ("frontier", FRONTIER), ("way ahead", PLANNED_PATH)):
            x -= text_width(name, size=15)
            put_text(frame, name, (x, 29), INK, size=15)
            x -= 20
            frame[19:29, x : x + 12] = colour
            x -= 18
        _FIXED[ground] = (view, frame)
    return _FIXED[ground]


def view_of_truth(ground: GroundTruth) -> View:
    """Return the view that shows all that can be mapped in a panel."""
    return View.fit(with_margin(extent_of_truth(ground)), *_PANEL)


def blank_frame(right: str) -> Image:
    """Return a frame with nothing but its titles, of which the right one is given."""
    frame = np.empty((*FRAME_SHAPE, 3), np.uint8)
    frame[:] = PAGE
    put_text(frame, "World", (_LEFT, 30), INK, size=19, bold=True)
    put_text(frame, right, (_RIGHT, 30), INK, size=19, bold=True)
    return frame


def panels(frame: Image) -> tuple[Image, Image]:
    """Return a frame's left and right panel, to be drawn on."""
    width, height = _PANEL
    rows = frame[_TOP : _TOP + height]
    return rows[:, _LEFT : _LEFT + width], rows[:, _RIGHT : _RIGHT + width]


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
    cv2.addWeighted(over, 0.25, canvas.image, 0.75, 0.0, dst=canvas.image)
    np.copyto(over, canvas.image)
    sensor = np.broadcast_to(sensor_pose[:2], ends[::6].shape)
    tinted.segments(np.hstack([sensor, ends[::6]]), BEAM)
    cv2.addWeighted(over, 0.4, canvas.image, 0.6, 0.0, dst=canvas.image)
    canvas.squares(ends[np.isfinite(scan.ranges[known])], TRUE_PATH, px=2)


def _paint_grid(canvas: Canvas, grid: OccupancyGrid) -> None:
    """Paint each cell's probability, and the frontier cells."""
    shades = PROBABILITY_BYTE[grid.log_odds.view(np.uint8)]
    view = canvas.view
    matrix = view.raster_matrix(grid.resolution, grid.origin)
    unseen = int(PROBABILITY_BYTE[0])
    warped = cv2.warpAffine(shades, matrix, (view.width, view.height), borderValue=unseen)
    canvas.image[:] = cv2.applyColorMap(warped, _COLOURS)
    cells = grid.to_points(np.argwhere(frontier_cells(grid)))
    canvas.squares(cells, FRONTIER, px=max(2, math.ceil(grid.resolution * view.scale)))


def _write_caption(frame: Image, env: Shown, *, coverage: float, time_s: float, error: str) -> None:
    write_backend(frame, "Belief", env.config.slam)
    entries = (
        ("time", f"{time_s:.1f} s", 0),
        ("coverage", f"{100.0 * coverage:.1f} %", 163),
        ("path", f"{env.truth.record.path_length_m:.1f} m", 352),
        ("collisions", f"{env.truth.record.collisions}", 505),
        ("position error", error, 632),
        ("landmarks", f"{len(env.belief.landmarks)}", 1100),
    )
    write_readouts(frame, entries, coverage=coverage, colour=TRUE_PATH)


def write_backend(frame: Image, title: str, name: str) -> None:
    """Write the backend's name beside the title of a frame's right panel."""
    put_text(frame, name, (_RIGHT + text_width(title, size=19, bold=True) + 12, 30), INK, size=17)


def write_readouts(
    frame: Image, entries: Iterable[tuple[str, str, int]], *, coverage: float, colour: Colour
) -> None:
    """Write names and values below a frame's panels, each from its x [pixels] on, and a bar of the coverage."""
    height, width = FRAME_SHAPE
    for name, value, x in entries:
        put_text(frame, name, (_LEFT + x, height - 24), INK, size=17)
        at = _LEFT + x + text_width(name, size=17) + 9
        put_text(frame, value, (at, height - 24), WALL, size=17, bold=True)
    frame[height - 8 :] = UNSEEN
    frame[height - 8 :, : round(width * min(max(coverage, 0.0), 1.0))] = colour
