"""A training run: broken off and resumed it is the one that was not; what it writes is read back by the agent."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from slam.settings import from_mapping
from training.cli import main
from training.cli_train import CONFIGS, _read
from training.policies import export_policy, read_zip
from training.ppo import Run
from training.train_config import TrainConfig

SMALL = {
    "world": {"rooms": ["rectangular"]},
    "imitation": {"episodes": 3, "epochs": 1},
    "ppo": {"steps": 48, "environments": 2, "n_steps": 8, "chunk": 1, "batch_size": 16},
    "evaluation": {"episodes": 1, "every": 2},
}


class Killed(Exception):
    pass


def run(out: Path, *, kill_after: int | None = None) -> list[str]:
    said: list[str] = []

    def log(text: str) -> None:
        said.append(text)
        if kill_after is not None and text.startswith(f"chunk {kill_after} "):
            raise Killed

    Run(from_mapping(TrainConfig, SMALL), out, workers=2, log=log).train()
    return said


def test_a_run_that_was_killed_and_resumed_is_the_one_that_was_not(tmp_path):
    said = run(tmp_path / "whole")
    assert any(text.startswith("imitation: epoch 1") for text in said)
    with pytest.raises(Killed):
        run(tmp_path / "parts", kill_after=2)
    again = run(tmp_path / "parts")
    assert not any(text.startswith(("imitation", "chunk 1 ", "chunk 2 ")) for text in again)
    one, other = (read_zip(tmp_path / name / "checkpoint.zip") for name in ("whole", "parts"))
    for name, weights in one.items():
        np.testing.assert_array_equal(weights, other[name])
    curves = [
        [json.loads(line) for line in (tmp_path / name / "curve.jsonl").read_text().splitlines()]
        for name in ("whole", "parts")
    ]
    assert [line["time_to_95_s"] for line in curves[0]] == [line["time_to_95_s"] for line in curves[1]]
    with pytest.raises(ValueError, match="another configuration"):
        Run(from_mapping(TrainConfig, SMALL | {"seed": 2}), tmp_path / "parts", workers=1, log=print)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_the_configurations_that_come_with_the_package_are_valid(path):
    _read(path.stem, None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config", "ppo-frontie"], "did you mean ppo-frontier?"),
        (["--config", "{folder}/bad.toml"], "cannot read"),
        (["--config", "{folder}/wrong.toml"], "unknown key of TrainConfig"),
        (["--config", "{folder}/seeds.toml"], "training seeds"),
        (["--resume"], "holds no run to go on with"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, capsys, arguments, message):
    (tmp_path / "bad.toml").write_text("seed = ")
    (tmp_path / "wrong.toml").write_text("sede = 1")
    (tmp_path / "seeds.toml").write_text("[world]\nseeds = [0, 10000]")
    arguments = [a.format(folder=tmp_path) for a in arguments]
    assert main(["train", *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_an_exported_policy_chooses_as_the_one_in_the_zip(tmp_path):
    from agents.chooser import ChooserConfig
    from agents.policy import PpoFrontier, load_choice_policy

    config = SMALL | {"ppo": SMALL["ppo"] | {"steps": 16}, "imitation": {"episodes": 0}}
    Run(from_mapping(TrainConfig, config), tmp_path, workers=1, log=lambda _: None).train()
    target = tmp_path / "mine.safetensors"
    export_policy(tmp_path / "checkpoint.zip", target, heads=4, driver=ChooserConfig(), training={"steps": 16})
    _, driver, about = load_choice_policy(target)
    assert about["steps"] == 16 and driver == ChooserConfig()
    agent = PpoFrontier({"policy": str(target)})
    for name, weights in read_zip(tmp_path / "checkpoint.zip").items():
        np.testing.assert_array_equal(agent._network._weights[name], weights)
    with pytest.raises(ValueError, match="no zip that stable-baselines3 wrote"):
        read_zip(target)
    target.write_bytes(b"nonsense")
    with pytest.raises(ValueError, match="cannot be read"):
        load_choice_policy(target)
    with pytest.raises(ValueError, match=r"policy must be the path of a \.safetensors file"):
        PpoFrontier()
    with pytest.raises(ValueError, match="is missing"):
        load_choice_policy(tmp_path / "none.safetensors")
