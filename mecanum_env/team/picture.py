"""A frame of a team: the true plan with all robots, beside what each of them has mapped."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from mecanum_env.views.canvas import FLOOR, WALL, Canvas, Colour, View
from mecanum_env.views.paint import UNSEEN, extent_of_truth, paint_plan, thinned, with_margin
from mecanum_env.views.render import blank_frame, panels, view_of_truth, write_backend, write_readouts
from slam.geometry import compose, inverse, transform_points
from slam.grids.occupancy import FREE, OCCUPIED, OccupancyGrid
from slam.types import Array, Bytes

if TYPE_CHECKING:
    from mecanum_env.team.team import Team

__all__ = ["COLOURS", "colour_of", "draw_maps", "render_team"]

Image = Bytes

COLOURS = (
    (180, 119, 31), (14, 127, 255), (44, 160, 44), (40, 39, 214), (189, 103, 148), (75, 86, 140), (194, 119, 227),
    (34, 189, 188),
)  # fmt: skip
"""Of the first eight robots, blue, green, red: Matplotlib's."""

_SHADES = ((1.0, 0.0), (0.6, 0.0), (0.5, 127.5))  # of further eights: as they are, darker, paler

_TINT = 0.45  # share of the robot's colour in what it has mapped


def colour_of(robot: int) -> Colour:
    """Return a robot's colour, blue, green, red; the first 24 have each one of their own."""
    share, more = _SHADES[robot // len(COLOURS) % len(_SHADES)]
    blue, green, red = (round(share * channel + more) for channel in COLOURS[robot % len(COLOURS)])
    return blue, green, red


def render_team(team: Team) -> Image:
    """Return truth beside maps as an RGB image ``(720, 1280, 3)``, in the frame of the first robot's start.

    Left: the plan, the robots and their true ways. Right: what is mapped, in the colour of whose map it is on;
    where several have it, in all of theirs.
    """
    ground = team.ground
    view, frame = view_of_truth(ground), blank_frame("Maps")
    left, right = (Canvas(panel, view) for panel in panels(frame))
    paint_plan(left, ground.plan, inverse(ground.start))
    for member, placed in zip(team.members, team.frames, strict=True):
        colour = colour_of(member.number)
        record = member.truth.record
        left.line(thinned(transform_points(placed, record.true_poses[:, :2]), view), colour, px=2)
        left.robot(compose(placed, member.truth.pose), member.config.robot, colour)
    _paint_believed(right, team)
    _write(frame, team)
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)


def draw_maps(team: Team, *, longest_px: int) -> Image:
    """Return what is mapped, as on the right of :func:`render_team`: blue, green, red ``(h, w, 3)``."""
    view = View.around(with_margin(extent_of_truth(team.ground)), longest_px=longest_px)
    image = np.empty((view.height, view.width, 3), np.uint8)
    _paint_believed(Canvas(image, view), team)
    return image


def _paint_believed(canvas: Canvas, team: Team) -> None:
    """Paint the robots' maps, and where each believes that it is and was."""
    frames = team.frames
    _paint_maps(canvas, [member.backend.grid for member in team.members], frames)
    for member, placed in zip(team.members, frames, strict=True):
        colour = colour_of(member.number)
        path = transform_points(placed, member.truth.record.estimates[:, :2])
        canvas.line(thinned(path, canvas.view), colour, px=2)
        canvas.robot(compose(placed, member.backend.pose), member.config.robot, colour)


def _paint_maps(canvas: Canvas, grids: list[OccupancyGrid], frames: list[Array]) -> None:
    """Paint each robot's free cells in its colour, and every wall."""
    view = canvas.view
    shape = (view.height, view.width)
    tints, seen = np.zeros((*shape, 3)), np.zeros(shape)
    walls = np.zeros(shape, np.bool_)
    for number, (grid, placed) in enumerate(zip(grids, frames, strict=True)):
        classes = grid.classes()
        matrix = view.raster_matrix(grid.resolution, grid.origin, placed)
        free, occupied = (
            cv2.warpAffine((classes == what).astype(np.uint8), matrix, shape[::-1], flags=cv2.INTER_NEAREST) > 0
            for what in (FREE, OCCUPIED)
        )
        tints[free] += colour_of(number)
        seen += free
        walls |= occupied
    known = seen > 0
    canvas.image[:] = UNSEEN
    mean = tints[known] / seen[known][:, None]
    canvas.image[known] = np.round(_TINT * mean + (1.0 - _TINT) * np.array(FLOOR)).astype(np.uint8)
    canvas.image[walls] = WALL


def _write(frame: Image, team: Team) -> None:
    write_backend(frame, "Maps", team.config.slam)
    coverage = team.coverage_share
    collisions = sum(member.truth.world.collisions for member in team.members)
    entries = (
        ("time", f"{team.time_s:.1f} s", 0),
        ("coverage", f"{100.0 * coverage:.1f} %", 163),
        ("robots", f"{len(team.members)}", 352),
        ("collisions", f"{collisions}", 470),
        ("communication", team.team.communication.model, 632),
    )
    write_readouts(frame, entries, coverage=coverage, colour=COLOURS[0])
