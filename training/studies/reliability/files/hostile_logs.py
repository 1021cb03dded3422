"""Recorded logs that are made to do harm: packed zeros without end, clocks and numbers that no robot has."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache

from training.studies.reliability.files import samples
from training.studies.reliability.files.samples import Files, Hostile, Link, Pipe, Sound, one, packed

__all__ = ["CARMEN", "DPSLAM", "PARK", "UTIAS"]

_NUMBERS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e999", "5e-324", "1e10", "-1", "0", "1e5", "1e3", "9" * 400, "x",
)  # fmt: skip


@cache
def _bomb(piece: bytes, megabytes: int) -> bytes:
    """Return gzip that unpacks to so many megabytes of the same."""
    return packed(piece * (2**20 // len(piece))) * megabytes


def _lines(name: str, sound: Callable[[], Sound]) -> list[bytes]:
    return sound()[name].splitlines()


def _with(name: str, sound: Callable[[], Sound], row: int, word: int, value: str) -> Callable[[], Files]:
    """Return a file with one word of one line replaced; rows and words count from 0, or back from the end."""

    def made() -> Files:
        lines = _lines(name, sound)
        words = lines[row].split()
        words[word] = value.encode()
        lines[row] = b" ".join(words)
        return {name: b"\n".join(lines) + b"\n"}

    return made


def _every(name: str, sound: Callable[[], Sound], word: int, value: str) -> Callable[[], Files]:
    """Return a file with one word of every line replaced."""

    def made() -> Files:
        rows = [line.split() for line in _lines(name, sound)]
        for words in rows:
            if len(words) > abs(word) - (word < 0):
                words[word] = value.encode()
        return {name: b"\n".join(map(b" ".join, rows)) + b"\n"}

    return made


def _any(name: str, line: bytes) -> dict[str, Callable[[], Files]]:
    """Return what harms any reader of text; ``line`` is one that it takes for its own."""
    return {
        "gzip of 600 MB without a line": lambda: {name: _bomb(b"\0", 600)},
        "gzip of 600 MB of empty lines": lambda: {name: _bomb(b"\n", 600)},
        "gzip of 600 MB of lines": lambda: {name: _bomb(line + b"\n", 600)},
        "gzip within gzip": lambda: {name: packed(_bomb(b"\0", 100))},
        "gzip, cut": lambda: {name: _bomb(line + b"\n", 2)[:1000]},
        "gzip, nothing within": lambda: {name: packed(b"")},
        "gzip, its header alone": lambda: {name: b"\x1f\x8b"},
        "gzip with a name of 10 MB": lambda: {name: b"\x1f\x8b\x08\x08\0\0\0\0\0\xff" + b"a" * 10_000_000},
        "gzip with rubbish behind": lambda: {name: packed(line + b"\n") + b"rubbish" * 100},
        "a line of 2 MB": lambda: {name: line[:6] + b" " + b"1 " * 1_000_000},
        "a line without words": lambda: {name: b" " * 2_000_000},
        "null bytes": lambda: {name: bytes(1_000_000)},
        "empty": lambda: {name: b""},
        "UTF-16": lambda: {name: line.decode().encode("utf-16")},
        "only line ends": lambda: {name: b"\r" * 100_000},
        "a pipe": lambda: {name: Pipe()},
        "a link to itself": lambda: {name: Link(name)},
        "an endless device": lambda: {name: Link("/dev/zero")},
        "a device that is empty": lambda: {name: Link("/dev/null")},
    }


def _scan(name: str, sound: Callable[[], Sound], scan: int, odometry: int, words: Mapping[str, int]) -> Hostile:
    """Return what harms a reader of scans: numbers in a scan's line and in an odometry's."""
    counts = ("1000000000", "-1", "0", "1", "2", "١٨٠", "1e3", "0x10", "9" * 5000, "180.0")
    return {
        **{f"{value[:20]} beams": _with(name, sound, scan, 1, value) for value in counts},
        **{f"a range of {value[:20]}": _with(name, sound, scan, 3, value) for value in _NUMBERS},
        **{f"{value[:20]} in place {word} of the odometry": _with(name, sound, odometry, word, value)
           for value in _NUMBERS for word in (1, 3)},
        **{f"a {what} of {value[:20]}": _with(name, sound, scan, word, value)
           for what, word in words.items() for value in _NUMBERS},
        "all ranges 0": lambda: {name: _lines_with_ranges(name, sound, b"0")},
        "all ranges far": lambda: {name: _lines_with_ranges(name, sound, b"1e300")},
        "all at one time": _every(name, sound, -3, "1"),
    }  # fmt: skip


def _lines_with_ranges(name: str, sound: Callable[[], Sound], value: bytes) -> bytes:
    rows = [line.split() for line in _lines(name, sound)]
    for words in rows:
        if words[0] in (b"FLASER", b"Laser"):
            words[2 : 2 + int(words[1])] = [value] * int(words[1])
    return b"\n".join(map(b" ".join, rows)) + b"\n"


CARMEN: Hostile = {
    **_any("log.clf", b"FLASER 2 1 1 0 0 0 0 0 0 1 host 1"),
    **_scan("log.clf", samples.carmen, 3, 2, {"stamp": -3, "pose": -9, "heading": -7}),
    # Where beams stand, how far they reach, how many ranges and remissions there are, a pose.
    **{f"{value[:20]} in place {word} of ROBOTLASER1": _with("log.clf", samples.robotlaser, 3, word, value)
       for value in _NUMBERS for word in (2, 3, 4, 5, 8, 189, 192)},
}  # fmt: skip
DPSLAM: Hostile = {
    **_any("run.log", b"Laser 2 1 1"),
    **_scan("run.log", samples.dpslam, 1, 0, {"last range": -1}),
}


def _tables(sound: Callable[[], Sound]) -> Hostile:
    """Return what harms a reader of several tables: in each of them, and each of them missing."""
    found: dict[str, Callable[[], Files]] = {}
    for name in sound():
        found |= {
            f"{name}: {value[:20]} in line {row}, word {word}": _with(name, sound, row, word, value)
            for value in _NUMBERS for row, word in ((1, 0), (1, -1), (-1, 0))
        }  # fmt: skip
        line = _lines(name, sound)[1]
        contents: dict[str, bytes | Pipe | Link] = {
            "empty": b"", "a line": line, "a pipe": Pipe(), "all alike": (line + b"\n") * 200,
            "an endless device": Link("/dev/zero"), "gzip of 600 MB": _bomb(line + b"\n", 600),
        }  # fmt: skip
        found |= {f"{name}: {what}": one(name, content) for what, content in contents.items()}
    return found


UTIAS: Hostile = _tables(samples.utias)
PARK: Hostile = _tables(samples.park)
