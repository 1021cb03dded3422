"""A command that is left alone: what it ends with, to hold others against."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from training.studies.reliability.kills.commands import COMMANDS, inputs
from training.studies.reliability.kills.killing import Run, run
from training.studies.reliability.kills.results import results

__all__ = ["argv_of", "undisturbed"]


@cache
def undisturbed(name: str) -> tuple[dict[str, Any], Run]:
    """Return the results of a run that nobody disturbs, and how it went."""
    with tempfile.TemporaryDirectory(prefix="alone-") as place:
        out = Path(place) / "out"
        done = run(argv_of(name, out), out)
        if done.code:
            raise RuntimeError(f"{done.command} ends with {done.code}: {done.error[-300:]}")
        return results(out), done


def argv_of(name: str, out: Path) -> Sequence[str]:
    """Return the arguments of a command that writes to a folder, or goes on with what it holds."""
    command = COMMANDS[name]
    words = [word.replace("{in}", str(inputs())) for word in command.argv]
    return [*words, *(command.again if (out / command.begun).exists() else ()), "--out", str(out)]
