"""Time to 95 % against the number of robots, as SVG that takes its colours from the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from matplotlib.ticker import MaxNLocator

from training.benchmark.report_charts import COLOURS
from training.benchmark.team_figures import Scaling

__all__ = ["scaling_chart"]

_WIDTH, _HEIGHT = 480, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 24, 40  # margins
_APART = 5.0  # of lines at one number of robots, that their intervals do not lie on each other [px]


def scaling_chart(scalings: Sequence[Scaling]) -> str:
    """Return the chart as an ``<svg>`` element: figures with their intervals, dashed what one robot would share.

    Dashed is the time of one robot over the number of robots.
    """
    most = max(s.robots[-1] for s in scalings)
    times = [v for s in scalings for t in s.time for v in (t.value, t.high) if math.isfinite(v)]
    ticks = np.asarray(MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(0.0, max(times, default=1.0)))
    top, right, bottom = float(ticks[-1]), _WIDTH - _RIGHT, _HEIGHT - _BOTTOM

    def x(robots: float) -> float:
        return _LEFT + 20 + (robots - 1) / max(most - 1, 1) * (right - _LEFT - 40)

    def y(seconds: float) -> float:
        return bottom - seconds / top * (bottom - _TOP)

    names = ", ".join(s.name for s in scalings)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="Time to 95 % against the number of robots: {escape(names)}">'
    ]
    for tick in ticks.tolist():
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y(tick):.1f}" y2="{y(tick):.1f}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    for robots in sorted({count for s in scalings for count in s.robots}):
        parts.append(
            f'<text class="tick" x="{x(robots):.1f}" y="{bottom + 16}" text-anchor="middle">{robots}</text>'
        )
    for k, s in enumerate(scalings):
        kind = f"line c{k % COLOURS}"
        aside = _APART * (k - 0.5 * (len(scalings) - 1))
        known = [(r, t) for r, t in zip(s.robots, s.time, strict=True) if math.isfinite(t.value)]
        if known and known[0][0] == 1:
            ideal = "L".join(f"{x(r) + aside:.1f} {y(known[0][1].value / r):.1f}" for r in range(1, most + 1))
            parts.append(f'<path class="{kind} dashed" style="stroke-width: 1; opacity: .6" d="M{ideal}"/>')
        path = "L".join(f"{x(r) + aside:.1f} {y(t.value):.1f}" for r, t in known)
        if path:
            parts.append(f'<path class="{kind}" d="M{path}"><title>{escape(s.name)}</title></path>')
        for r, t in known:
            if math.isfinite(t.low) and math.isfinite(t.high):
                at = f"{x(r) + aside:.1f}"
                parts.append(f'<path class="{kind}" d="M{at} {y(t.low):.1f}L{at} {y(t.high):.1f}"/>')
            centre = f'cx="{x(r) + aside:.1f}" cy="{y(t.value):.1f}"'
            parts.append(f'<circle class="{kind}" style="fill: var(--c)" {centre} r="3"/>')
    parts.append(f'<text class="label" x="{_LEFT}" y="{_TOP - 9}">time to 95 % [s]</text>')
    middle = 0.5 * (_LEFT + right)
    parts.append(f'<text class="label" x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">robots</text>')
    return "".join([*parts, "</svg>"])
