"""Configuration files as a run leaves them, with a [run] table that says how it was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slam.files import read_toml
from training.runs.errors import BadInput, bad_input

__all__ = ["read_config"]


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
    run = {name: run[name] for name in kinds if name in run}
    for name, value in run.items():
        if type(value) not in kinds[name]:
            raise BadInput(f"config {path}: [run] {name} has the wrong type; see a config.toml")
    if run.get("seed", 0) < 0:
        raise BadInput(f"config {path}: [run] needs seed ≥ 0")
    return values, run
