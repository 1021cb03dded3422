"""Configuration files as a run leaves them, with a [run] table that says how it was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slam.files import quoted, read_toml
from training.runs.errors import BadInput, bad_input, suggestion

__all__ = ["read_config"]

# What a run says of itself, and whoever runs it again is not asked for.
_SAID = {
    "agents", "backends", "baseline", "clock_start_s", "log", "robot", "robots", "seeds", "split", "step_limit",
    "suites", "team", "teams", "versions",
}  # fmt: skip


def read_config(path: Path, kinds: Mapping[str, tuple[type, ...]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what a config file says without its [run] table, and what that says of ``kinds``: name → types.

    Raises
    ------
    BadInput
        In one line: what is wrong with the file.
    """
    with bad_input():
        values = read_toml(path)
    run = values.pop("run", {})
    if not isinstance(run, dict):
        raise BadInput(f"config {path}: [run] has the wrong type, it is a table; see a config.toml")
    for name in run:
        close = suggestion(name, kinds)
        if name not in kinds and name not in _SAID and close:
            raise BadInput(f"config {path}: [run] has no {quoted(name)[1:-1]}{close}")
    run = {name: run[name] for name in kinds if name in run}
    for name, value in run.items():
        if type(value) not in kinds[name]:
            raise BadInput(f"config {path}: [run] {name} has the wrong type; see a config.toml")
    if run.get("seed", 0) < 0:
        raise BadInput(f"config {path}: [run] needs seed ≥ 0")
    return values, run
