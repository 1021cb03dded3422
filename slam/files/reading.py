"""Bytes, JSON, TOML and YAML, read with distrust: bounded in size and depth, and every fault in one line.

No pipe or device is opened, for reading one may never end.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import tomllib
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

import yaml

from slam.files.names import quoted, shown_path

__all__ = [
    "MOST_TEXT", "check_file", "open_bounded", "parse_json", "parse_toml", "parse_yaml", "read_bytes", "read_json",
    "read_toml",
]  # fmt: skip

MIB = 2**20
MOST_TEXT = 64 * MIB  # of a file of settings or results
_MOST_TOML = 4 * MIB
_LONG_KEY = re.compile(rb"""(?<![\w."'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){64}""")
_GZIP = b"\x1f\x8b"
# A log of numbers packs to a fifth or a tenth: what unpacks to many times more is no log, but a bomb.
_MOST_PACKED, _FREE_UNPACKED = 20, 8 * MIB


# ---- bytes -----------------------------------------------------------------------------------------------------


def check_file(path: Path, *, what: str = "file") -> None:
    """Raise ``ValueError`` unless a path leads to a regular file: nothing else is opened."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise ValueError(f"the name of {what} {shown_path(path)} is no UTF-8; rename it") from None
    try:
        if path.is_file():
            return
        found = path.exists()
    except (OSError, ValueError) as error:  # a link to itself, a name that is too long, a null byte
        raise ValueError(f"cannot read {what} {shown_path(path)}: {_reason(error)}; check the path") from error
    if not found:
        raise ValueError(f"cannot read {what} {shown_path(path)}: No such file; check the path")
    raise ValueError(f"{what} {shown_path(path)} is not a file; give the path of one")


def read_bytes(path: Path, *, what: str = "file", limit: int = MOST_TEXT) -> bytes:
    """Return a file's contents.

    Raises
    ------
    ValueError
        One line: it is missing, no regular file, not to be read, or larger than ``limit`` bytes.
    """
    check_file(path, what=what)
    try:
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except OSError as error:
        reason = f"{_reason(error)}; check its permissions"
        raise ValueError(f"cannot read {what} {shown_path(path)}: {reason}") from error
    if len(data) > limit:
        raise ValueError(f"{what} {shown_path(path)} is larger than {limit // MIB} MiB; give a smaller file")
    return data


@contextmanager
def open_bounded(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """Open a file, plain or gzip, and say how many bytes it may hold: of a packed one not many times its size.

    By its first bytes: a browser may have unpacked a file and left its name. What goes wrong while it is read
    becomes a ``ValueError`` of one line.
    """
    check_file(path, what="log")
    try:
        with open(path, "rb") as raw:
            packed = raw.read(2) == _GZIP
        size = path.stat().st_size
        most = max(_FREE_UNPACKED, _MOST_PACKED * size) if packed else size
        with gzip.open(path, "rb") if packed else open(path, "rb") as file:
            yield cast(BinaryIO, file), most
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ValueError(f"{shown_path(path)} is a damaged gzip file ({error}); fetch it again") from error
    except OSError as error:
        raise ValueError(f"cannot read {shown_path(path)}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


# ---- text ------------------------------------------------------------------------------------------------------


def parse_json(text: str | bytes, *, what: str, nan: bool = False) -> Any:
    """Return what JSON says; NaN and Infinity, which JSON has not, are refused unless ``nan``.

    Raises
    ------
    ValueError
        One line: ``what`` is no JSON, or nested too deep.
    """
    if nan:
        return _parsed(lambda: json.loads(text), what, "JSON")
    return _parsed(lambda: json.loads(text, parse_constant=_no_number, parse_float=_finite), what, "JSON")


def read_json(path: Path, *, what: str = "file", nan: bool = False) -> Any:
    """Return what a file of JSON says; ``ValueError`` in one line as of :func:`parse_json`, with its name."""
    return parse_json(read_bytes(path, what=what), what=f"{what} {shown_path(path)}", nan=nan)


def parse_toml(text: bytes, *, what: str) -> dict[str, Any]:
    """Return what TOML says; ``ValueError`` in one line where it is none, or nested too deep."""
    if _LONG_KEY.search(text):  # what tomllib's time and memory go by the square of
        raise ValueError(f"{what} is damaged: TOML nested too deep")
    found: dict[str, Any] = _parsed(lambda: tomllib.loads(text.decode("utf-8-sig")), what, "TOML")
    return found


def read_toml(path: Path) -> dict[str, Any]:
    """Return what a config of TOML says; else a ``ValueError`` as of :func:`parse_toml`, with the file's name."""
    return parse_toml(read_bytes(path, what="config", limit=_MOST_TOML), what=f"config {shown_path(path)}")


def parse_yaml(text: bytes, *, what: str) -> Any:
    """Return what YAML of plain values says: no tag makes an object, and nothing is written once and used twice.

    Aliases are refused, since a few of them stand for billions of values.

    Raises
    ------
    ValueError
        One line: ``what`` is no such YAML, or nested too deep.
    """
    return _parsed(lambda: yaml.load(text.decode("utf-8"), _NoAliases), what, "YAML")


class _NoAliases(yaml.SafeLoader):
    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, "aliases are not read", mark)
        return super().compose_node(parent, index)


def _parsed(parse: Callable[[], Any], what: str, kind: str) -> Any:
    try:
        return parse()
    except RecursionError as error:
        raise ValueError(f"{what} is damaged: {kind} nested too deep") from error
    # TypeError and KeyError: PyYAML on keys that cannot be keys, and others that it does not expect.
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, yaml.YAMLError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark is not None else f": {quoted(_reason(error), 120)}"
        raise ValueError(f"{what} is damaged: not {kind}{where}; correct it there") from error


def _no_number(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number of JSON")


def _finite(word: str) -> float:
    value = float(word)
    if not math.isfinite(value):
        raise ValueError(f"{word[:40]} is too large")
    return value
