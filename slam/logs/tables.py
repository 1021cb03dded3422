"""Tables of numbers in text files, plain or gzip, with errors that name the file and the line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from slam.files import open_bounded
from slam.types import Array, Indices

__all__ = ["find", "numbers_of", "read_lines", "read_table", "read_timed"]

_LARGEST = 512 * 2**20  # bytes, unpacked: many times the largest log; a damaged or hostile file stops here
_LONGEST_S = 2 * 86_400.0
_LARGEST_NUMBER = 1e16  # of any column: a clock in microseconds since 1970 is at 2e15
_LEAST_LINE = 24  # bytes that a line of a packed file counts for: ever so many short ones take their time, too
_LONGEST_LINE = 2**20  # bytes: a scan of ten thousand beams and more
# What editors and shells of Windows begin a text with.
_UTF8_MARK, _UTF16_MARKS = b"\xef\xbb\xbf", (b"\xff\xfe", b"\xfe\xff")


def find(folder: Path, name: str) -> Path:
    """Return ``folder/name`` or ``folder/name.gz``, whichever is there.

    Raises
    ------
    ValueError
        One line, where neither is.
    """
    for path in (folder / name, folder / f"{name}.gz"):
        if path.is_file():
            return path
    raise ValueError(f"log {folder} lacks {name} (or {name}.gz); put it beside the others")


def read_table(path: Path, columns: int, meaning: str) -> tuple[Array, Indices]:
    """Read white-space separated numbers; empty lines and lines that begin with ``#`` are skipped.

    Parameters
    ----------
    columns : int
        Numbers a line.
    meaning : str
        What they are, for the error message.

    Returns
    -------
    values (n ≥ 1, columns), finite; and the number of the line ``(n,)`` that each row came from.

    Raises
    ------
    ValueError
        One line: the file and line with a wrong number of columns, or something that is no finite number; or
        that the file cannot be read or holds no row.
    """
    rows: list[Array] = []
    numbers: list[int] = []
    for number, line in read_lines(path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != columns:
            raise ValueError(f"{path}, line {number}: expected {columns} columns ({meaning}), got {len(words)}")
        rows.append(numbers_of(words, path=path, line=number, what=meaning))
        numbers.append(number)
    if rows and (far := np.argwhere(np.abs(np.stack(rows)) > _LARGEST_NUMBER)).size:
        i, j = far[0].tolist()
        raise ValueError(
            f"{path}, line {numbers[i]}: {rows[i][j]:.3g} is more than any log has ({meaning}); correct the line"
        )
    if not rows:
        raise ValueError(f"{path} holds no data: expected lines of {meaning}")
    return np.stack(rows), np.array(numbers, np.int64)


def read_timed(path: Path, columns: int, meaning: str, *, second: float = 1.0, most: float = math.inf) -> Array:
    """Read a table like :func:`read_table` whose first column is a time, which must not go back.

    Parameters
    ----------
    second
        How much of that time is a second: no log is longer than two days.
    most
        Of what the other columns may hold; damage leaves numbers that are finite and yet no robot's.
    """
    values, lines = read_table(path, columns, meaning)
    times = values[:, 0]
    far = np.flatnonzero((times - times[0] > _LONGEST_S * second) | (np.abs(values[:, 1:]) > most).any(axis=1))
    if len(far):
        i = int(far[0])
        raise ValueError(
            f"{path}, line {lines[i]}: {', '.join(f'{v:.6g}' for v in values[i])} is more than any log has "
            f"({meaning}); correct the line"
        )
    back = np.flatnonzero(np.diff(times) < 0)
    if len(back):
        i = int(back[0]) + 1
        raise ValueError(f"{path}, line {lines[i]}: time {times[i]:.6g} is before {times[i - 1]:.6g} above it")
    return values


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return math.nan


def read_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file, plain or gzip, with their numbers from 1; only one is held at a time.

    Raises
    ------
    ValueError
        One line: that the file cannot be read, is damaged, or is too large for any log.
    """
    with open_bounded(path) as (file, most):
        size = number = 0
        plain = most == path.stat().st_size
        while line := file.readline(_LONGEST_LINE + 1):
            number, size = number + 1, size + (len(line) if plain else max(len(line), _LEAST_LINE))
            if size > min(most, _LARGEST) or len(line) > _LONGEST_LINE:
                limit = f", line {number}" if len(line) > _LONGEST_LINE else ""
                raise ValueError(f"{path}{limit} is larger than any log's: it is no such log")
            if number == 1 and line.startswith(_UTF16_MARKS):
                raise ValueError(f"{path} is written in UTF-16; save it as UTF-8")
            if number == 1:
                line = line.removeprefix(_UTF8_MARK)
            yield number, line.decode("utf-8", "replace")


def numbers_of(words: Sequence[str], *, path: Path, line: int, what: str) -> Array:
    """Return the numbers ``(len(words),)`` that words of a line stand for, all finite.

    Raises
    ------
    ValueError
        One line: file, line, the word that is no finite number, and ``what`` it belongs to.
    """
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.array([_number(word) for word in words])
    if not np.isfinite(values).all():
        word = words[int(np.flatnonzero(~np.isfinite(values))[0])]
        raise ValueError(f"{path}, line {line}: {word[:40]!r} is not a finite number ({what}); correct the line")
    return values
