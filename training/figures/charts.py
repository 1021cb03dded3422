"""The style of our charts, which Matplotlib draws: figures without pyplot's state, the same bytes every time."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO

from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["COLOURS", "INK", "chart", "label", "png", "told"]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444")
"""Told apart by those who do not see red and green apart, too (Okabe and Ito 2008)."""

INK = "#1e1e1e"
"""Of what is no curve: a goal, a limit, a bound."""

_DPI = 100


def chart(
    rows: int = 1, columns: int = 1, *, size: tuple[int, int] = (1000, 560)
) -> tuple[Figure, Sequence[Axes]]:
    """Return a figure of ``size`` (width, height) [pixels] and its axes, row by row."""
    figure = Figure((size[0] / _DPI, size[1] / _DPI), _DPI, layout="constrained")
    every: list[Axes] = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for axes in every:
        axes.set_prop_cycle(color=COLOURS)
        axes.grid(color="#e4e2e0", linewidth=0.8)
        axes.set_axisbelow(True)
    return figure, every


def label(axes: Axes, title: str, x: str, y: str, *, log: str = "") -> None:
    """Write title, axes and, beside them, the legend of what was plotted; ``log``: "x", "y" or "xy"."""
    axes.set_title(title, loc="left", fontweight="bold")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_xscale("log" if "x" in log else "linear")
    axes.set_yscale("log" if "y" in log else "linear")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")


def told(name: str) -> str:
    """Return a name from outside as charts show it: what stands between two $ is no formula."""
    return name.replace("$", r"\$")


def png(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG file, with neither date nor version in it."""
    file = BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()
