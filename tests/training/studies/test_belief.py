"""Where a belief stops being true: the figures are those of the episode, and the files are there."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np
import pytest

from agents.base import Goal
from mecanum_env.env import ExploreEnv
from training.cli import main
from training.episodes import explore
from training.studies.belief import FILES, BeliefWitness, figures, rises


def test_rises_are_told_once_each() -> None:
    nees = np.full(300, 3.0)
    nees[100:] += 12.0
    nees[110:] += 12.0
    nees[250:] += 6.0  # too little: 2 in NEES / 3
    assert rises(nees.tolist()) == [100]


def test_the_figures_are_those_of_the_episode(tmp_path: Path) -> None:
    episode = explore.prepare(out=tmp_path, rooms="rectangular", slam="invariant-ekf", seed=3, max_steps=60)
    witness = BeliefWitness()
    witness.begin(episode.env)
    explore.run(episode, lambda **_: None, [witness])
    found = figures(witness, 0.1)
    metrics = episode.metrics()
    assert found["steps"] == metrics["steps"]
    assert found["nees_over_3"] == pytest.approx(metrics["anees"], rel=0.2)  # that counts the start, too
    assert found["ate_rmse_m"] == pytest.approx(metrics["ate_rmse_m"], rel=1e-9)
    kinds = found["nis_over_2"]
    assert set(kinds) <= {"wall", "wall end", "convex corner", "concave corner", "landmark"}
    assert kinds["wall"]["count"] > 60
    for figure in kinds.values():
        assert figure["count"] <= 50 or 0.05 < figure["mean"] < 3.0


@pytest.mark.parametrize("backend", ["invariant-ekf", "fastslam2"])
def test_the_command_leaves_its_files(backend: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "belief"
    out.mkdir()
    (out / "innovations.png").touch()  # another run's
    given = ["--rooms", "rectangular", "--slam", backend, "--max-steps", "25", "--out", str(out)]
    assert main(["study", "belief", *given]) == 0
    found = json.loads((out / "belief.json").read_text())
    told = capsys.readouterr().out
    assert "NEES / 3" in told
    # Particles have no innovations to show.
    shown = backend == "invariant-ekf"
    assert bool(found["nis_over_2"]) == bool(found["shown"]) == ("wall" in told) == shown
    assert {path.name for path in out.iterdir()} == {name for name in FILES if shown or name != "innovations.png"}


def test_ctrl_c_keeps_what_was_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = BeliefWitness.take

    def pressed_at_the_tenth(self: BeliefWitness, env: ExploreEnv, goal: Goal | None) -> None:
        take(self, env, goal)
        if len(self.nees) == 10:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(BeliefWitness, "take", pressed_at_the_tenth)
    assert main(["study", "belief", "--rooms", "rectangular", "--out", str(tmp_path / "belief")]) == 130
    found = json.loads((tmp_path / "belief" / "belief.json").read_text())
    assert found["end"] == "interrupted"
    assert found["steps"] == 9
