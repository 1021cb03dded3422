"""Tables as text: aligned for a terminal, in Markdown, as CSV."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from slam.files import plain_name

__all__ = ["csv_table", "markdown_name", "markdown_table", "number", "text_table"]


def number(value: float | None, digits: int, missing: str = "–", *, factor: float = 1.0) -> str:
    """Return a number, times a factor, with so many digits after the point, or what stands for none."""
    return missing if value is None else f"{factor * value:.{digits}f}"


def markdown_name(name: str) -> str:
    """Return a name from outside as Markdown shows it, in a table or elsewhere: as code, in which nothing acts."""
    text = plain_name(name).replace("|", "\\|")
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if "`" in text else f"{fence}{text}{fence}"


def text_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return columns of one width each, the first to the left, the others to the right."""
    cells = [[plain_name(text) for text in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(text.rjust(w) for text, w in zip(row[1:], widths[1:], strict=True))])
        for row in cells
    )


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def csv_table(rows: Sequence[Mapping[str, Any]], first: Sequence[str] = (), *, digits: int | None = None) -> str:
    """Return rows as CSV with the first columns and every other that a row has; empty where there is no value.

    Numbers with a point have so many significant digits; ``None``: all.
    """
    file = io.StringIO()
    columns = dict.fromkeys((*first, *(name for row in rows for name in row)))
    writer = csv.DictWriter(file, list(columns), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({
            name: f"{value:.{digits}g}" if digits is not None and isinstance(value, float) else value
            for name, value in row.items()
        })  # fmt: skip
    return file.getvalue()
