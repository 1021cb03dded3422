"""What a part of the campaign is: work items, what is done with one, and what all of them amount to."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

__all__ = ["Job", "Part", "Row", "Summary", "Table"]

Job = tuple[Any, ...]  # of strings and numbers
Row = dict[str, Any]  # as JSON has it
Summary = dict[str, Any]  # as JSON has it; of every part it has ``tried`` and ``failures``, a list of lines
Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Headings, and rows of words."""


@dataclass(frozen=True, kw_only=True)
class Part:
    """A part of the campaign: a function from a work item to a row, and one from rows to a summary.

    A row is kept as it comes, so what is broken off goes on where it stopped; an item should take a minute at the
    most. Both functions are of a module's top level, so that other processes find them.
    """

    about: str  # a line
    size: float  # how much is done where nothing is said: the whole campaign
    jobs: Callable[[Any, int], Sequence[Job]]  # of a size and a seed
    work: Callable[[Job], Row]
    sum_up: Callable[[Mapping[Job, Row]], Summary]
    table: Callable[[Summary], Table]
