"""Faults are made, the study goes on where it stopped, and its figures are those of its episodes."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.ppo_frontier import SHIPPED
from mecanum_env.env import ExploreEnv
from slam.geometry import wrap
from training.cli import main
from training.studies.recovery import command
from training.studies.recovery.faults import FAULTS
from training.studies.recovery.figures import false_alarms, recovered, reliability, sum_up
from training.studies.recovery.runs import BINS, Row


def test_faults_are_what_they_say() -> None:
    env = ExploreEnv(rooms="apartment")
    env.reset(seed=1)
    rng = np.random.default_rng(2)
    before = env.truth.world.pose
    assert FAULTS["teleport"]().begin(env, rng)
    moved = env.truth.world.pose - before
    assert np.hypot(moved[0], moved[1]) == pytest.approx(1.0)
    assert abs(float(wrap(moved[2]))) == pytest.approx(math.radians(20.0))

    wheel = FAULTS["wheel"]()
    wheel.begin(env, rng)
    assert sorted(env.truth.world.grip) == [0.0, 1.0, 1.0, 1.0]
    wheel.end(env)
    assert (env.truth.world.grip == 1.0).all()

    blind = FAULTS["blind"]()
    blind.begin(env, rng)
    env.step(np.zeros(3, np.float32))
    assert np.isnan(env.scan.ranges).all()
    blind.end(env)
    env.step(np.zeros(3, np.float32))
    assert np.isfinite(env.scan.ranges).any()
    assert FAULTS["none"]().begin(env, rng)


def test_a_wheel_without_grip_turns_the_robot() -> None:
    turned = []
    for grip in (1.0, 0.0):
        env = ExploreEnv(rooms="rectangular", noise={"preset": "nominal", "radius_error": 0.0, "base_error": 0.0})
        env.reset(seed=1)
        env.truth.world.grip[0] = grip
        for _ in range(12):
            env.step(np.array([0.4, 0.0, 0.0], np.float32))
        turned.append(abs(float(env.truth.pose[2])))
    assert turned[0] < 0.3 * turned[1]


def a_row(**changes: Any) -> Row:
    bins = len(BINS) - 1
    row = {
        "possible": True, "recovered_s": 2.0, "precision": 0.99, "precision_before": 1.0, "worst_m": 1.0,
        "contacts": 0, "seconds": 1800.0, "lost": 1, "found": 1, "lost_s": 0.4, "count": [0] * bins,
        "true": [0] * bins, "sum": [0.0] * bins,
    }  # fmt: skip
    return row | changes


def test_what_counts_as_recovered() -> None:
    assert recovered(a_row())
    assert not recovered(a_row(recovered_s=None))
    assert not recovered(a_row(recovered_s=20.1))
    assert not recovered(a_row(precision=0.9))
    found = sum_up([a_row(), a_row(recovered_s=None), {"possible": False}])
    assert (found["episodes"], found["impossible"], found["recovered"]) == (2, 1, 1)
    assert not recovered(a_row(precision_before=0.99, precision=0.9)) and recovered(a_row(precision=None))
    never = sum_up([a_row(recovered_s=0.8), a_row(recovered_s=None), a_row(recovered_s=21.0)])
    assert (never["recovered_s_median"], never["recovered_s_max"]) == (None, 0.8)
    assert false_alarms([a_row(), a_row(lost=0)]) == {"hours": 1.0, "times_lost": 1, "in_10_hours": 10.0}


def test_a_reliability_diagram_of_two_bins() -> None:
    count, true, total = np.zeros(len(BINS) - 1), np.zeros(len(BINS) - 1), np.zeros(len(BINS) - 1)
    count[[0, -1]], true[[0, -1]], total[[0, -1]] = (100, 300), (10, 297), (2.0, 297.0)
    found = reliability([a_row(count=count.tolist(), true=true.tolist(), sum=total.tolist())])
    assert found["health"][0] == pytest.approx(0.02)
    assert found["true"][0] == pytest.approx(0.1)
    assert found["true"][1] is None
    assert found["expected_error"] == pytest.approx(0.25 * 0.08)


def test_the_command_goes_on_where_it_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[Any] = []

    def quick(job: Any) -> Row:
        done.append(job)
        bins = len(BINS) - 1
        return a_row(count=[1] * bins, true=[1] * bins, sum=[edge + 1e-3 for edge in BINS[:-1]])

    monkeypatch.setattr(command, "run_job", quick)
    out = tmp_path / "recovery"
    given = ["study", "recovery", "--workers", "1", "--out", str(out)]
    assert main([*given, "--seeds", "1"]) == 0
    assert len(done) == len(FAULTS)
    assert main([*given, "--seeds", "1:2"]) == 0
    assert len(done) == 2 * len(FAULTS)
    told = capsys.readouterr().out
    assert "teleport     2 of 2" in told
    found = json.loads((out / "recovery.json").read_text())
    assert found["invariant-ekf"]["false_alarms"]["times_lost"] == 2
    assert {path.name for path in out.iterdir()} == {*command.FILES, command.STORE, "settings.json"}
    # Rows of one policy, or plan, are none of another's of the same name.
    policy, elsewhere = tmp_path / "mine.safetensors", tmp_path / "elsewhere"
    asked = [*given[:-1], str(elsewhere), "--seeds", "1", "--agent", str(policy)]
    for name in ("ppo-frontier", "ppo"):
        for suffix in (".safetensors", ".json"):
            shutil.copy(SHIPPED.with_name(f"{name}{suffix}"), policy.with_suffix(suffix))
        assert main(asked) == (0 if name == "ppo-frontier" else 2)
    assert "holds runs with files" in capsys.readouterr().err
    # Nor are they of the same weights with a driver that is set otherwise.
    about = json.loads(SHIPPED.with_suffix(".json").read_text("utf-8"))
    about["driver"]["control"]["speed_share"] = 0.5
    shutil.copy(SHIPPED, policy)
    policy.with_suffix(".json").write_text(json.dumps(about), "utf-8")
    assert main(asked) == 2
    assert "holds runs with files" in capsys.readouterr().err


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["study", "recovery", "--seeds", "x", "--out", str(tmp_path)]) == 2
    assert "seeds" in capsys.readouterr().err and not any(tmp_path.iterdir())
    (tmp_path / "words.md").write_text("no plan")
    for rooms in ("aprtment", str(tmp_path / "words.md")):
        assert main(["study", "recovery", "--rooms", rooms, "--out", str(tmp_path / "out")]) == 2
        assert "mecanum study recovery: " in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert main(["study", "recovery", "--faults", "telport", "--out", str(tmp_path)]) == 2
    assert "teleport" in capsys.readouterr().err
