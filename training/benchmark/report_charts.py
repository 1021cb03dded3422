"""Coverage curves over many episodes, as SVG that takes its colours from the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from training.benchmark.figures import Group

__all__ = ["COLOURS", "Band", "band", "coverage_chart", "extent"]

Array = NDArray[np.float64]
Along = Literal["time_s", "path_length_m"]

COLOURS = 8
"""Colours that the page has (``--c0``, …); beyond them the lines are dashed."""

_POINTS = 96
_CURVES = {"time_s": "coverage_by_time", "path_length_m": "coverage_by_path"}
_LABELS = {"time_s": "time [s]", "path_length_m": "way [m]"}
_WIDTH, _HEIGHT = 480, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 24, 40  # margins


@dataclass(frozen=True, eq=False)
class Band:
    """Coverage of many episodes: at each x the median, and between which values the middle half lies."""

    name: str
    x: Array  # (n,) [s] or [m]
    low: Array  # (n,)
    middle: Array  # (n,)
    high: Array  # (n,)


def band(group: Group, *, name: str, along: Along, high: float) -> Band:
    """Return a group's coverage from 0 to ``high`` along time or way; after its end an episode keeps its last."""
    x = np.linspace(0.0, high, _POINTS)
    values = np.empty((len(group.rows), _POINTS))
    for out, row in zip(values, group.rows, strict=True):
        curve = getattr(row, _CURVES[along])
        share = x / max(float(row.metrics[along]), 1e-9)
        # A curve's value holds until the next one.
        out[:] = curve[np.minimum((share * (len(curve) - 1) + 1e-9).astype(np.intp), len(curve) - 1)]
    quartiles = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
    return Band(name, x, *quartiles)


def extent(groups: Sequence[Group], along: Along) -> float:
    """Return how far the curves of groups are drawn: nine in ten episodes of each end before.

    But no farther than three times where those of the quickest group do, which would be lost at the left edge.
    """
    ends = [float(np.quantile([row.metrics[along] for row in group.rows], 0.9)) for group in groups]
    return max(min(max(ends, default=1.0), 3.0 * min(ends, default=1.0)), 1e-3)


def coverage_chart(bands: Sequence[Band], *, along: Along, colours: Sequence[int]) -> str:
    """Return the chart as an ``<svg>`` element.

    Parameters
    ----------
    bands
        All over the same x.
    along
        What x is.
    colours
        Index of each band's colour, 0 … ; see :data:`COLOURS`.
    """
    last = float(bands[0].x[-1])
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    names = ", ".join(b.name for b in bands)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="Coverage against {escape(_LABELS[along])}: {escape(names)}">'
    ]
    ticks = np.asarray(MaxNLocator(7, steps=[1, 2, 5, 10]).tick_values(0.0, last))
    for tick in ticks[ticks <= last].tolist():
        at = _to_x(tick, last)
        parts.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{_TOP}" y2="{bottom}"/>')
        parts.append(f'<text class="tick" x="{at:.1f}" y="{bottom + 16}" text-anchor="middle">{tick:g}</text>')
    for share in (0.0, 0.25, 0.5, 0.75, 0.95, 1.0):
        at = _to_y(share)
        kind = "grid goal" if share == 0.95 else "grid"
        y = at + {0.95: 8, 1.0: 0}.get(share, 4)  # these two shall not touch
        parts.append(f'<line class="{kind}" x1="{_LEFT}" x2="{right}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{y:.1f}" text-anchor="end">{100 * share:g}</text>')
    for b, colour in zip(bands, colours, strict=True):
        parts.append(f'<path class="band c{colour % COLOURS}" d="{_outline(b, last)}"/>')
    for b, colour in zip(bands, colours, strict=True):
        dashed = " dashed" if colour >= COLOURS else ""
        path = _polyline(b.x, b.middle, last)
        parts.append(
            f'<path class="line c{colour % COLOURS}{dashed}" d="M{path}"><title>{escape(b.name)}</title></path>'
        )
    parts.append(f'<text class="label" x="{_LEFT}" y="{_TOP - 9}">coverage [%]</text>')
    middle = 0.5 * (_LEFT + right)
    parts.append(
        f'<text class="label" x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">{_LABELS[along]}</text>'
    )
    return "".join([*parts, "</svg>"])


def _to_x(value: float, last: float) -> float:
    return _LEFT + value / last * (_WIDTH - _RIGHT - _LEFT)


def _to_y(share: float) -> float:
    return _HEIGHT - _BOTTOM - share * (_HEIGHT - _BOTTOM - _TOP)


def _polyline(x: Array, y: Array, last: float) -> str:
    return "L".join(f"{_to_x(a, last):.1f} {_to_y(b):.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _outline(b: Band, last: float) -> str:
    return f"M{_polyline(b.x, b.high, last)}L{_polyline(b.x[::-1], b.low[::-1], last)}Z"
