"""The picture of a replay: reference, dead reckoning, estimate and landmarks, seen from above."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.views.canvas import View
from mecanum_env.views.paint import extent, with_margin
from mecanum_env.views.pictures import draw_map
from slam.belief import Belief
from slam.grids.occupancy import UNKNOWN

__all__ = ["draw_belief", "draw_replay"]

Array = NDArray[np.float64]

_SIDE, _BORDER, _FOOT = 1000, 30, 60  # px
_COLOURS = {  # BGR, told apart by the colour-blind, too (Okabe and Ito)
    "reference": (0, 0, 0), "odometry": (0, 159, 230), "estimate": (178, 114, 0), "landmarks": (0, 94, 213),
}  # fmt: skip
_FRACTION_BITS = 4


def draw_replay(
    *, reference: Array, reckoned: Array, estimate: Array, landmarks: Array, surveyed: Array, title: str
) -> NDArray[np.uint8]:
    """Draw a replay, north up, to one scale.

    Parameters
    ----------
    reference, reckoned, estimate : (n, ≥ 2)
        Trajectories [m]; each may be empty, and broken by rows of nan. The picture covers reference, estimate
        and landmarks; dead reckoning may leave it.
    landmarks, surveyed : (n, 2), (m, 2)
        Estimated places, drawn as dots, and true ones, as circles [m]; rows with nan are left out.
    title : str
        Written below, with the length of a scale bar.

    Returns
    -------
    picture (rows, cols, 3) uint8, BGR.
    """
    surveyed = surveyed[np.isfinite(surveyed).all(axis=1)]
    shown = np.vstack([p[:, :2] for p in (reference, estimate, landmarks, surveyed)] + [np.zeros((0, 2))])
    shown = shown[np.isfinite(shown).all(axis=1)]
    low, high = (shown.min(axis=0), shown.max(axis=0)) if len(shown) else (np.zeros(2), np.ones(2))
    span = float(max(*(high - low), 1.0))
    scale = (_SIDE - 2 * _BORDER) / span
    width, height = (int(v) for v in np.ceil((high - low) * scale) + 2 * _BORDER)
    width = max(width, _SIDE // 2)  # room for the writing
    picture: NDArray[np.uint8] = np.full((height + _FOOT, width, 3), 255, np.uint8)

    def pixels(points: Array) -> NDArray[np.int32]:
        flat: Array = np.column_stack([points[:, 0] - low[0], high[1] - points[:, 1]]) * scale + _BORDER
        # Far outside, OpenCV's fixed-point coordinates would overflow.
        fixed: NDArray[np.int32] = np.clip(np.round(flat * 2**_FRACTION_BITS), -(2**20), 2**20).astype(np.int32)
        return fixed

    for name, path in (("odometry", reckoned), ("reference", reference), ("estimate", estimate)):
        drawn = np.isfinite(path[:, :2]).all(axis=1)
        pieces = np.split(path[drawn, :2], np.cumsum(drawn)[~drawn])
        points = [pixels(piece).reshape(-1, 1, 2) for piece in pieces if len(piece)]
        cv2.polylines(picture, points, False, _COLOURS[name], 1, cv2.LINE_AA, _FRACTION_BITS)
    for place, radius, thickness in ((surveyed, 7, 1), (landmarks, 3, cv2.FILLED)):
        for x, y in pixels(place).tolist():
            centre, size = (x, y), radius << _FRACTION_BITS
            cv2.circle(picture, centre, size, _COLOURS["landmarks"], thickness, cv2.LINE_AA, _FRACTION_BITS)
    _write_foot(picture, height, scale, span, title)
    return picture


def draw_belief(belief: Belief, estimate: Array, title: str, *, longest_px: int = 1600) -> NDArray[np.uint8]:
    """Draw the map at the end of a replay, as far as it is known, with the path ``(n ≥ 1, ≥ 2)`` on it."""
    grid = belief.grid
    known = extent(grid.classes() != UNKNOWN, grid.resolution, grid.origin)
    x, y = belief.pose[:2].tolist()
    view = View.around(with_margin(known or (x - 1.0, y - 1.0, x + 1.0, y + 1.0)), longest_px=longest_px)
    return draw_map(belief, estimate, view=view, title=title)


def _write_foot(picture: NDArray[np.uint8], top: int, scale: float, span: float, title: str) -> None:
    picture[top:] = 255  # dead reckoning may have run over it
    bar_m = 10.0 ** math.floor(math.log10(span / 2.0))
    end = _BORDER + round(bar_m * scale)
    cv2.line(picture, (_BORDER, top + 8), (end, top + 8), (0, 0, 0), 2)
    cv2.putText(picture, f"{bar_m:g} m", (end + 8, top + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1)
    x = _BORDER
    for name, colour in _COLOURS.items():
        cv2.putText(picture, name, (x, top + 32), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
        x += 95
    plain = title.encode("ascii", "replace").decode()  # the font has no more
    cv2.putText(picture, plain, (_BORDER, top + 51), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
