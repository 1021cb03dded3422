"""The pictures of a replay: reference, dead reckoning, estimate and landmarks from above, and the map."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from mecanum_env.views.canvas import View
from mecanum_env.views.paint import extent, with_margin
from mecanum_env.views.pictures import draw_map
from slam.belief import Belief
from slam.grids.occupancy import UNKNOWN
from slam.types import Array
from training.figures.charts import COLOURS, INK, chart, label, told

__all__ = ["draw_belief", "draw_replay"]


def draw_replay(
    *, reference: Array, reckoned: Array, estimate: Array, landmarks: Array, surveyed: Array, title: str
) -> Figure:
    """Draw a replay, north up, to one scale.

    Parameters
    ----------
    reference, reckoned, estimate : (n, ≥ 2)
        Trajectories [m]; each may be empty, and broken by rows of nan. The picture covers reference, estimate
        and landmarks; dead reckoning may leave it, which is said then.
    landmarks, surveyed : (n, 2), (m, 2)
        Estimated places, drawn as dots, and true ones, as circles [m]; rows with nan are left out.
    title : str
        Written above.
    """
    surveyed = surveyed[np.isfinite(surveyed).all(axis=1)]
    figure, (axes,) = chart(size=(1000, 900))
    if len(reference):
        axes.plot(reference[:, 0], reference[:, 1], color=INK, linewidth=1, label="reference")
    axes.plot(estimate[:, 0], estimate[:, 1], color=COLOURS[0], linewidth=1, label="estimate")
    if len(surveyed):
        axes.plot(*surveyed.T, "o", color=COLOURS[1], markersize=8, fillstyle="none", label="surveyed")
    if len(landmarks):
        axes.plot(*landmarks.T, "o", color=COLOURS[1], markersize=3, label="landmarks")
    shown = axes.axis()
    x, y = reckoned[:, 0], reckoned[:, 1]
    leaves = bool(np.any((x < shown[0]) | (x > shown[1]) | (y < shown[2]) | (y > shown[3])))
    name = "odometry, which leaves the picture" if leaves else "odometry"
    axes.plot(x, y, color=COLOURS[4], linewidth=1, label=name, zorder=1)
    axes.axis(shown)
    axes.set_aspect("equal")
    label(axes, told(title), "x [m]", "y [m]")
    return figure


def draw_belief(belief: Belief, estimate: Array, title: str) -> NDArray[np.uint8]:
    """Draw the map at the end of a replay, as far as it is known, with the path ``(n ≥ 1, ≥ 2)`` on it."""
    grid = belief.grid
    known = extent(grid.classes() != UNKNOWN, grid.resolution, grid.origin)
    x, y = belief.pose[:2].tolist()
    view = View.around(with_margin(known or (x - 1.0, y - 1.0, x + 1.0, y + 1.0)), longest_px=1600)
    return draw_map(belief, estimate, view=view, title=title)
