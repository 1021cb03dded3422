"""What goes wrong on the command line: one line that says what, what is allowed, and what to do."""

from __future__ import annotations

import difflib
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["BadInput", "Interrupted", "bad_input", "check_writable", "needs_extra", "one_line", "suggestion"]


class BadInput(Exception):
    """What the user gave cannot be used: exit code 2. The message is one line with the remedy."""


class Interrupted(Exception):
    """The user pressed Ctrl-C: exit code 130. The message says what was kept."""


@contextmanager
def bad_input() -> Iterator[None]:
    """Take a ``ValueError`` raised inside, where only the user's input is judged, for :class:`BadInput`.

    Outside of such a block a ``ValueError`` is the program's own fault.
    """
    try:
        yield
    except ValueError as error:
        raise BadInput(one_line(error)) from error


@contextmanager
def needs_extra(extra: str, what: str = "this") -> Iterator[None]:
    """Take a library that is found missing inside for :class:`BadInput`: ``what`` needs one of an extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise BadInput(
            f"{what} needs {error.name}; install it with pip install 'mecanum-slam[{extra}]'"
        ) from error


def one_line(error: object) -> str:
    """Return an error's message on one line."""
    return " ".join(str(error).split())


def suggestion(name: str, valid: Iterable[str]) -> str:
    """Return ``" (did you mean …?)"`` where one of the valid names is close, else nothing."""
    names = {one.lstrip("-"): one for one in valid}  # what options begin with makes none of them alike
    close = difflib.get_close_matches(name.lstrip("-"), names, n=1)
    return f" (did you mean {names[close[0]]}?)" if close else ""


def check_writable(folder: Path, files: Iterable[str] = ()) -> None:
    """Raise :class:`BadInput` unless a folder, and files in it, can be written to or made; none is left here."""
    remedy = "choose another --out"
    for name in files:
        if (folder / name).is_dir():
            raise BadInput(f"cannot write {folder / name}: it is a folder; {remedy}")
    for place in (folder, *folder.absolute().parents):
        if place.is_dir():
            try:
                with tempfile.TemporaryFile(dir=place):  # what permissions say is not so for root, nor in /proc
                    return
            except OSError as error:
                why = one_line(error.strerror or error)
                raise BadInput(f"cannot write to {folder}: {why} in {place}; {remedy}") from error
        if place.exists() or place.is_symlink():
            raise BadInput(f"cannot write to {folder}: {place} is not a folder; {remedy}")
    raise BadInput(f"cannot write to {folder}: no such place; {remedy}")
