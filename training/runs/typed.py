"""Lists as they are typed on the command line."""

from __future__ import annotations

from training.runs.errors import BadInput

__all__ = ["LAST_SEED", "parts_of", "whole_numbers"]

LAST_SEED = 2**31 - 1
"""The largest seed that may be typed."""


def parts_of(text: str) -> list[str]:
    """Return the parts of a list as typed, separated by commas, each once and in order."""
    return list(dict.fromkeys(part.strip() for part in text.split(",")))


def whole_numbers(option: str, text: str, *, low: int, high: int) -> list[int]:
    """Return the numbers of ``25,50,100``, as typed for an option, each once and in order."""
    words = parts_of(text)
    if all(word.isascii() and word.isdigit() and len(word) < 9 for word in words):
        numbers = sorted(set(map(int, words)))
        if low <= numbers[0] and numbers[-1] <= high:
            return numbers
    raise BadInput(
        f"{option} {text!r} must be whole numbers in {low} … {high}, for instance {low},{min(low + 1, high)}"
    )
