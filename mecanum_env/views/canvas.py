"""Drawing in metres: a view of the plane, and antialiased primitives on it. Colours are blue, green, red."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.config import RobotConfig
from mecanum_env.physics.robot import wheel_positions
from slam.geometry import transform_points
from slam.types import Array, Bytes

__all__ = [
    "FLOOR", "FURNITURE", "FURNITURE_EDGE", "INK", "PAGE", "ROBOT", "WALL", "Canvas", "View", "put_text",
    "text_width",
]  # fmt: skip

Image = Bytes
Colour = tuple[int, int, int]

PAGE: Colour = (244, 246, 247)
FLOOR: Colour = (255, 255, 255)
WALL: Colour = (74, 62, 54)
FURNITURE: Colour = (176, 205, 224)
FURNITURE_EDGE: Colour = (96, 134, 158)
ROBOT: Colour = (42, 92, 222)
INK: Colour = (110, 100, 92)

_SHIFT = 4  # OpenCV's fixed-point fraction bits: antialiased to 1/16 pixel
_SPELT = str.maketrans({"·": "-", "–": "-", "…": "...", "σ": "sigma", "²": "2", "×": "x"})
_TYRE_SHARE = 0.22  # width of a drawn wheel over the robot's width


@dataclass(frozen=True)
class View:
    """A rectangle of the plane and the pixels it is drawn on, y upwards."""

    left: float  # x of the image's left edge [m]
    top: float  # y of its top edge [m]
    scale: float  # pixels per metre
    width: int  # [pixels]
    height: int  # [pixels]

    @classmethod
    def fit(cls, bounds: tuple[float, float, float, float], width: int, height: int) -> View:
        """Return the view of ``width`` × ``height`` pixels that shows x_min, y_min, x_max, y_max, centred."""
        x0, y0, x1, y1 = bounds
        scale = min(width / max(x1 - x0, 1e-6), height / max(y1 - y0, 1e-6))
        left, top = 0.5 * (x0 + x1) - 0.5 * width / scale, 0.5 * (y0 + y1) + 0.5 * height / scale
        return cls(left, top, scale, width, height)

    @classmethod
    def around(
        cls, bounds: tuple[float, float, float, float], *, longest_px: int, max_scale: float = 150.0
    ) -> View:
        """Return the view whose longer side has ``longest_px`` pixels, or fewer where that is too close up."""
        x0, y0, x1, y1 = bounds
        scale = min(longest_px / max(x1 - x0, y1 - y0, 1e-6), max_scale)
        width, height = (max(math.ceil(v * scale), 1) for v in (x1 - x0, y1 - y0))
        return cls.fit(bounds, width, height)

    def pixels(self, points: Array) -> NDArray[np.int32]:
        """Return the fixed-point pixel positions of points ``(n, 2)`` [m]."""
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        # A pixel's centre, not its corner, has whole coordinates. The limit keeps OpenCV's integers from
        # overflowing where a belief has gone astray.
        pixel = np.stack([points[:, 0] - self.left, self.top - points[:, 1]], axis=1) * self.scale - 0.5
        return np.round(np.clip(pixel, -1e5, 1e5) * (1 << _SHIFT)).astype(np.int32)

    def raster_matrix(self, resolution: float, origin: tuple[float, float], frame: Array | None = None) -> Array:
        """Return the affine map ``(2, 3)`` from a raster's (column, row) to pixels.

        ``origin`` is the lower-left corner of cell (0, 0); ``frame``, where given, is the pose ``(3,)`` of the
        raster's frame in the view's.
        """
        x, y, theta = (0.0, 0.0, 0.0) if frame is None else (float(v) for v in frame)
        turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
        first = turn @ (np.asarray(origin) + 0.5 * resolution) + (x, y)
        flip = np.array([[self.scale, 0.0], [0.0, -self.scale]])
        offset = np.array([-self.left * self.scale - 0.5, self.top * self.scale - 0.5])
        return np.column_stack([flip @ turn * resolution, flip @ first + offset])


class Canvas:
    """An image ``(h, w, 3)``, drawn on in place, in the metres of a view."""

    def __init__(self, image: Image, view: View) -> None:
        self.image = image
        self.view = view

    def width(self, metres: float, least: int = 1) -> int:
        """Return a line width [pixels]."""
        return max(least, round(metres * self.view.scale))

    def fill(self, polygons: Sequence[Array], colour: Colour) -> None:
        """Fill polygons ``(k, 2)``; where they overlap an even number of times stays as it is."""
        points = [self.view.pixels(p) for p in polygons if len(p)]
        if points:
            cv2.fillPoly(self.image, points, colour, cv2.LINE_AA, shift=_SHIFT)

    def line(self, points: Array, colour: Colour, *, px: int = 1, closed: bool = False) -> None:
        """Draw a polyline through points ``(n, 2)``."""
        if len(points):
            cv2.polylines(self.image, [self.view.pixels(points)], closed, colour, px, cv2.LINE_AA, shift=_SHIFT)

    def segments(self, ends: Array, colour: Colour) -> None:
        """Draw many segments ``(n, 4)``: x1, y1, x2, y2."""
        pairs = list(self.view.pixels(ends.reshape(-1, 2)).reshape(-1, 2, 2))
        cv2.polylines(self.image, pairs, False, colour, 1, cv2.LINE_AA, shift=_SHIFT)

    def dots(self, points: Array, colour: Colour, *, px: float) -> None:
        """Draw a disc of a radius in pixels at each point ``(n, 2)``."""
        radius = round(px * (1 << _SHIFT))
        for centre in self.view.pixels(points).tolist():
            cv2.circle(self.image, centre, radius, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def squares(self, points: Array, colour: Colour, *, px: int) -> None:
        """Set a square of pixels at each of many points ``(n, 2)``: quick, and not antialiased."""
        # The square's middle, from its first pixel.
        centre = self.view.pixels(points) / (1 << _SHIFT) - 0.5 * (px - 1)
        col, row = np.round(centre).astype(np.int64).T
        height, width = self.image.shape[:2]
        inside = (col >= 0) & (row >= 0) & (col <= width - px) & (row <= height - px)
        for i in range(px):
            for j in range(px):
                self.image[row[inside] + i, col[inside] + j] = colour

    def bands(self, segments: Array, colour: Colour, width_m: float) -> None:
        """Draw segments ``(n, 4)`` this wide to either side and beyond either end: corners come out square."""
        along = segments[:, 2:] - segments[:, :2]
        length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
        ahead = along / length * width_m
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        a, b = segments[:, :2] - ahead, segments[:, 2:] + ahead
        outlines = np.stack([a - left, b - left, b + left, a + left], axis=1)
        for outline in self.view.pixels(outlines.reshape(-1, 2)).reshape(-1, 4, 2):
            cv2.fillConvexPoly(self.image, outline, colour, cv2.LINE_AA, shift=_SHIFT)

    def ellipses(
        self, means: Array, covs: Array, colour: Colour, *, sigmas: float = 3.0, least_px: float = 0.0, px: int = 1
    ) -> None:
        """Draw covariance ellipses of means ``(n, 2)`` and covariances ``(n, 2, 2)`` [m²]."""
        if not len(means):
            return
        values, vectors = np.linalg.eigh(covs)
        axes = np.maximum(sigmas * np.sqrt(np.maximum(values, 0.0)), least_px / self.view.scale)
        angles = np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False)
        circle = np.stack([np.cos(angles), np.sin(angles)])
        rims = means[:, None] + np.einsum("nij,nj,jk->nki", vectors, axes, circle)
        points = list(self.view.pixels(rims.reshape(-1, 2)).reshape(len(means), -1, 2))
        cv2.polylines(self.image, points, True, colour, px, cv2.LINE_AA, shift=_SHIFT)

    def robot(self, pose: Array, robot: RobotConfig, colour: Colour) -> None:
        """Draw the robot's outline, wheels and heading at a pose ``(3,)``."""
        a, b = 0.5 * robot.length_m, 0.5 * robot.width_m
        tyre = 0.5 * _TYRE_SHARE * robot.width_m
        for x, y in wheel_positions(robot):
            # Drawn flush with the body's sides, where they can be seen.
            out = math.copysign(max(abs(y), b - 0.4 * tyre), y)
            self.fill([transform_points(pose, _rectangle(x, out, robot.wheel_radius_m * 1.4, tyre))], WALL)
        self.fill([transform_points(pose, _rectangle(0.0, 0.0, a, b))], colour)
        arrow = np.array([(-0.5 * a, 0.6 * b), (0.75 * a, 0.0), (-0.5 * a, -0.6 * b), (-0.2 * a, 0.0)])
        self.fill([transform_points(pose, arrow)], FLOOR)

    def scale_bar(self, *, x_px: int, y_px: int, longest_px: float, size: float = 15.0) -> None:
        """Draw a bar of a round number of metres, no longer than ``longest_px``, with its length beside it."""
        metres = _round_length(longest_px / self.view.scale)
        length = round(metres * self.view.scale)
        half = round(0.3 * size)
        self.image[y_px - 1 : y_px + 1, x_px : x_px + length] = INK
        for x in (x_px, x_px + length - 2):
            self.image[y_px - half : y_px + half, x : x + 2] = INK
        label = f"{metres:g} m"
        put_text(self.image, label, (x_px + length + round(0.6 * size), y_px + round(0.33 * size)), INK, size=size)


def put_text(
    image: Image, text: str, at: tuple[int, int], colour: Colour, *, size: float = 16.0, bold: bool = False
) -> None:
    """Write text with its baseline's left end ``at`` (x, y), letters about ``size`` pixels high."""
    font = _font()
    if font is None:
        width = 2 if bold else 1
        cv2.putText(image, _ascii(text), at, cv2.FONT_HERSHEY_SIMPLEX, _hershey(size), colour, width, cv2.LINE_AA)
    else:
        cv2.putText(image, text, at, colour, font, round(size), 700 if bold else 400)


def text_width(text: str, *, size: float = 16.0, bold: bool = False) -> int:
    """Return how wide :func:`put_text` writes a text [pixels]."""
    font = _font()
    if font is None:
        (width, _), _ = cv2.getTextSize(_ascii(text), cv2.FONT_HERSHEY_SIMPLEX, _hershey(size), 2 if bold else 1)
        return int(width)
    size_px = cv2.getTextSize((4096, 4096), text, (0, 0), font, round(size), 700 if bold else 400)
    return int(size_px[2])


@cache
def _font() -> Any:
    """Return OpenCV 5's sans serif, or None before that: then its plotter font has to do."""
    made = getattr(cv2, "FontFace", None)
    return made("sans") if made is not None else None


def _ascii(text: str) -> str:
    """Return a text in the letters that the plotter font has, one question mark for each other one."""
    return text.translate(_SPELT).encode("ascii", "replace").decode()


def _hershey(size: float) -> float:
    return size / 32.0


def _rectangle(x: float, y: float, half_length: float, half_width: float) -> Array:
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    return corners * (half_length, half_width) + (x, y)


def _round_length(longest_m: float) -> float:
    """Return the greatest of 1, 2, 5, 10, 20, … (or 0.5, 0.2, …) that is no longer."""
    power = 10.0 ** math.floor(math.log10(longest_m))
    return float(max(f for f in (1.0, 2.0, 5.0) if f * power <= longest_m * (1 + 1e-9)) * power)
