"""Names and values from outside, as they are shown: on one line, and nothing in them acts."""

from __future__ import annotations

from pathlib import Path

__all__ = ["plain_name", "quoted", "shown_path"]


def plain_name(text: str, longest: int = 120) -> str:
    """Return a name from outside as it is shown: on one line, cut where it is long, and nothing in it acts.

    Control characters, marks that turn the direction of what follows, and bytes that are no text are written out.
    """
    out = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return out if len(out) <= longest else f"{out[: longest - 1]}…"


def quoted(value: object, longest: int = 60) -> str:
    """Return a value as an error tells it: on one line, without control characters, cut where it is long."""
    try:
        text = " ".join(line.strip() for line in repr(value).splitlines())  # an array's has several
    except ValueError:  # an integer of more digits than Python writes
        text = f"a {type(value).__name__}"
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def shown_path(path: Path) -> str:
    """Return a path as an error tells it."""
    return plain_name(str(path), 400)
