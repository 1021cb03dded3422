"""What the lines of a laser log may say: numbers of beams, ranges, and poses and times that a robot can have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.logs.tables import numbers_of
from slam.types import Array

__all__ = ["check_jumps", "message_of", "scan_of"]

_FEWEST_BEAMS, _MOST_BEAMS = 2, 10_000
# Damage leaves numbers that are finite and yet no robot's: no log spans 100 km, a clock in seconds since 1970 is
# at 2e9, and no robot drives a kilometre from one scan to the next.
_FARTHEST_M, _FARTHEST_RAD, _LATEST_S, _LONGEST_JUMP_M = 1e5, 1e5, 1e11, 1e3


def scan_of(
    words: Sequence[str], *, kind: str, after: int, earlier: Sequence[Array], path: Path, line: int
) -> Array:
    """Return the ranges ``(n,)`` [m] of a line's words ``n r_1 … r_n`` and so many ``after`` them.

    Raises
    ------
    ValueError
        One line: file and line, where n is no number of beams or not that of the ``earlier`` scans, the line has
        not so many words, or a range is no number of at least 0. ``kind`` is the line's first word.
    """
    where = f"{path}, line {line}"
    count = words[0] if words else ""
    if not (count.isascii() and count.isdigit() and _FEWEST_BEAMS <= int(count[:6]) <= _MOST_BEAMS):
        raise ValueError(f"{where}: {count[:40]!r} is no number of beams, {_FEWEST_BEAMS} to {_MOST_BEAMS}, as "
                         f"{kind} needs; correct the line")  # fmt: skip
    expected = 1 + int(count) + after
    if len(words) != expected:
        raise ValueError(f"{where}: a {kind} of {count} beams has {expected} values, here are {len(words)}; "
                         "the line is cut short or damaged")  # fmt: skip
    scan = numbers_of(words[1 : 1 + int(count)], path=path, line=line, what=f"a range of {kind}")
    if scan.min() < 0:
        raise ValueError(f"{where}: range {scan.min():g} is below 0; correct the line")
    if earlier and len(scan) != len(earlier[0]):
        raise ValueError(f"{where}: a scan of {len(scan)} beams after scans of {len(earlier[0])}; "
                         "give a log of one laser")  # fmt: skip
    return scan


def message_of(
    words: Sequence[str], *, poses_at: tuple[int, ...], stamp_at: int | None, path: Path, line: int, what: str
) -> Array:
    """Return the numbers that words of a line stand for, with poses from some of them on and a time stamp.

    Raises ``ValueError`` with file and line where a word is no number, a pose none that a log comes to, or the
    stamp no clock's [s].
    """
    values = numbers_of(words, path=path, line=line, what=what)
    wrong = ""
    for i in poses_at:
        far, turned = np.abs(values[i : i + 2]).max(), abs(values[i + 2])
        if far > _FARTHEST_M:
            wrong = f"a coordinate of {far:.3g} m is more than {_FARTHEST_M:g} m"
        elif turned > _FARTHEST_RAD:
            wrong = f"a heading of {turned:.3g} rad is more than {_FARTHEST_RAD:g} rad"
    if stamp_at is not None and abs(values[stamp_at]) > _LATEST_S:
        wrong = wrong or f"a time of {values[stamp_at]:.3g} s is more than {_LATEST_S:g} s"
    if wrong:
        raise ValueError(f"{path}, line {line}: {wrong}; correct the line")
    return values


def check_jumps(poses: Array, *, path: Path, lines: Sequence[int]) -> None:
    """Raise ``ValueError`` with file and line where poses ``(n, 3)`` at scans lie too far from those before."""
    jumps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    wide = np.flatnonzero(jumps > _LONGEST_JUMP_M)
    if len(wide):
        i = int(wide[0])
        raise ValueError(f"{path}, line {lines[i + 1]}: a jump of {jumps[i]:.4g} m from the scan before is more "
                         f"than {_LONGEST_JUMP_M:g} m; correct the line")  # fmt: skip
