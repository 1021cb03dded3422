"""Trained policies between stable-baselines3's zip and the files that the package ships: safetensors and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import ppo, ppo_frontier
from agents.learned.choice import CANDIDATE, STATE
from agents.learned.choice_network import apart, joined
from agents.learned.chooser import ChooserConfig
from agents.learned.drive_memory import PlanSettings
from agents.learned.policy_files import write_policy
from slam.files import read_json
from slam.settings import from_mapping, to_mapping
from training.learning.choice_world import make_world
from training.learning.config import TrainConfig
from training.learning.ensemble import best_weights, curve_of
from training.learning.folder import save_model
from training.learning.networks import ChoicePolicy
from training.learning.ppo import make_model

__all__ = ["export_policy", "export_run", "join_policies", "write_zip"]


def export_policy(weights: Mapping[str, NDArray[np.float32]], target: Path, training: Mapping[str, Any]) -> None:
    """Write a policy of ``ppo-frontier`` as ``target`` (.safetensors, half precision) and the JSON file beside it.

    The latter says what ``training`` does; its ``config``, the training's, has how the policy drives.

    Raises
    ------
    ValueError
        Where weights and configuration do not fit together; an earlier policy there stays.
    """
    config = training["config"]
    driver = to_mapping(from_mapping(ChooserConfig, config["world"]["driver"]))
    described = {
        "format": ppo_frontier.FORMAT, "heads": config["heads"], "candidate": list(CANDIDATE),
        "state": list(STATE), "driver": driver, **training,
    }  # fmt: skip
    write_policy(target, weights, described, check=ppo_frontier.load_choice_policy)


def export_run(run: Path, target: Path) -> None:
    """Write the best policy of a run of ``ppo-frontier`` or ``ppo``; the JSON file says how it was trained.

    Raises
    ------
    ValueError
        Where the folder holds no run that got as far as an evaluation.
    """
    try:
        progress = read_json(run / "progress.json", nan=True)
        drives = progress["config"].get("policy") == "drive"
        config = TrainConfig() if drives else from_mapping(TrainConfig, progress["config"])
        curve = curve_of(config, run)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{run} holds no finished part of a run; train it, or go on with mecanum train --resume ({error})"
        ) from error
    if drives:
        _export_drive(run, target, progress, curve)
    else:
        export_policy(best_weights(config, run), target, _training(progress, curve))


def join_policies(sources: Sequence[Path], target: Path) -> None:
    """Write one policy of several of ``ppo-frontier``: all their networks choose together.

    They may differ in their seeds alone. The JSON file has the first one's configuration, all commands, and the
    curves one after the other.

    Raises
    ------
    ValueError
        Where one is no such policy, or another configuration's.
    """
    described, configs = [], []
    for path in sources:
        described.append(ppo_frontier.load_choice_policy(path)[2])
        if "config" not in described[-1]:
            raise ValueError(f"{path.with_suffix('.json')} does not say with which config it was trained")
        configs.append(replace(from_mapping(TrainConfig, described[-1]["config"]), seed=0))
        if configs[-1] != configs[0]:
            raise ValueError(f"{path} was trained otherwise than {sources[0]}: their configurations differ")
    members = [own for path in sources for own in apart(load_file(path))]
    try:
        training = {
            "command": "; ".join(dict.fromkeys(str(about.get("command", "")) for about in described)),
            "config": described[0]["config"], "steps": sum(int(about.get("steps", 0)) for about in described),
            "hours": round(sum(float(about.get("hours", 0.0)) for about in described), 3),
            "training_seeds": described[0].get("training_seeds"),
            "curve": [{"run": k} | line for k, it in enumerate(described, 1) for line in it.get("curve", [])],
        }  # fmt: skip
    except (OverflowError, TypeError) as error:
        raise ValueError(f"what a policy's JSON file says of its training is of another form: {error}") from error
    export_policy(joined(members), target, training)


def write_zip(source: Path, target: Path, member: int | None) -> None:
    """Write a policy of the package's format as a zip that ``MaskablePPO.load`` reads, to train on from.

    A zip holds one network: ``member`` says which of several that choose together, from 1.

    Raises
    ------
    ValueError
        Where ``source`` is no such policy, is of several networks and ``member`` none of them, or its JSON file
        does not say how it was trained.
    """
    count = len(ppo_frontier.load_choice_policy(source)[0].members)
    if not 1 <= (member or (1 if count == 1 else 0)) <= count:
        raise ValueError(f"{source} is of {count} network{'s' * (count > 1)}: choose one by --member 1 … {count}")
    described = read_json(source.with_suffix(".json"), nan=True)
    if "config" not in described:
        raise ValueError(f"{source.with_suffix('.json')} does not say with which config it was trained")
    config = from_mapping(TrainConfig, described["config"])
    env = DummyVecEnv([lambda: make_world(config.world)])
    model = make_model(config, env, config.ppo)
    network = cast("ChoicePolicy", model.policy).network
    weights = apart(load_file(source))[(member or 1) - 1]
    try:
        network.load_state_dict({name: torch.as_tensor(value) for name, value in weights.items()})
    except RuntimeError as error:
        about = source.with_suffix(".json")
        raise ValueError(f"the config in {about} is of other networks than {source}: {error}") from error
    save_model(model, target)
    env.close()


def _export_drive(run: Path, target: Path, progress: Mapping[str, Any], curve: Any) -> None:
    """Write the best weights of a run of ``ppo``, and the JSON file."""
    config = progress["config"]
    described = {
        "format": ppo.FORMAT, "uncertainty": config["uncertainty"],
        "planning": {name: config[name] for name in PlanSettings._fields},
        **_training(progress, curve),
    }  # fmt: skip
    write_policy(target, load_file(run / "best.safetensors"), described, check=ppo.load_drive_policy)


def _training(progress: Mapping[str, Any], curve: Any) -> dict[str, Any]:
    config = progress["config"]
    return {
        "command": progress["command"], "config": config, "steps": progress["steps"],
        "hours": round(progress["wall_s"] / 3600.0, 3), "training_seeds": config["world"]["seeds"], "curve": curve,
    }  # fmt: skip
