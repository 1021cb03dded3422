"""A training run: broken off and resumed it is the one that was not; what it writes is read back by the agent."""

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

from agents.learned.choice import CANDIDATE, STATE
from agents.ppo_frontier import SHIPPED
from slam.settings import from_mapping
from training.cli import main
from training.cli.train import CONFIGS, _read
from training.learning.config import TrainConfig
from training.learning.ensemble import EnsembleRun
from training.learning.networks import read_zip
from training.learning.ppo import Run

SMALL = {
    "world": {"rooms": ["rectangular"]},
    "ppo": {"steps": 48, "environments": 2, "n_steps": 8, "chunk": 1, "batch_size": 16},
    "evaluation": {"episodes": 1, "every": 2},
}


class Killed(Exception):
    pass


REHEARSED = SMALL | {
    "rehearsal": {
        "steps": 32, "environments": 2, "n_steps": 8, "chunk": 1, "batch_size": 16, "every": 2, "episodes": 1,
        "shaping_s_m": 1.3,
    },
    "ppo": SMALL["ppo"] | {"steps": 16},
}  # fmt: skip


def run(
    out: Path, *, kill_after: str | None = None, config: dict = SMALL, workers: int = 2, device: str = "cpu"
) -> list[str]:
    said: list[str] = []

    def log(text: str) -> None:
        said.append(text)
        if kill_after is not None and text.startswith(kill_after):
            raise Killed

    Run(from_mapping(TrainConfig, config), out, workers=workers, log=log, device=device).train()
    return said


def curve(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "curve.jsonl").read_text().splitlines()]


def test_a_run_that_was_killed_and_resumed_is_the_one_that_was_not(tmp_path):
    run(tmp_path / "whole", workers=1)
    with pytest.raises(Killed):
        run(tmp_path / "parts", kill_after="ppo, chunk 2 ")
    again = run(tmp_path / "parts", workers=1)
    assert not any(text.startswith(("ppo, chunk 1 ", "ppo, chunk 2 ")) for text in again)
    one, other = (read_zip(tmp_path / name / "checkpoint.zip") for name in ("whole", "parts"))
    same_weights(one, other)
    times = [[line["time_to_95_s"] for line in curve(tmp_path / name)] for name in ("whole", "parts")]
    assert times[0] == times[1]
    with pytest.raises(ValueError, match="another configuration"):
        Run(from_mapping(TrainConfig, SMALL | {"seed": 2}), tmp_path / "parts", workers=1, log=print)
    assert run(tmp_path / "parts") == [], "what is done is left"


@pytest.fixture(scope="module")
def rehearsed(tmp_path_factory):
    """A run that was not killed, in several processes; those beside it are in one."""
    out = tmp_path_factory.mktemp("rehearsed") / "whole"
    return out, run(out, config=REHEARSED)


def test_a_rehearsal_comes_first(rehearsed):
    out, said = rehearsed
    chunks = [text.partition(":")[0] for text in said if "chunk" in text]
    assert chunks == ["rehearsal, chunk 1 of 2", "rehearsal, chunk 2 of 2", "ppo, chunk 1 of 1"]
    lines = curve(out)
    assert [line["stage"] for line in lines] == ["rehearsal", "rehearsal", "ppo", "ppo"]
    assert [line["steps"] for line in lines] == [0, 32, 32, 48]
    # The best is of the last stage: seconds of a rehearsal are others.
    progress = json.loads((out / "progress.json").read_text())
    assert progress["best_in"] == "ppo"
    assert progress["best"] == min(line["time_to_95_s"] for line in lines[2:])


@pytest.mark.parametrize("kill_after", ["rehearsal, chunk 1 ", "rehearsal, chunk 2 "])
def test_a_run_killed_in_a_rehearsal_is_the_one_that_was_not(tmp_path, rehearsed, kill_after):
    with pytest.raises(Killed):
        run(tmp_path, kill_after=kill_after, config=REHEARSED, workers=1)
    # What the rehearsal has no use for weighs nothing until there is something to learn from.
    weights = read_zip(tmp_path / "checkpoint.zip")
    unused = [CANDIDATE.index(name) for name in ("corners", "walls", "sigma_left")]
    assert not weights["row.weight"][:, unused].any()
    assert not weights["state.weight"][:, [STATE.index(name) for name in ("sigma_m", "sigma_rad")]].any()
    run(tmp_path, config=REHEARSED, workers=1)
    one, other = (read_zip(out / "checkpoint.zip") for out in (rehearsed[0], tmp_path))
    same_weights(one, other)
    assert one["row.weight"][:, unused].any()
    times = [[line["time_to_95_s"] for line in curve(out)] for out in (rehearsed[0], tmp_path)]
    assert times[0] == times[1]


@pytest.mark.parametrize("chunk", [1, 2, 3])  # in a rehearsal, at its end, and after it
def test_a_run_killed_between_a_checkpoint_and_its_note_is_the_one_that_was_not(tmp_path, rehearsed, chunk):
    class Dies(Run):
        def _keep(self, **progress):
            if progress.get("chunk") == chunk:
                raise Killed
            super()._keep(**progress)

    with pytest.raises(Killed):
        Dies(from_mapping(TrainConfig, REHEARSED), tmp_path, workers=1, log=lambda _: None).train()
    run(tmp_path, config=REHEARSED, workers=1)
    for name in ("checkpoint.zip", "best.zip"):
        same_weights(read_zip(rehearsed[0] / name), read_zip(tmp_path / name))
    steps = [json.loads((out / "progress.json").read_text())["steps"] for out in (rehearsed[0], tmp_path)]
    assert steps[0] == steps[1] == 48


def test_a_checkpoint_that_is_none_is_refused(tmp_path):
    with pytest.raises(Killed):
        run(tmp_path, kill_after="ppo, chunk 1 ", workers=1)
    (tmp_path / "checkpoint.zip").write_bytes(b"no zip")
    with pytest.raises(ValueError, match=r"checkpoint\.zip is no checkpoint of a run"):
        run(tmp_path, workers=1)


@pytest.mark.parametrize("note", ["null", "[]", '"x"', '{"chunk": "a"}', '{"chunk": -3}', '{"wall_s": null}'])
def test_a_note_that_is_none_is_refused(tmp_path, note):
    (tmp_path / "progress.json").write_text(note)
    with pytest.raises(ValueError, match=r"progress\.json is damaged: .*; choose another --out$"):
        run(tmp_path)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.toml")), ids=lambda path: path.stem)
def test_the_configurations_that_come_with_the_package_are_valid(path):
    _read(path.stem, None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config", "ppo-frontie"], "did you mean ppo-frontier?"),
        (["--config", "{folder}/bad.toml"], "not TOML"),
        (["--config", "{folder}/wrong.toml"], "unknown key of TrainConfig"),
        (["--config", "{folder}/seeds.toml"], "in [0, 999]"),
        (["--config", "{folder}/rooms.toml"], "rooms must be a list"),
        (["--config", "{folder}/three.toml"], "seeds must be a list of 2"),
        (["--config", "{folder}/heads.toml"], "width must be a multiple of heads, got 64 and 5"),
        (["--config", "{folder}/alone.toml"], "PpoConfig.batch_size must be 2 at least"),
        (["--config", "{folder}/left.toml"], "leave no single decision of a rollout's 16"),
        (["--config", "{folder}/slam.toml"], "did you mean 'ekf'?"),
        (["--config", "{folder}/driver.toml"], "driver.choice.patch_cells must be a whole number"),
        (["--resume"], "holds no run to go on with"),
    ],
)
def test_the_command_says_what_is_wrong(tmp_path, capsys, arguments, message):
    (tmp_path / "bad.toml").write_text("seed = ")
    (tmp_path / "wrong.toml").write_text("sede = 1")
    (tmp_path / "seeds.toml").write_text("[world]\nseeds = [0, 10000]")
    (tmp_path / "rooms.toml").write_text("[world]\nrooms = 5")
    (tmp_path / "three.toml").write_text("[world]\nseeds = [0, 1, 2]")
    (tmp_path / "heads.toml").write_text("heads = 5")
    (tmp_path / "alone.toml").write_text("[ppo]\nbatch_size = 1")
    (tmp_path / "left.toml").write_text("[ppo]\nn_steps = 8\nenvironments = 2\nbatch_size = 15")
    (tmp_path / "slam.toml").write_text("[world]\nslam = 'ekff'")
    (tmp_path / "driver.toml").write_text("[world.driver.choice]\npatch_cells = 300")
    arguments = [a.format(folder=tmp_path) for a in arguments]
    assert main(["train", *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_a_policy_that_is_joined_with_others_is_not_overwritten(tmp_path, capsys):
    one, two = tmp_path / "one.safetensors", tmp_path / "two.safetensors"
    for path in (one, two):
        for suffix in (".safetensors", ".json"):
            path.with_suffix(suffix).write_bytes(SHIPPED.with_suffix(suffix).read_bytes())
    assert main(["policy", str(one), str(two), str(tmp_path / "." / "one.safetensors")]) == 2
    assert "would be lost" in capsys.readouterr().err
    assert one.read_bytes() == SHIPPED.read_bytes()


def same_weights(one, other):
    assert one.keys() == other.keys()
    for name, weights in one.items():
        np.testing.assert_array_equal(weights, other[name])


def halved(weights):
    """As a policy's file has them."""
    return {name: value.astype(np.float16).astype(np.float32) for name, value in weights.items()}


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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
def test_what_is_learned_on_a_gpu_goes_on_on_a_processor(tmp_path):
    with pytest.raises(Killed):
        run(tmp_path, kill_after="rehearsal, chunk 1 ", config=REHEARSED, device="cuda")
    learned = read_zip(tmp_path / "checkpoint.zip")
    assert learned["score.weight"].any(), "it begins with none"
    run(tmp_path, config=REHEARSED)
    assert all(np.isfinite(values).all() for values in read_zip(tmp_path / "best.zip").values())


@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here")
def test_a_gpu_that_is_not_there_is_said_before_anything_is_written(tmp_path, capsys):
    for name in ("cuda", "cuda:1", "tpu"):
        assert main(["train", "--device", name, "--out", str(tmp_path / "run")]) == 2
        error = capsys.readouterr().err
        assert f"--device {name}: torch finds cpu here" in error and len(error.splitlines()) == 1
    assert not (tmp_path / "run").exists()


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
