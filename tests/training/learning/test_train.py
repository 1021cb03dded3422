"""A training run: broken off and resumed it is the one that was not; what is wrong is said before it begins."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

import torch

from agents.learned.choice import CANDIDATE, STATE
from slam.settings import from_mapping, to_mapping
from tests.training.learning.small_runs import REHEARSED, SMALL, Killed, curve, here, run, same_weights
from training.cli import main
from training.cli.train import CONFIGS, _read
from training.learning.config import TrainConfig
from training.learning.ensemble import EnsembleRun
from training.learning.networks import read_zip
from training.learning.ppo import Run


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

    with here(), pytest.raises(Killed):
        Dies(from_mapping(TrainConfig, REHEARSED), tmp_path, workers=1, log=lambda _: None).train()
    run(tmp_path, config=REHEARSED, workers=1)
    for name in ("checkpoint.zip", "best.zip"):
        same_weights(read_zip(rehearsed[0] / name), read_zip(tmp_path / name))
    steps = [json.loads((out / "progress.json").read_text())["steps"] for out in (rehearsed[0], tmp_path)]
    assert steps[0] == steps[1] == 48


def test_a_run_whose_files_are_damaged_or_missing_is_refused(tmp_path):
    with pytest.raises(Killed):
        run(tmp_path, kill_after="ppo, chunk 1 ", workers=1)
    checkpoint, curve_file = tmp_path / "checkpoint.zip", tmp_path / "curve.jsonl"
    whole = curve_file.read_bytes()
    for torn in (b'{"stage": "ppo", "st', b"[1]", b"5", b"\xff"):
        curve_file.write_bytes(whole + torn)
        with pytest.raises(ValueError, match=r"curve\.jsonl is damaged in line 2; remove that line, or .* --out$"):
            run(tmp_path)
    curve_file.write_bytes(whole)
    checkpoint.write_bytes(b"no zip")
    with pytest.raises(ValueError, match=r"checkpoint\.zip is no checkpoint of a run; choose another --out$"):
        run(tmp_path)
    checkpoint.unlink()
    with pytest.raises(ValueError, match=r"checkpoint\.zip is missing, .*; choose another --out$"):
        run(tmp_path)


@pytest.mark.parametrize("left", ["checkpoint.zip", "curve.jsonl", "maps-0.npz", "control-1.npz", "member-1"])
@pytest.mark.parametrize("resume", [[], ["--resume"]])
def test_files_of_a_run_without_its_note_are_not_taken_up(tmp_path, capsys, left, resume):
    (tmp_path / left).write_bytes(b"")
    assert main(["train", *resume, "--out", str(tmp_path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"mecanum train: {tmp_path} holds {left} of a run, but no progress.json; empty it, or choose another --out"
    )


def test_a_member_that_cannot_go_on_is_said_before_any_does(tmp_path):
    config = from_mapping(TrainConfig, SMALL | {"members": 2})
    out, member = tmp_path / "out", tmp_path / "out" / "member-2"
    member.mkdir(parents=True)
    (out / "progress.json").write_text(json.dumps({"config": json.loads(json.dumps(to_mapping(config)))}))
    (member / "checkpoint.zip").write_bytes(b"")
    with pytest.raises(ValueError, match=r"member-2 holds checkpoint\.zip of a run, but no progress\.json"):
        EnsembleRun(config, out, workers=1, log=print)
    (member / "checkpoint.zip").unlink()
    EnsembleRun(config, out, workers=1, log=print)


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
        (["--config", "{folder}/noises.toml"], "ppo.environments must be 2 at least, one for each"),
        (["--config", "{folder}/gamma.toml"], "ppo.gamma must be in [1e-6, 1], got 0.0"),
        (["--config", "{folder}/shares.toml"], "lessons.teacher_shares must have one at least"),
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
    noises = "[world]\nnoises = ['nominal', 'slippery']\n[ppo]\nenvironments = 1"
    (tmp_path / "noises.toml").write_text(noises)
    (tmp_path / "gamma.toml").write_text("[ppo]\ngamma = 0.0")
    (tmp_path / "shares.toml").write_text("policy = 'drive'\n[lessons]\nteacher_shares = []\n[ppo]\nsteps = 0")
    arguments = [a.format(folder=tmp_path) for a in arguments]
    assert main(["train", *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1
    assert not (tmp_path / "out").exists()


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
