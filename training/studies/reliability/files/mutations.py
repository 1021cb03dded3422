"""Damage: bytes flipped, cut, put in or doubled, lines lost, numbers that nobody expects, nesting without end."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress

import numpy as np

__all__ = ["MUTATIONS", "NUMBERS", "mutated", "mutated_cells"]

Rng = np.random.Generator

NUMBERS = (
    b"nan", b"NaN", b"inf", b"-inf", b"Infinity", b"1e308", b"-1e308", b"1e999", b"5e-324", b"-1", b"0", b"-0.0",
    b"1", b"255", b"65536", b"2147483648", b"9223372036854775807", b"18446744073709551616", b"1" + b"0" * 40,
    b"9" * 5000, b"0x10", b"1_000", b"1e5", b"1e10", b"1e15", b"true", b"null", b'""', b"[]", b"{}", b"[1, 2]",
)  # fmt: skip
"""What stands in a number's place."""

_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_DEEP = (500, 5_000, 100_000)


def _flip(data: bytearray, rng: Rng) -> None:
    for _ in range(int(rng.integers(1, 9))):
        data[int(rng.integers(len(data)))] = int(rng.integers(256))


def _cut(data: bytearray, rng: Rng) -> None:
    del data[int(rng.integers(len(data))) :]


def _gap(data: bytearray, rng: Rng) -> None:
    at = int(rng.integers(len(data)))
    del data[at : at + int(rng.integers(1, 200))]


def _insert(data: bytearray, rng: Rng) -> None:
    at = int(rng.integers(len(data) + 1))
    data[at:at] = rng.bytes(int(rng.integers(1, 64)))


def _words(data: bytearray, rng: Rng) -> None:
    words = (
        b"\n", b"\r\n", b" ", b"\0", b'"', b"'", b"[", b"]", b"{", b"}", b":", b"=", b"#", b",", b"\xff\xfe",
        b"\t",
    )  # fmt: skip
    at = int(rng.integers(len(data) + 1))
    data[at:at] = words[int(rng.integers(len(words)))] * int(rng.integers(1, 4))


def _double(data: bytearray, rng: Rng) -> None:
    at = int(rng.integers(len(data)))
    data[at:at] = data[at : at + int(rng.integers(1, 2000))]


def _lines(data: bytearray, rng: Rng) -> None:
    """Take a line away, have it twice, or have it change places with another."""
    lines = bytes(data).split(b"\n")
    i, j = (int(rng.integers(len(lines))) for _ in range(2))
    what = int(rng.integers(3))
    if what == 0:
        del lines[i]
    elif what == 1:
        lines.insert(j, lines[i])
    else:
        lines[i], lines[j] = lines[j], lines[i]
    data[:] = b"\n".join(lines)


def _number(data: bytearray, rng: Rng) -> None:
    near = int(rng.integers(len(data)))  # the next from there on: all of a large file's take long to find
    if found := _NUMBER.search(data, near) or _NUMBER.search(data):
        data[found.start() : found.end()] = NUMBERS[int(rng.integers(len(NUMBERS)))]


def _nest(data: bytearray, rng: Rng) -> None:
    depth, kind = _DEEP[int(rng.integers(3))], int(rng.integers(3))
    opened, closed = ((b"[", b"]"), (b'{"a":', b"}"), (b"- ", b""))[kind]
    text = opened * depth + (b"0" if kind < 2 else b"") + closed * depth
    if rng.random() < 0.3 or not (found := _NUMBER.search(data, int(rng.integers(len(data))))):
        data[:] = text
    else:
        data[found.start() : found.end()] = text


MUTATIONS: dict[str, Callable[[bytearray, Rng], None]] = {
    "flip": _flip, "cut": _cut, "gap": _gap, "insert": _insert, "words": _words, "double": _double,
    "lines": _lines, "number": _number, "nest": _nest,
}  # fmt: skip
"""Name → what is done to bytes of which there is at least one."""

_SHARES = np.array([3, 1, 2, 2, 3, 1, 3, 6, 0.5])


def mutated(data: bytes, rng: Rng) -> tuple[bytes, list[str]]:
    """Return damaged bytes, and what was done to them."""
    out, names = bytearray(data), []
    for _ in range(int(rng.integers(1, 4))):
        name = str(rng.choice(list(MUTATIONS), p=_SHARES / _SHARES.sum()))
        if out:
            MUTATIONS[name](out, rng)
            names.append(name)
    return bytes(out), names


_CELLS = (
    None, -1, 0, 2**62, -(2**63), 1e308, -1e308, 5e-324, float("inf"), "", "text", "nan", "1e999", "\0", "é" * 300,
    b"", b"\xff" * 7, b"\0" * 400, "{}", "[]", '{"a": NaN}', "[" * 5000,
)  # fmt: skip


def mutated_cells(data: bytes, rng: Rng) -> tuple[bytes, list[str]]:
    """Return a database with a value, row or table that its writer would not have written; else sound."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        database.deserialize(data)
        database.execute("PRAGMA ignore_check_constraints = ON")
        tables = [row[0] for row in database.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        table = str(rng.choice(tables))
        columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
        column = str(rng.choice(columns))
        value = _CELLS[int(rng.integers(len(_CELLS)))]
        what = int(rng.integers(8))
        with suppress(sqlite3.Error):  # a constraint holds: the next one
            if what == 0:
                database.execute(f"DELETE FROM {table} WHERE random() % 2")
            elif what == 1:
                database.execute(f"ALTER TABLE {table} RENAME COLUMN {column} TO other")
            elif what == 2:
                database.execute(f"DROP TABLE {table}")
            else:
                database.execute(f"UPDATE OR REPLACE {table} SET {column} = ? WHERE random() % 3 = 0", (value,))
        return database.serialize(), [f"cells {what}"]
