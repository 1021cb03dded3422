"""Options that several commands and studies share."""

from __future__ import annotations

from typing import Annotated

import typer

from training.runs.errors import BadInput

__all__ = ["Backends", "Json", "Seed", "Seeds", "Workers", "whole_numbers"]

Backends = Annotated[str, typer.Option(help="SLAM backends, separated by commas.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, nothing else.")]
Seed = Annotated[int, typer.Option(min=0)]
Seeds = Annotated[str, typer.Option(help="3, 0:9 (both included) or 1,4,7.")]
Workers = Annotated[int | None, typer.Option(min=1, max=1024, help="Processes.  [default: one a core]")]


def whole_numbers(option: str, text: str, *, low: int, high: int) -> list[int]:
    """Return the numbers of ``25,50,100``, as typed for an option, each once and in order."""
    words = [word.strip() for word in text.split(",")]
    if all(word.isascii() and word.isdigit() and len(word) < 9 for word in words):
        numbers = sorted(set(map(int, words)))
        if low <= numbers[0] and numbers[-1] <= high:
            return numbers
    raise BadInput(f"{option} {text!r} must be whole numbers in {low} … {high}, for instance 25,50,100")
