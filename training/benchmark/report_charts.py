"""Coverage curves over many episodes, and what more robots bring, as SVG that takes its colours from the page.

The latter also as a picture of all suites and models of communication.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from matplotlib.ticker import MaxNLocator

from slam.types import Array
from training.benchmark.figures import Group
from training.benchmark.team_figures import Scaling
from training.figures import charts
from training.figures.page import name_html
from training.figures.statistics import Interval

__all__ = ["COLOURS", "Band", "band", "coverage_chart", "extent", "scaling_charts", "team_chart"]

Along = Literal["time_s", "path_length_m"]
Line = tuple[str, list[tuple[int, Interval]]]  # name, and its figure for each number of robots

COLOURS = 8
"""Colours that the page has (``--c0``, …); beyond them the lines are dashed."""

_POINTS = 96
_CURVES = {"time_s": "coverage_by_time", "path_length_m": "coverage_by_path"}
_LABELS = {"time_s": "time [s]", "path_length_m": "way [m]"}
_WIDTH, _HEIGHT = 480, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 24, 40  # margins
_MOST = 1.6  # times the highest figure: what lies beyond is cut off
_PANEL, _ROOM_ABOVE = (240, 260), 1.25  # of the picture: a chart's size [px]; room above the slowest robot alone
_APART = 5.0  # of lines at one number of robots, that their intervals do not lie on each other [px] …
_SPREAD = 44.0  # … less, where there are many of them: so wide are all together [px]


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
    """Return the chart of bands over the same x as an ``<svg>`` element; ``colours`` are their indices, 0 … ."""
    last = float(bands[0].x[-1])
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    names = ", ".join(b.name for b in bands)
    parts = []
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
        path, name = _polyline(b.x, b.middle, last), name_html(b.name, 400)
        parts.append(f'<path class="line c{colour % COLOURS}{dashed}" d="M{path}"><title>{name}</title></path>')
    return _chart(f"Coverage against {_LABELS[along]}: {names}", parts, up="coverage [%]", along=_LABELS[along])


def _chart(told: str, parts: Sequence[str], *, up: str, along: str) -> str:
    """Return the chart of these parts, what it tells in words, and the labels of its axes."""
    middle = 0.5 * (_LEFT + _WIDTH - _RIGHT)
    return (
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{name_html(told, 400)}">{"".join(parts)}'
        f'<text class="label" x="{_LEFT}" y="{_TOP - 9}">{name_html(up, 400)}</text>'
        f'<text class="label" x="{middle}" y="{_HEIGHT - 6}" text-anchor="middle">{along}</text></svg>'
    )


def _to_x(value: float, last: float) -> float:
    return _LEFT + value / last * (_WIDTH - _RIGHT - _LEFT)


def _to_y(share: float) -> float:
    return _HEIGHT - _BOTTOM - share * (_HEIGHT - _BOTTOM - _TOP)


def _polyline(x: Array, y: Array, last: float) -> str:
    return "L".join(f"{_to_x(a, last):.1f} {_to_y(b):.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))


def _outline(b: Band, last: float) -> str:
    return f"M{_polyline(b.x, b.high, last)}L{_polyline(b.x[::-1], b.low[::-1], last)}Z"


# ---- several robots --------------------------------------------------------------------------------------------


def scaling_charts(scalings: Sequence[Scaling]) -> str:
    """Return ``<svg>`` elements: times with their intervals, and how many times as fast as one robot, if known.

    Thin and dashed is what there would be if so many robots were so many times as fast.
    """
    times: list[Line] = [(s.name, list(zip(s.robots, s.time, strict=True))) for s in scalings]
    gains: list[Line] = [
        (s.name, [(n, _gain(n, ratio)) for n, ratio in zip(s.robots, s.ratio, strict=True)]) for s in scalings
    ]
    chart = _scaling_chart(times, "time to 95 % [s]", lambda first, n: first / n)
    if any(math.isfinite(gain.value) for _, line in gains for _, gain in line):
        chart += _scaling_chart(gains, "times as fast as one robot", lambda _, n: float(n))
    return chart


def _gain(robots: int, ratio: Interval) -> Interval:
    if robots == 1:
        return Interval(1.0, math.nan, math.nan)
    return Interval(*(1.0 / share if share > 0 else math.nan for share in (ratio.value, ratio.high, ratio.low)))


def _scaling_chart(lines: Sequence[Line], label: str, ideal: Callable[[float, int], float]) -> str:
    """Return a chart of lines; ``ideal`` gives the dashed one, from a line's figure for one robot."""
    known = [(name, [(n, f) for n, f in line if math.isfinite(f.value)]) for name, line in lines]
    counts = sorted({n for _, line in lines for n, _ in line})
    # One that once never got there has an interval up to its limit of time, which would flatten all else.
    most = _MOST * max((f.value for _, line in known for _, f in line), default=1.0)
    values = [min(v, most) for _, line in known for _, f in line for v in (f.value, f.high) if math.isfinite(v)]
    ticks = np.asarray(MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(0.0, max(values, default=1.0)))
    top, right, bottom = float(ticks[-1]), _WIDTH - _RIGHT, _HEIGHT - _BOTTOM

    apart = min(_APART, _SPREAD / max(len(lines) - 1, 1))

    def at(robots: int, value: float, k: float) -> tuple[float, float]:
        x = _LEFT + 24 + (robots - 1) / max(counts[-1] - 1, 1) * (right - _LEFT - 48)
        y = bottom - min(value, top) / top * (bottom - _TOP)
        return round(x + apart * (k - 0.5 * (len(lines) - 1)), 1), round(y, 1)

    def path(points: Sequence[tuple[float, float]]) -> str:
        return "M" + "L".join(f"{x} {y}" for x, y in points)

    names = ", ".join(name for name, _ in lines)
    parts = []
    for tick in ticks.tolist():
        _, y = at(1, tick, 0)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{right}" y1="{y}" y2="{y}"/>')
        parts.append(f'<text class="tick" x="{_LEFT - 6}" y="{y + 4}" text-anchor="end">{tick:g}</text>')
    for n in counts:
        x, _ = at(n, 0.0, 0.5 * (len(lines) - 1))
        parts.append(f'<text class="tick" x="{x}" y="{bottom + 16}" text-anchor="middle">{n}</text>')
    for k, (name, line) in enumerate(known):
        kind = f"line c{k % COLOURS}"
        dashed = " dashed" if k >= COLOURS else ""
        if line and line[0][0] == 1:
            shares = [(n, ideal(line[0][1].value, n)) for n in range(1, counts[-1] + 1)]
            points = [at(n, share, k) for n, share in shares if share <= top]
            parts.append(f'<path class="{kind} dashed ideal" d="{path(points)}"/>')
        if line:
            points = [at(n, f.value, k) for n, f in line]
            title = f"<title>{name_html(name, 400)}</title>"
            parts.append(f'<path class="{kind}{dashed}" d="{path(points)}">{title}</path>')
        for n, f in line:
            if math.isfinite(f.low) and math.isfinite(f.high):
                limits = path([at(n, f.low, k), at(n, f.high, k)])
                parts.append(f'<path class="{kind} thin" d="{limits}"/>')
            x, y = at(n, f.value, k)
            parts.append(f'<circle class="{kind} dot" cx="{x}" cy="{y}" r="2.5"/>')
    return _chart(f"{label} against the number of robots: {names}", parts, up=label, along="robots")


def team_chart(suites: Mapping[str, Sequence[Scaling]]) -> bytes:
    """Return a PNG: time to 95 % against the number of robots, a row a suite, a column a model of communication.

    There is no point where some of the episodes did not reach 95 %.
    """
    models = list(dict.fromkeys(s.communication for scalings in suites.values() for s in scalings))
    agents = list(dict.fromkeys(s.agent for scalings in suites.values() for s in scalings))
    size = max(_PANEL[0] * len(models) + 60, 520), _PANEL[1] * len(suites) + 90
    figure, every = charts.chart(len(suites), len(models), size=size)
    for axes, ((suite, scalings), how) in zip(every, product(suites.items(), models), strict=True):
        counts = sorted({n for s in scalings for n in s.robots})
        alone = [s.time[0].value for s in scalings if s.robots[0] == 1]
        for s in scalings:
            if s.communication == how:
                k = agents.index(s.agent)
                every_n = zip(s.robots, s.time, s.others, strict=True)
                there = [(n, time.value) for n, time, also in every_n if also["reached_95"].value >= 1.0]
                axes.plot(
                    [n for n, _ in there], [t for _, t in there], "--o" if k >= len(charts.COLOURS) else "-o",
                    color=charts.COLOURS[k % len(charts.COLOURS)], markersize=3.5, label=charts.told(s.agent),
                )  # fmt: skip
        if alone:
            fastest = min(alone)
            axes.plot(
                counts, [fastest / n for n in counts], ":", color=charts.INK, label="so many times as fast as one"
            )
            axes.set_ylim(0.0, _ROOM_ABOVE * max(alone))
        axes.set_xticks(counts)
        if how == models[0]:
            axes.set_ylabel(f"{suite}\ntime to 95 % [s]")
        if suite == next(iter(suites)):
            axes.set_title(how, loc="left", fontweight="bold")
        if suite == list(suites)[-1]:
            axes.set_xlabel("robots")
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncol=5, frameon=False)
    return charts.png(figure)
