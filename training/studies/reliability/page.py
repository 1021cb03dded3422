"""The campaign's page: of each part what was tried, what came of it, and what failed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from training.figures.page import html_page
from training.studies.reliability.parts import Part, Summary

__all__ = ["page"]

_SHOWN = 200  # failures of a part


def page(parts: Mapping[str, tuple[Part, Summary]]) -> str:
    """Return the page of parts, by name."""
    body = ["<h1>Reliability</h1>"]
    for name, (part, found) in parts.items():
        failures = found["failures"]
        tone = "worse" if failures else "better"
        body += [
            f"<h2>{escape(name)}</h2>",
            f"<p>{escape(part.about)} Seed {found['seed']}, size {found['size']}.</p>",
            f'<p>{found["tried"]} tried, <span class="{tone}">{len(failures)} failed</span>.</p>',
            _table(*part.table(found)),
            "".join(f"<pre>{escape(line)}</pre>" for line in failures[:_SHOWN]),
        ]
    return html_page("Reliability", "\n".join(body))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(word)}</th>" for word in head)
    lines = "".join(f"<tr><th>{escape(row[0])}</th>{''.join(map(_cell, row[1:]))}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{lines}</tbody></table></div>'


def _cell(text: str) -> str:
    return f"<td{' class=words' if text[:1].isalpha() else ''}>{escape(text)}</td>"
