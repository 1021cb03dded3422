"""Line charts, drawn with OpenCV: lines over a linear or logarithmic plane, a band, a legend."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mecanum_env.views.canvas import FLOOR, INK, PAGE, put_text, text_width

__all__ = ["Axis", "Line", "draw_chart", "png", "ticks"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

# Blue, green, red; told apart by those who do not see red and green apart, too (Okabe and Ito 2008).
_COLOURS: tuple[Colour, ...] = (
    (178, 114, 0), (0, 94, 213), (115, 158, 0), (167, 121, 204), (0, 159, 230), (233, 180, 86), (30, 30, 30),
)  # fmt: skip
_BAND: Colour = (222, 236, 222)
_GRID: Colour = (228, 226, 224)
_SHIFT = 4  # OpenCV's fixed-point fraction bits
_LEFT, _RIGHT, _TOP, _BOTTOM = 92, 24, 68, 62  # margins [pixels]


@dataclass(frozen=True, eq=False)
class Line:
    """One line: where it is not finite, or not positive on a logarithmic axis, it is broken."""

    name: str  # in the legend; empty: left out of it
    x: ArrayLike  # (n,)
    y: ArrayLike  # (n,)
    colour: int | None = None  # index; None: in turn
    dots: bool = False  # mark the points
    px: int = 2


@dataclass(frozen=True)
class Axis:
    """One axis of a chart."""

    label: str
    log: bool = False
    low: float | None = None  # None: from the lines
    high: float | None = None


def draw_chart(
    lines: Sequence[Line], *, title: str, x: Axis, y: Axis, band: tuple[float, float] | None = None,
    size: tuple[int, int] = (1000, 560),
) -> Image:  # fmt: skip
    """Return a chart as an image ``(h, w, 3)``, blue-green-red.

    Parameters
    ----------
    lines
        Drawn in order, the last on top.
    title
        Above the chart.
    x, y
        The axes.
    band
        Values of y between which the ground is toned, such as those of a confidence band.
    size
        Width and height [pixels].
    """
    width, height = size
    image = np.empty((height, width, 3), np.uint8)
    image[:] = PAGE
    left, right, top, bottom = _LEFT, width - _RIGHT, _TOP, height - _BOTTOM
    image[top:bottom, left:right] = FLOOR
    arrays = [(np.asarray(line.x, np.float64), np.asarray(line.y, np.float64)) for line in lines]
    x_range = _extent([a for a, _ in arrays], x)
    y_range = _extent([b for _, b in arrays] + ([np.array(band)] if band is not None else []), y)
    to_x, to_y = _scale(x, x_range, left, right), _scale(y, y_range, bottom, top)
    if band is not None:
        low, high = (int(np.clip(to_y(np.array([v]))[0], top, bottom)) for v in band)
        image[high:low, left:right] = _BAND
    _draw_grid(image, x, x_range, to_x, y, y_range, to_y, (left, right, top, bottom))
    for index, (line, (xs, ys)) in enumerate(zip(lines, arrays, strict=True)):
        colour = _COLOURS[(index if line.colour is None else line.colour) % len(_COLOURS)]
        _draw_line(image[top:bottom, left:right], to_x(xs) - left, to_y(ys) - top, colour, line)
    put_text(image, title, (left, 28), INK, size=20, bold=True)
    _centred(image, x.label, (left + right) // 2, height - 14)
    put_text(image, y.label, (left, top - 9), INK, size=15)
    ends = text_width(y.label, size=15), text_width(title, size=20, bold=True)
    _draw_legend(image, lines, right, (left + 20 + ends[0], left + 20 + ends[1]))
    return image


def png(image: Image) -> bytes:
    """Return an image as a PNG file's bytes, packed as small as they go: charts are kept in the repository."""
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())


def _extent(values: Sequence[Array], axis: Axis) -> tuple[float, float]:
    every = np.concatenate([v.ravel() for v in values]) if values else np.zeros(0)
    every = every[np.isfinite(every) & ((every > 0) | (not axis.log))]
    low, high = (float(every.min()), float(every.max())) if len(every) else (1.0, 10.0)
    if axis.log:
        pad = max((high / low) ** 0.05, 1.05)
        low, high = low / pad, high * pad
    else:
        pad = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
        low, high = low - pad, high + pad
    return low if axis.low is None else axis.low, high if axis.high is None else axis.high


def _scale(axis: Axis, limits: tuple[float, float], first: int, last: int) -> Callable[[Array], Array]:
    def transform(values: Array) -> Array:
        if not axis.log:
            return np.asarray(values, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(values > 0, np.log10(values), np.nan))

    low, high = (float(transform(np.array([v]))[0]) for v in limits)
    return lambda values: first + (transform(values) - low) / (high - low) * (last - first)


def ticks(axis: Axis, limits: tuple[float, float]) -> list[float]:
    """Return round values to mark on an axis between its limits."""
    low, high = limits
    if axis.log:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        factors = (1, 2, 5) if len(powers) <= 5 else (1,)
        every = max(1, len(powers) // 8)
        ticks = [f * 10.0**p for p in powers if (p - powers[0]) % every == 0 for f in factors]
    else:
        rough = (high - low) / 6
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(f * power for f in (1, 2, 5, 10) if f * power >= rough)
        ticks = [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    return [t for t in ticks if low <= t <= high]


def _draw_grid(
    image: Image, x: Axis, x_range: tuple[float, float], to_x: Callable[[Array], Array], y: Axis,
    y_range: tuple[float, float], to_y: Callable[[Array], Array], box: tuple[int, int, int, int],
) -> None:  # fmt: skip
    left, right, top, bottom = box
    for tick in ticks(x, x_range):
        at = round(float(to_x(np.array([tick]))[0]))
        cv2.line(image, (at, top), (at, bottom), _GRID, 1)
        _centred(image, f"{tick:g}", at, bottom + 20)
    for tick in ticks(y, y_range):
        at = round(float(to_y(np.array([tick]))[0]))
        cv2.line(image, (left, at), (right, at), _GRID, 1)
        text = f"{tick:g}"
        put_text(image, text, (left - 8 - text_width(text, size=14), at + 5), INK, size=14)
    cv2.rectangle(image, (left, top), (right, bottom), INK, 1)


def _draw_line(part: Image, x: Array, y: Array, colour: Colour, line: Line) -> None:
    """Draw on the part of the image within the axes, which cuts off what goes beyond them."""
    part_image = np.ascontiguousarray(part)
    good = np.isfinite(x) & np.isfinite(y)
    points = np.round(np.clip(np.column_stack([x, y]), -1e4, 2e4) * (1 << _SHIFT)).astype(np.float64)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    for begin, end in ends.reshape(-1, 2):
        run = points[begin:end].astype(np.int32)
        cv2.polylines(part_image, [run], False, colour, line.px, cv2.LINE_AA, shift=_SHIFT)
        if line.dots or len(run) == 1:
            for centre in run.tolist():
                cv2.circle(part_image, centre, 4 << _SHIFT, colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)
    part[:] = part_image


def _draw_legend(image: Image, lines: Sequence[Line], right: int, taken: tuple[int, int]) -> None:
    """Write the names from right to left just above the chart, then beside the title, as far as there is room.

    ``taken`` is up to where [pixels] the lower and the upper row are.
    """
    at, rows = right, [(_TOP - 14, taken[0]), (26, taken[1])]
    for index, line in reversed(list(enumerate(lines))):
        if not line.name:
            continue
        needed = text_width(line.name, size=15) + 44
        if at - needed < rows[0][1]:
            at = right
            rows = rows[1:]
            if not rows or at - needed < rows[0][1]:
                return
        at -= needed
        y = rows[0][0]
        colour = _COLOURS[(index if line.colour is None else line.colour) % len(_COLOURS)]
        cv2.line(image, (at, y), (at + 24, y), colour, 3, cv2.LINE_AA)
        put_text(image, line.name, (at + 30, y + 5), INK, size=15)


def _centred(image: Image, text: str, x: int, y: int) -> None:
    put_text(image, text, (x - text_width(text, size=14) // 2, y), INK, size=14)
