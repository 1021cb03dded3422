"""Trained policies between stable-baselines3's zip and the files that the package ships: safetensors and JSON."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file, save

from agents.drive_policy import FORMAT, load_drive_policy
from agents.policy import load_choice_policy, policy_description
from slam.formats import atomic_write
from slam.settings import to_mapping

__all__ = ["export_drive_policy", "export_policy", "read_zip"]

_INSIDE = "features_extractor.network."
"""Where the network is among the parameters of :class:`training.networks.ChoicePolicy`."""


def read_zip(path: Path) -> dict[str, NDArray[np.float32]]:
    """Return the network's weights in a zip of stable-baselines3; of its pickles none is loaded.

    Raises
    ------
    ValueError
        Where the file is no such zip.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            state = torch.load(io.BytesIO(archive.read("policy.pth")), weights_only=True, map_location="cpu")
    except (OSError, KeyError, zipfile.BadZipFile, RuntimeError) as error:
        raise ValueError(f"{path} is no zip that stable-baselines3 wrote: {error}") from error
    weights = {name.removeprefix(_INSIDE): value for name, value in state.items() if name.startswith(_INSIDE)}
    if not weights:
        raise ValueError(f"{path} holds another policy than training.networks.ChoicePolicy")
    return {name: value.numpy() for name, value in weights.items()}


def export_policy(source: Path, target: Path, *, heads: int, driver: Any, training: Mapping[str, Any]) -> None:
    """Write the policy of a stable-baselines3 zip as ``target`` (.safetensors) and the JSON file beside it.

    Parameters
    ----------
    source
        As ``MaskablePPO.save`` wrote it.
    heads
        Of the attention.
    driver
        The ``ChooserConfig`` that it was trained with.
    training
        What else the JSON file says: configuration, curve, seeds, steps, hours, command.
    """
    described = policy_description(heads, to_mapping(driver), **training)
    atomic_write(target, save(read_zip(source)))
    atomic_write(target.with_suffix(".json"), json.dumps(described, indent=1, ensure_ascii=False) + "\n")
    load_choice_policy(target)  # it is read back


def export_drive_policy(run: Path, target: Path, *, command: str) -> None:
    """Write the best weights of a run of ``ppo`` as ``target`` (.safetensors, half precision), and its JSON file.

    Parameters
    ----------
    run
        The run's folder.
    command
        What it was trained by.
    """
    progress = json.loads((run / "progress.json").read_text(encoding="utf-8"))
    config = progress["config"]
    curve = [json.loads(line) for line in (run / "curve.jsonl").read_text(encoding="utf-8").splitlines()]
    described = {
        "format": FORMAT, "uncertainty": config["uncertainty"],
        "planning": {"goal_m": config["goal_m"], "turn_m": config["turn_m"]},
        "command": command, "config": config, "steps": progress["steps"], "hours": progress["wall_s"] / 3600.0,
        "curve": curve,
    }  # fmt: skip
    weights = {name: value.astype(np.float16) for name, value in load_file(run / "best.safetensors").items()}
    atomic_write(target, save(weights))
    atomic_write(target.with_suffix(".json"), json.dumps(described, indent=1, ensure_ascii=False) + "\n")
    load_drive_policy(target)  # it is read back
