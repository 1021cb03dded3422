"""Policies from runs, to and from zips, of several networks; what is damaged or does not fit."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import torch

from agents.ppo_frontier import SHIPPED
from slam.settings import from_mapping
from tests.training.learning.small_runs import REHEARSED, SMALL, Killed, halved, here, same_weights
from training.cli import main
from training.learning.config import TrainConfig
from training.learning.ensemble import EnsembleRun
from training.learning.networks import read_zip
from training.learning.ppo import Run


def test_a_policy_that_is_joined_with_others_is_not_overwritten(tmp_path, capsys):
    one, two = tmp_path / "one.safetensors", tmp_path / "two.safetensors"
    for path in (one, two):
        for suffix in (".safetensors", ".json"):
            path.with_suffix(suffix).write_bytes(SHIPPED.with_suffix(suffix).read_bytes())
    assert main(["policy", str(one), str(two), str(tmp_path / "." / "one.safetensors")]) == 2
    assert "would be lost" in capsys.readouterr().err
    assert one.read_bytes() == SHIPPED.read_bytes()


def test_a_policy_goes_from_a_run_to_the_packages_files_to_a_zip_and_back(tmp_path, capsys):
    from sb3_contrib import MaskablePPO

    from agents.learned.chooser import ChooserConfig
    from agents.ppo_frontier import PpoFrontier, load_choice_policy
    from slam.settings import to_mapping

    drive = {"control": {"near_wall_m_s": 0.6}}
    config = SMALL | {
        "world": {"rooms": ["rectangular"], "driver": drive},
        "ppo": SMALL["ppo"] | {"steps": 16},
    }  # fmt: skip
    run_out, mine = tmp_path / "run", tmp_path / "mine.safetensors"
    with here():
        Run(from_mapping(TrainConfig, config), run_out, workers=1, log=lambda _: None, command="as typed").train()
    assert main(["policy", str(run_out), str(mine)]) == 0
    _, driver, about = load_choice_policy(mine)
    assert about["steps"] == 16 and about["command"] == "as typed" and about["curve"]
    assert driver == from_mapping(ChooserConfig, drive) and driver.control.near_wall_m_s == 0.6
    agent = PpoFrontier({"policy": str(mine)})
    same_weights(halved(read_zip(run_out / "best.zip")), agent._network.members[0]._weights)
    assert to_mapping(agent.config)["control"]["near_wall_m_s"] == 0.6
    # To a zip, which stable-baselines3 reads, and back.
    assert main(["policy", str(mine), str(tmp_path / "mine.zip")]) == 0
    same_weights(halved(read_zip(run_out / "best.zip")), read_zip(tmp_path / "mine.zip"))
    assert MaskablePPO.load(tmp_path / "mine.zip", device="cpu").policy.network.width == 64
    again = tmp_path / "again.safetensors"
    assert main(["policy", str(tmp_path / "mine.zip"), str(again), "--like", str(mine.with_suffix(".json"))]) == 0
    assert again.read_bytes() == mine.read_bytes()
    assert again.with_suffix(".json").read_text() == mine.with_suffix(".json").read_text()
    # What is wrong is said.
    capsys.readouterr()
    a_folder, foreign = tmp_path / "folder.zip", tmp_path / "foreign.zip"
    end_to_end = SHIPPED.with_name("ppo.json")
    a_folder.mkdir()
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("policy.pth", pickle.dumps(Path))
    for arguments, message in [
        ([mine, tmp_path / "x.safetensors"], "cannot make"),
        ([tmp_path / "none", tmp_path / "x.safetensors"], "there is no"),
        ([tmp_path / "mine.zip", tmp_path / "x.safetensors"], "--like belongs to a .zip"),
        ([tmp_path / "mine.zip", tmp_path / "x.safetensors", "--like", mine], "is damaged"),
        ([tmp_path, tmp_path / "x.safetensors"], "holds no finished part of a run"),
        ([tmp_path / "mine.zip", tmp_path / "x.safetensors", "--like", end_to_end], "unknown key"),
        ([foreign, tmp_path / "x.safetensors", "--like", mine.with_suffix(".json")], "holds more than weights"),
        ([mine, a_folder], "it is a folder"),
    ]:
        assert main(["policy", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "x.safetensors").exists()


def test_members_are_trained_apart_and_choose_together(tmp_path, capsys):
    from agents.ppo_frontier import load_choice_policy

    config = SMALL | {
        "members": 2, "world": {"rooms": ["rectangular"]},
        "rehearsal": REHEARSED["rehearsal"] | {"steps": 16}, "ppo": {"steps": 0},
    }  # fmt: skip
    made = from_mapping(TrainConfig, config)
    out, mine = tmp_path / "run", tmp_path / "mine.safetensors"
    said: list[str] = []

    def log(text: str) -> None:
        said.append(text)
        if text.startswith("member-2: rehearsal, chunk 1"):
            raise Killed

    with pytest.raises(Killed):
        EnsembleRun(made, out, workers=2, log=log, command="as typed").train()
    with pytest.raises(ValueError, match="another configuration"):
        EnsembleRun(from_mapping(TrainConfig, config | {"seed": 2}), out, workers=2, log=print)
    # With workers to spare each member has processes for its environments.
    EnsembleRun(made, out, workers=4, log=said.append, command="as typed").train()
    assert sum(text.startswith("member-2: rehearsal, chunk 1") for text in said) == 1, "it was checkpointed"
    assert said[-1].startswith("evaluation: stage all members")
    assert main(["policy", str(out), str(mine)]) == 0
    network, _, about = load_choice_policy(mine)
    assert len(network.members) == 2 and about["steps"] == 32 and about["command"] == "as typed"
    stages = [(line.get("member"), line["stage"]) for line in about["curve"]]
    for name in ("member-1", "member-2"):
        assert stages.count((name, "ppo")) == 1, "it is tried in the whole environment, where nothing is learned"
    assert stages[-1] == (None, "all members")
    assert about["curve"][-1]["steps"] == 32
    for k, member in enumerate(network.members, start=1):
        same_weights(halved(read_zip(out / f"member-{k}" / "best.zip")), member._weights)
    assert not np.array_equal(network.members[0]._weights["row.weight"], network.members[1]._weights["row.weight"])
    # Several policies become one.
    more = tmp_path / "more.safetensors"
    assert main(["policy", str(mine), str(SHIPPED), str(mine), str(more)]) == 2, "of other configurations"
    assert "was trained otherwise than" in capsys.readouterr().err and not more.exists()
    assert main(["policy", str(mine), str(mine), str(more)]) == 0
    together, _, said_of = load_choice_policy(more)
    assert len(together.members) == 4 and said_of["steps"] == 64 and said_of["command"] == "as typed"
    for k, member in enumerate(together.members):
        same_weights(member._weights, network.members[k % 2]._weights)
    assert main(["policy", str(mine), str(mine), str(tmp_path / "x.zip")]) == 2
    assert main(["policy", str(mine)]) == 2
    # A zip holds one of them.
    zipped = tmp_path / "second.zip"
    assert main(["policy", str(mine), str(zipped), "--member", "2"]) == 0
    same_weights(read_zip(zipped), network.members[1]._weights)
    capsys.readouterr()
    for arguments, message in [
        ([mine, tmp_path / "x.zip"], "is of 2 networks: choose one by --member 1 … 2"),
        ([mine, tmp_path / "x.zip", "--member", "3"], "choose one by --member"),
        ([out, tmp_path / "x.safetensors", "--member", "1"], "--member says which network"),
    ]:
        assert main(["policy", *map(str, arguments)]) == 2
        error = capsys.readouterr().err
        assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "x.zip").exists()


def test_what_does_not_fit_is_refused_and_leaves_the_policy_that_was_there(tmp_path, capsys):
    about = json.loads(SHIPPED.with_suffix(".json").read_text())
    zipped, mine, like = tmp_path / "one.zip", tmp_path / "mine.safetensors", tmp_path / "like.json"
    assert main(["policy", str(SHIPPED), str(zipped), "--member", "1"]) == 0
    assert main(["policy", str(zipped), str(mine), "--like", str(SHIPPED.with_suffix(".json"))]) == 0
    before = [mine.with_suffix(suffix).read_bytes() for suffix in (".safetensors", ".json")]
    capsys.readouterr()
    like.write_text(json.dumps(about | {"config": about["config"] | {"heads": 2}}))
    assert main(["policy", str(zipped), str(mine), "--like", str(like)]) == 2
    error = capsys.readouterr().err
    assert f"policy {mine} does not fit together" in error and len(error.splitlines()) == 1
    assert [mine.with_suffix(suffix).read_bytes() for suffix in (".safetensors", ".json")] == before
    # The weights are of another width than the file beside them says.
    mine.with_suffix(".json").write_text(json.dumps(about | {"config": about["config"] | {"width": 32}}))
    assert main(["policy", str(mine), str(tmp_path / "x.zip")]) == 2
    error = capsys.readouterr().err
    assert "is of other networks than" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "x.zip").exists()


def test_a_damaged_policy_is_named(tmp_path):
    from agents.ppo_frontier import load_choice_policy

    target = tmp_path / "mine.safetensors"
    target.write_bytes(b"nonsense")
    target.with_suffix(".json").write_text("{}")
    with pytest.raises(ValueError, match="no zip that stable-baselines3 wrote"):
        read_zip(target)
    with pytest.raises(ValueError, match="cannot be read"):
        load_choice_policy(target)
    with pytest.raises(ValueError, match="is missing"):
        load_choice_policy(tmp_path / "none.safetensors")


INSIDE = "features_extractor.network.a"
NO_WEIGHTS = [
    [1, 2], {3: 3}, torch.zeros(3), {INSIDE: 3}, {INSIDE: torch.zeros(3, dtype=torch.bfloat16)},
    {INSIDE: torch.eye(3).to_sparse()},
]  # fmt: skip


@pytest.mark.parametrize("what", [b"", b"abc" * 100, *NO_WEIGHTS], ids=range(2 + len(NO_WEIGHTS)))
def test_a_zip_of_anything_else_is_refused(what, tmp_path):
    if not isinstance(what, bytes):
        buffer = io.BytesIO()
        torch.save(what, buffer)
        what = buffer.getvalue()
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("policy.pth", what)
    with pytest.raises(ValueError, match=r"a\.zip (holds|is no zip)"):
        read_zip(tmp_path / "a.zip")


def test_a_damaged_zip_is_refused(tmp_path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.pth", np.random.default_rng(0).integers(0, 9, 5000).astype(np.uint8).tobytes())
    data = bytearray(path.read_bytes())
    data[100:140] = bytes(40)
    path.write_bytes(data)
    with pytest.raises(ValueError, match="is no zip that stable-baselines3 wrote"):
        read_zip(path)
