"""``mecanum consistency``: worlds whose noise is the declared one, runs that are kept, figures with their keys."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import slam
from slam.geometry import inverse, transform_points, wrap
from slam.metrics.measures import nees_band
from slam.motion import move
from tests.training.cli.test_bad_input import refused
from training.cli import main
from training.runs.campaign import run_all
from training.runs.errors import Interrupted
from training.studies import consistency
from training.studies.circle_world import WORLDS, LandmarkWorld, drive, simulate
from training.studies.paper_b import floor_of, follow_filter, paper_b

KEYS = {"anees_pose", "fraction_in_band", "nis_mean", "runs", "steps"}


def small(out: Path, *more: str) -> list[str]:
    return [
        "consistency",
        "--slam",
        "ekf",
        "--runs",
        "3",
        "--steps",
        "20",
        "--workers",
        "1",
        "--out",
        str(out),
        *more,
    ]


def measure(out: Path, capsys: pytest.CaptureFixture[str], *more: str) -> dict[str, Any]:
    assert main([*small(out), "--json", *more]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


# ---- the worlds ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", WORLDS)
def test_the_noise_is_what_the_filter_is_told(name: str) -> None:
    """Odometry and observations, compared with the truth, have the covariances that go to the backend."""
    world = WORLDS[name]
    noise = slam.make("ekf", config=world.backend_settings()).config.odometry
    path = world.path(1500)
    pose, odometry, seen = None, [], []
    for k, step in enumerate(simulate(world, 7, 1500)):
        if pose is not None:
            # The true twist, from the poses, by the filter's own motion model.
            np.testing.assert_allclose(
                move(pose, true_twist(pose, step.true_pose, world.dt), world.dt), step.true_pose
            )
            odometry.append(np.asarray(step.odometry.twist) - true_twist(pose, step.true_pose, world.dt))
        pose = step.true_pose
        local = transform_points(inverse(pose), world.landmarks[step.observations.ids])
        true = np.column_stack([np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])])
        error = step.observations.range_bearing - true
        error[:, 1] = wrap(error[:, 1])
        seen.append(error)
        assert np.hypot(*(pose - path[k + 1])[:2]) < 0.01
        np.testing.assert_array_equal(step.observations.cov, world.observation_cov[None].repeat(len(error), 0))
    e, o = np.array(odometry), np.vstack(seen)
    var_v, var_w = noise.variances(0.3, 0.0, 0.1)  # the same at every speed
    np.testing.assert_allclose(np.cov(e.T) / np.diag([var_v, var_v, var_w]).max(), np.diag([var_v, var_v, var_w])
                               / np.diag([var_v, var_v, var_w]).max(), atol=0.08)  # fmt: skip
    np.testing.assert_allclose(e.var(axis=0), [var_v, var_v, var_w], rtol=0.12)
    np.testing.assert_allclose(o.var(axis=0), np.diag(world.observation_cov), rtol=0.08)
    assert np.all(np.abs(e.mean(axis=0)) < 4 * np.sqrt([var_v, var_v, var_w]) / math.sqrt(len(e)))
    slip, _ = noise.slip((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), world.dt)
    assert noise.variances(0.3, 0.0, 0.1, slip=slip) == (var_v, var_w)  # nothing slips there


def true_twist(before: np.ndarray, after: np.ndarray, dt: float) -> np.ndarray:
    turn = float(wrap(after[2] - before[2]))
    local = transform_points(inverse(np.array([*before[:2], before[2] + 0.5 * turn])), after[None, :2])[0]
    return np.array([*local, turn]) / dt


@pytest.mark.parametrize("world", WORLDS.values(), ids=lambda w: w.name)
def test_the_path_is_closed_and_of_constant_speed(world: LandmarkWorld) -> None:
    path = world.path(world.steps)
    way = np.hypot(*np.diff(path[:, :2], axis=0).T)
    np.testing.assert_allclose(way, world.speed_m_s * world.dt, rtol=2e-3)
    distance = np.hypot(*(path[:, None, :2] - world.landmarks[None]).transpose(2, 0, 1))
    assert np.all((distance < world.reach_m).sum(axis=1) >= 1)  # something is always in sight
    assert np.all((distance < world.reach_m).any(axis=0))  # and everything at some time


def test_a_seed_gives_the_same_noise_to_every_backend() -> None:
    world = WORLDS["circle"]
    a, b = (
        [step.odometry.twist for step in drive(world, slam.make(name, config=world.backend_settings()), 3, 30)]
        for name in ("ekf", "odometry")
    )
    np.testing.assert_array_equal(a, b)


def test_scaling_scales_every_sigma() -> None:
    world, scaled = WORLDS["circle"], WORLDS["circle"].scaled(2.0)
    np.testing.assert_allclose(scaled.observation_cov, 4.0 * world.observation_cov)
    assert scaled.backend_settings()["odometry"]["turn_floor_rad_s"] == 2.0 * world.turn_sigma_rad_s
    assert consistency.scaled_noise(3.0).encoder == pytest.approx(0.03)


# ---- the command -----------------------------------------------------------------------------------------------


def test_json_has_the_contract_s_keys_and_the_files_are_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = measure(tmp_path, capsys, "--slam", "ekf,odometry")
    assert set(result) == {"ekf", "odometry", "config"}
    assert all(result[name].keys() >= KEYS for name in ("ekf", "odometry"))
    assert result["ekf"]["runs"] == 3 and result["ekf"]["steps"] == 20
    assert result["ekf"]["band"] == pytest.approx(nees_band(3, 3))
    assert 0.1 < result["ekf"]["anees_pose"] < 4 and 0.5 < result["ekf"]["nis_mean"] < 1.5
    assert result["config"]["rooms"] == "circle" and result["config"]["seeds"] == [0, 2]
    assert json.loads((tmp_path / "consistency.json").read_text("utf-8")) == result
    assert cv2.imread(str(tmp_path / "consistency.png")).shape == (560, 1000, 3)


def test_what_is_there_is_not_done_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = measure(tmp_path / "whole", capsys)
    done: list[int] = []
    inner = consistency.run_job

    def interrupted(job: consistency.Job) -> consistency.Row:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(job[2])
        return inner(job)

    monkeypatch.setattr(consistency, "run_job", interrupted)
    out = tmp_path / "out"
    assert main(small(out)) == 130
    assert "interrupted after 2 of 3 runs; run the same command again" in capsys.readouterr().err
    lines = (out / "runs.jsonl").read_text("utf-8").splitlines()
    assert [json.loads(line)[0][:3] for line in lines] == [["ekf", "circle", 0], ["ekf", "circle", 1]]
    (out / "runs.jsonl").write_text("\n".join([lines[0], lines[1][:100]]), "utf-8")  # cut off: done again
    done.clear()
    assert measure(out, capsys) == whole
    assert done == [1, 2]
    done.clear()
    assert measure(out, capsys, "--runs", "4")["ekf"]["runs"] == 4  # more of the same
    assert done == [3]


def test_other_settings_need_another_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measure(tmp_path, capsys)
    line = refused(small(tmp_path, "--noise", "2"), capsys)
    assert "holds runs with noise = 1.0, not 2.0" in line and "another --out" in line
    (tmp_path / "settings.json").write_text("[", "utf-8")
    assert "settings.json" in refused(small(tmp_path), capsys)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--slam", "efk"], ["unknown SLAM backend 'efk'", "did you mean 'ekf'?", "odometry"]),
        (["--slam", "ekf,,odometry"], ["unknown SLAM backend ''"]),
        (["--slam", "truth"], ["truth", "valid: ", "ekf"]),
        (["--rooms", "circl"], ["unknown rooms 'circl'", "did you mean 'circle'?", "apartment"]),
        (["--noise", "0"], ["--noise", "above 0"]),
        (["--noise", "nan"], ["--noise", "got 'nan'"]),
        (["--rooms", "rectangular", "--noise", "200"], ["--noise", "100"]),
        (["--runs", "0"], ["--runs"]),
        (["--seed0", "-1"], ["--seed0"]),
    ],
)
def test_bad_input(argv: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["consistency", "--out", str(tmp_path / "out"), *argv], capsys)
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


def test_an_out_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    assert "is not a folder" in refused(small(tmp_path / "file"), capsys)


def test_generated_rooms(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = measure(tmp_path, capsys, "--rooms", "rectangular", "--runs", "2", "--noise", "3")
    assert result["ekf"]["steps"] == 20 and result["ekf"]["nis_mean"] is not None
    assert result["config"]["noise_config"]["range_sigma_m"] == pytest.approx(0.03)


# ---- the parts -------------------------------------------------------------------------------------------------


def record(nees: list[float]) -> consistency.Record:
    values = np.array(nees)
    return {"nees": values, "nis": np.full(len(values), 2.0), "dof": np.full(len(values), 4.0)}


def test_figures_of_known_runs() -> None:
    figures = consistency.summarise([record([3.0, 3.0, 300.0]), record([3.0, 3.0, 300.0]), record([3.0])])
    # The third run ends first: the rest is of the two that go on.
    assert figures["steps"] == 3 and figures["runs"] == 3
    assert figures["anees_pose"] == pytest.approx((1 + 1 + 100) / 3)
    assert figures["fraction_in_band"] == pytest.approx(2 / 3)
    assert figures["nis_mean"] == pytest.approx(0.5)


def test_a_backend_that_loses_itself_has_no_number_but_is_json() -> None:
    figures = consistency.summarise([record([3.0, math.inf])])
    assert figures["anees_pose"] is None
    json.dumps(figures, allow_nan=False)
    no_nis = {"nees": np.ones(2), "nis": np.full(2, np.nan), "dof": np.zeros(2)}
    assert consistency.summarise([no_nis])["nis_mean"] is None


def test_jobs_in_other_processes_come_back_and_can_be_broken_off() -> None:
    kept: dict[int, int] = {}
    run_all([1, 2, 3], math.factorial, workers=2, keep=kept.__setitem__)
    assert kept == {1: 1, 2: 2, 3: 6}

    def keep(job: int, result: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(Interrupted, match="interrupted after 0 of 2 runs"):
        run_all([1, 2], math.factorial, workers=2, keep=keep)


def test_the_map_s_determinants_fall_and_no_landmark_is_below_the_floor() -> None:
    """Paper B's claims 1 and 2, while the heading is known."""
    world = WORLDS["circle"]
    backend = slam.make("ekf", config=world.backend_settings())
    rows = follow_filter(backend, world, seed=0, steps=170)
    assert len(rows["step"]) > 20
    assert np.diff(rows["log_det"]).max() < 1e-9
    assert np.diff(rows["pair_log_det"], axis=0).max() < 1e-9
    assert np.all(rows["sigma"] > floor_of(world))


def test_paper_b_writes_its_chart_the_same_each_time(tmp_path: Path) -> None:
    result = paper_b(tmp_path, steps=135)
    assert result["ekf"]["log_det_largest_increase"] < 0
    assert {path.name for path in tmp_path.iterdir()} == {"paper_b.png", "paper_b.json"}
    first = (tmp_path / "paper_b.png").read_bytes()
    paper_b(tmp_path, steps=135)
    assert (tmp_path / "paper_b.png").read_bytes() == first  # no date in it


# ---- long runs -------------------------------------------------------------------------------------------------


@pytest.mark.monte_carlo
@pytest.mark.parametrize(("name", "least"), [("circle", 1.5), ("room", 1.6)])
def test_the_standard_filter_grows_too_sure_and_nis_does_not_see_it(name: str, least: float) -> None:
    steps = WORLDS[name].steps
    records = [consistency._record(consistency.run_job(("ekf", name, seed, steps, 1.0))) for seed in range(50)]
    figures = consistency.summarise(records)
    assert least < figures["anees_pose"] < 2.5
    assert figures["fraction_in_band"] < 0.25
    assert figures["nis_mean"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.monte_carlo
@pytest.mark.skipif("invariant-ekf" not in slam.names(), reason="invariant-ekf is not registered")
@pytest.mark.parametrize("name", ["circle", "room"])
def test_the_invariant_filter_is_consistent(name: str) -> None:
    steps = WORLDS[name].steps
    records = [
        consistency._record(consistency.run_job(("invariant-ekf", name, seed, steps, 1.0))) for seed in range(50)
    ]
    figures = consistency.summarise(records)
    assert figures["anees_pose"] == pytest.approx(1.0, abs=0.1)
    assert figures["fraction_in_band"] > 0.9
