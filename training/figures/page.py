"""Pages of ours: the frame of a plain one, and the policy by which a page loads nothing and runs what is ours."""

from __future__ import annotations

import base64
import hashlib
import sys
from collections.abc import Sequence
from html import escape

from slam.files import plain_name
from training.figures.page_style import STYLE

__all__ = ["HEAD", "html_page", "name_html", "security_policy", "text_html"]

HEAD = (
    '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
    '<meta name="color-scheme" content="light dark">\n'
)
"""What every page says of its width and colours."""


def security_policy(*, styles: Sequence[str], scripts: Sequence[str] = ()) -> str:
    """Return the ``<meta>`` by which a browser holds a page to what it was written with.

    It runs these scripts and none else, takes these styles and none else, shows images that are in it, and loads
    nothing: whatever a name, a title or a configuration in it says (Content Security Policy Level 3, W3C).
    Styles and scripts are what stands between the tags, to the letter.
    """
    allowed = {"script-src": scripts, "style-src": styles}
    parts = [
        "default-src 'none'",
        *(f"{name} {' '.join(map(_hash, texts))}" for name, texts in allowed.items() if texts),
        "img-src data:", "base-uri 'none'", "form-action 'none'",
    ]  # fmt: skip
    return f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(parts)}">'


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def text_html(text: str) -> str:
    """Return lines of text as HTML, in which nothing acts: control characters and marks are written out."""
    return escape("\n".join(plain_name(line, sys.maxsize) for line in text.split("\n")))


def name_html(text: str, longest: int = 120) -> str:
    """Return text in which a name from outside stands, as HTML, on one line and cut where it is long."""
    return escape(plain_name(text, longest))


def html_page(title: str, body: str) -> str:
    """Return a page without scripts; ``body`` is HTML, in which all that is data is escaped."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n{security_policy(styles=[STYLE])}\n{HEAD}'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )
