"""Paper C's study: figures and their JSON with tiny settings; peers that solve right."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from training.cli import main
from training.studies.paper_c import figures as paper_c
from training.studies.paper_c.figures import run_of
from training.studies.paper_c.odometry import accelerating, best, drives, errors
from training.studies.paper_c.work import METHODS, multiplications, reference, relative_deviation, solve

TINY = ["--runs", "2", "--episodes", "1", "--explorations", "1", "--steps", "3"]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "training.studies.paper_c.work.METHODS", {name: tuple(METHODS[name])[:2] for name in METHODS}
    )
    grid = {"constant_velocity": np.array([0.03]), "uniform_acceleration": np.array([1.0])}
    monkeypatch.setattr("training.studies.paper_c.odometry.PROCESS", grid)


def test_everything_is_written(small: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    del small
    assert main(["study", "paper-c", "--out", str(tmp_path / "out"), *TINY]) == 0
    told = json.loads(capsys.readouterr().out)
    result = json.loads((tmp_path / "out" / "paper_c.json").read_text("utf-8"))
    for name, row in told["covariance"].items():
        for recovery, figures in row.items():
            assert figures["max_relative"] < 1e-6, (name, recovery)
            assert figures["max_absolute"] < 1e-6, (name, recovery)
    assert {row["odometry_filter"] for row in result["odometry"]["explorations_test"]} == {
        "none", "differential-transform",
    }  # fmt: skip
    assert result["estimate"]["exact"]["position_rms_m"][0] == 0.0
    for name in ("figure_2", "figure_3", "work", "odometry"):
        image = cv2.imread(str(tmp_path / "out" / f"{name}.png"))
        assert image is not None
        assert image.shape[1] == 1000
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(paper_c._FILES)


@pytest.mark.parametrize("more", [["--runs", "0"], ["--seed", "-1"], ["--workers", "0"]])
def test_bad_input_is_one_line(more: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "paper-c", "--out", str(tmp_path / "out"), *more]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", METHODS)
def test_peers_solve_the_same_equation(method: str) -> None:
    run = run_of("uniform_acceleration")
    true = reference(run, np.array([run.t0, run.t1]), relative=1e-9)[1:]
    settings = {"Van Loan": 4000, "Hamiltonian": 400}
    cov, steps = solve(method, settings.get(method, 1e-7), run)
    assert steps == settings.get(method, steps) > 20
    allowed = {"Van Loan": 2e-2, "Hamiltonian": 1e-4}.get(method, 1e-5)
    assert relative_deviation(cov, true).max() < allowed
    if method != "Van Loan":  # whose first-order error alone is left
        finer, _ = solve(method, 800 if method == "Hamiltonian" else 1e-9, run)
        assert relative_deviation(finer, true).max() < max(0.3 * relative_deviation(cov, true).max(), 1e-7)


def test_multiplications_by_hand() -> None:
    """Of F = [[0, 1], [0, 0]]: F η + η Fᵀ takes η12 (twice the same) and η22; RK45 has 26 weights."""
    model = run_of("constant_velocity").model
    assert multiplications("series, 6", model) == 28 * 3 + 7 * (2 + 6)
    assert multiplications("Padé [3/3]", model) == 28 * 3 + 7 * (2 + 6) + 3 * (8 + 3)
    assert multiplications("RK45", model) == 6 * (2 + 6) + 26 * 3
    assert multiplications("series, 6", run_of("uniform_acceleration").model) == 28 * (3 + 4) + 7 * (2 + 6)


def test_stretches_are_where_the_robot_accelerates() -> None:
    driven = drives("nominal", seed=0, episodes=2)
    stretches = accelerating(driven)
    assert len(stretches) > 5
    speeds = np.linalg.norm(driven.true[..., :2], axis=2)
    changes = [np.ptp(speeds[e, a - 1 : b]) for e, a, b in stretches]
    assert np.median(changes) > 0.05
    exact = errors(driven, driven.true, stretches)
    assert max(exact.values()) < 1e-6
    rows = [{"noise": "nominal", "model": None, "process": None, **errors(driven, driven.measured, stretches)}]
    rows.append({**rows[0], "model": "constant_velocity", "process": 1.0, "velocity_rms_mm_s": 0.0})
    assert best(rows) == [{"model": "constant_velocity", "process": 1.0, "share_of_unfiltered": 0.5}]
