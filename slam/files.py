"""Files of unknown origin, read with distrust: bounded in size, depth and time, and every fault in one line.

Whatever the project reads goes through here: plain or packed bytes, JSON, TOML, YAML, SQLite. No pipe or device is
opened, for reading one may never end.
"""

from __future__ import annotations

import gzip
import json
import math
import re
import sqlite3
import time
import tomllib
import zlib
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, cast

import yaml

__all__ = [
    "check_file", "check_tables", "open_bounded", "open_database", "parse_json", "parse_toml",
    "parse_yaml", "plain_name", "quoted", "read_bytes", "read_json", "read_toml", "shown_path", "trust",
]  # fmt: skip

MIB = 2**20
_MOST_TEXT = 64 * MIB  # of a file of settings or results
_MOST_TOML = 4 * MIB
_LONG_KEY = re.compile(rb"""(?<![\w."'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){64}""")
_GZIP = b"\x1f\x8b"
# A log of numbers packs to a fifth or a tenth: what unpacks to many times more is no log, but a bomb.
_MOST_PACKED, _FREE_UNPACKED = 20, 8 * MIB
_LONGEST_QUERY_S = 30.0
_CHECKED_EVERY = 100_000  # instructions of SQLite's machine


# ---- bytes -----------------------------------------------------------------------------------------------------


def quoted(value: object, longest: int = 60) -> str:
    """Return a value as an error tells it: on one line, without control characters, cut where it is long."""
    try:
        text = repr(value)
    except ValueError:  # an integer of more digits than Python writes
        text = f"a {type(value).__name__}"
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def plain_name(text: str, longest: int = 120) -> str:
    """Return a name from outside as it is shown: on one line, cut where it is long, and nothing in it acts.

    Control characters, marks that turn the direction of what follows, and bytes that are no text are written out.
    """
    out = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return out if len(out) <= longest else f"{out[: longest - 1]}…"


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


def read_bytes(path: Path, *, what: str = "file", limit: int = _MOST_TEXT) -> bytes:
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


def shown_path(path: Path) -> str:
    """Return a path as an error tells it."""
    return plain_name(str(path), 400)


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
    found: dict[str, Any] = _parsed(lambda: tomllib.loads(text.decode("utf-8")), what, "TOML")
    return found


def read_toml(path: Path, *, what: str = "config") -> dict[str, Any]:
    """Return what a file of TOML says; ``ValueError`` in one line as of :func:`parse_toml`, with its name."""
    return parse_toml(read_bytes(path, what=what, limit=_MOST_TOML), what=f"{what} {shown_path(path)}")


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


# ---- databases -------------------------------------------------------------------------------------------------


@contextmanager
def open_database(path: Path, *, mode: str = "ro") -> Iterator[sqlite3.Connection]:
    """Open an SQLite file; what takes longer than half a minute is broken off until :func:`trust` is called.

    Parameters
    ----------
    mode
        ``ro``: nothing is changed or made; ``rwc``: it is made where it is not there.

    Raises
    ------
    ValueError, sqlite3.Error
        For what is no regular file; for a file that is damaged or takes too long.
    """
    if mode == "ro" or path.exists() or path.is_symlink():
        check_file(path, what="database")
    until = time.monotonic() + _LONGEST_QUERY_S
    uri = f"{path.absolute().as_uri()}?mode={mode}"
    # Two runs of the same command wait for each other's rows.
    with closing(sqlite3.connect(uri, uri=True, timeout=60.0, isolation_level=None)) as database:
        database.set_progress_handler(lambda: time.monotonic() > until, _CHECKED_EVERY)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_TEXT)
        database.execute("PRAGMA trusted_schema = OFF")
        yield database


def check_tables(database: sqlite3.Connection, names: Collection[str], *, alone: bool = False) -> None:
    """Raise ``sqlite3.DatabaseError`` where a table is a view, virtual, computed or damaged; it may be missing.

    ``alone``: also where there is anything else, such as a trigger, which would run when rows are added.
    """
    for kind, name, sql in database.execute("SELECT type, name, sql FROM sqlite_schema").fetchall():
        ours = name in names
        if kind == "index" and sql is None:  # of a primary key
            continue
        if (ours and kind != "table") or (alone and not (ours or str(name).startswith("sqlite_"))):
            raise sqlite3.DatabaseError(f"it holds the {quoted(kind)} {quoted(name)}, which is not its writer's")
        if ours and (
            str(sql).upper().startswith("CREATE VIRTUAL")
            or any(column[-1] for column in database.execute(f"PRAGMA table_xinfo({name})"))
        ):
            raise sqlite3.DatabaseError(f"its table {name} is computed")
    problem = database.execute("PRAGMA quick_check(1)").fetchone()[0]
    if problem != "ok":
        raise sqlite3.DatabaseError(" ".join(str(problem).split())[:200])


def trust(database: sqlite3.Connection) -> None:
    """Let statements take their time: what runs was checked."""
    database.set_progress_handler(None, 0)
