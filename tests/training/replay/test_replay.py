"""``mecanum replay`` end to end: every file there and of one replay; bad input refused in one line."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import signal
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import slam
from slam.landmarks.database import read_landmark_map
from tests.slam.logs.logs_on_disk import data_folder, write_park, write_utias
from tests.slam.written_files import read_tum
from training.cli import main
from training.replay import report as replay_report
from training.replay import run as task
from training.runs.progress import Progress


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    write_utias(folder / "utias")
    write_park(folder / "park")
    return folder


def replayed(argv: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main(["replay", *argv, "--json"]) == 0
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    found: dict[str, Any] = json.loads(out)
    return found


def refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["replay", *argv]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1 and printed.err.startswith("mecanum replay: ")
    return printed.err


def test_a_replay_writes_every_file_of_one_run(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep" / "out"
    out.mkdir(parents=True)
    for name in ("metrics.json", "map.pgm", "map.yaml", "map.png"):
        (out / name).touch()  # of a log of scans
    found = replayed([str(logs / "utias" / "Robot1_Odometry.dat"), "--out", str(out), "--seed", "3"], capsys)
    assert sorted(p.name for p in out.iterdir()) == sorted(task.FILES)
    assert found == json.loads((out / "metrics.json").read_text("utf-8"))
    assert found["slam"] == "invariant-ekf" and found["association"] == "known" and found["seed"] == 3
    assert found["log"] == "utias robot 1" and found["end"] == "end of the log" and not found["interrupted"]
    assert found["observations"] == 160 and found["landmarks"] == 4 and found["duration_s"] == pytest.approx(20.0)
    # Nothing was noisy, so nothing is off by more than rounding and the reference's interpolation.
    for key in ("ate_rmse_m", "ate_aligned_m", "final_position_error_m", "landmark_rmse_m", "anees"):
        assert 0 <= found[key] < 1e-3, key
    assert found["dead_reckoning_ate_m"] < 1e-3 and found["realtime_factor"] > 1

    times, estimate = read_tum(out / "trajectory_estimate.tum")
    true_times, true = read_tum(out / "trajectory_true.tum")
    assert len(true) == found["samples"] and np.isin(true_times, times).all()
    assert np.allclose(estimate[np.isin(times, true_times)], true, atol=1e-3)
    landmarks = read_landmark_map(out / "landmarks.db").landmarks
    positions = np.array([landmarks["x"], landmarks["y"]]).T
    rows = list(csv.DictReader(io.StringIO((out / "landmarks.csv").read_text())))
    assert [int(row["id"]) for row in rows] == landmarks["id"].tolist() == [6, 7, 8, 9]
    assert np.allclose([[float(r["x_m"]), float(r["y_m"])] for r in rows], positions)
    assert np.allclose([[float(r["true_x_m"]), float(r["true_y_m"])] for r in rows], positions, atol=1e-3)
    picture = cv2.imread(str(out / "trajectory.png"))
    assert picture is not None and np.count_nonzero(picture < 255) > 1000


def test_the_config_repeats_the_replay(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(logs / "utias")
    first = tmp_path / "first"
    argv = [log, "--association", "unknown", "--limit-s", "8", "--seed", "5", "--out", str(first)]
    assert replayed(argv, capsys)["duration_s"] == 8.0
    again = replayed([log, "--config", str(first / "config.toml"), "--out", str(tmp_path / "again")], capsys)
    assert again["association"] == "unknown" and again["seed"] == 5 and again["duration_s"] == 8.0
    for name in set(task.FILES) - {"metrics.json", "landmarks.db", "config.toml"}:
        assert (tmp_path / "again" / name).read_bytes() == (first / name).read_bytes(), name
    effective, repeated = (tomllib.loads((d / "config.toml").read_text()) for d in (first, tmp_path / "again"))
    assert effective == repeated
    assert effective["slam_config"]["odometry"]["speed_share"] == 1.9  # the log's own


def test_options_and_config_lie_over_the_logs_own_values(logs: Path, tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(
        "slam = 'odometry'\n[observation]\nrange_m = 0.5\n[slam_config]\ngate = 7\n"
        "[slam_config.odometry]\nturn_share_rad_m = 1\n[run]\nassociation = 'unknown'\nlimit_s = 3\n"
    )
    prepared = task.prepare(logs / "utias", out=tmp_path / "out", slam="ekf", limit_s=2.0, config=path)
    assert prepared.config.slam == "ekf" and prepared.run["association"] == "unknown"
    assert prepared.log.duration_s == 2.0
    assert prepared.config.observation.range_m == 0.5 and prepared.config.observation.bearing_deg == 1.1
    config = prepared.backend.config
    assert config.odometry.turn_share_rad_m == 1.0 and config.odometry.speed_share == 1.9
    assert config.lidar_offset_m == 0.0 and config.gate == 7.0  # type: ignore[attr-defined]
    assert not (tmp_path / "out").exists()


def test_a_replay_that_is_limited_says_so(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(logs / "utias" / "Robot1_Odometry.dat")
    found = replayed([log, "--limit-s", "5", "--out", str(tmp_path / "out")], capsys)
    assert found["end"] == "the limit, --limit-s" and found["duration_s"] == pytest.approx(5.0)
    found = replayed([log, "--limit-s", "500", "--out", str(tmp_path / "out")], capsys)
    assert found["end"] == "end of the log" and found["duration_s"] == pytest.approx(20.0)


def test_a_log_has_values_for_one_backend_alone(logs: Path, tmp_path: Path) -> None:
    told = {
        name: task.prepare(logs / "utias", out=tmp_path / "out", slam=name).backend.config.loop_sigma_m  # type: ignore[attr-defined]
        for name in ("ekf", "invariant-ekf")
    }
    assert told == {"ekf": math.inf, "invariant-ekf": 0.6}


def test_a_log_without_ids_or_headings(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = replayed([str(logs / "park"), "--out", str(tmp_path)], capsys)
    assert found["association"] == "unknown" and found["landmarks"] == 5
    assert found["ate_rmse_m"] < 0.05
    assert found["anees"] is None and found["final_heading_error_rad"] is None and found["landmark_rmse_m"] is None
    assert main(["replay", str(logs / "park"), "--out", str(tmp_path)]) == 0
    shown = capsys.readouterr().out
    assert "victoria_park with invariant-ekf, unknown association" in shown and "metrics.json" in shown


@pytest.mark.parametrize("name", [n for n in slam.names() if slam.make(n).observes_landmarks])
def test_every_backend_replays(name: str, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = [str(logs / "utias"), "--slam", name, "--limit-s", "6", "--out", str(tmp_path)]
    found = replayed(argv, capsys)
    assert found["slam"] == name and found["ate_rmse_m"] < 0.05


def test_a_backends_own_nees_is_asked(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = task.prepare(logs / "utias", out=tmp_path, limit_s=2.0)
    monkeypatch.setattr(prepared.backend, "pose_nees", lambda true_pose: 6.0 + 0.0 * true_pose[0], raising=False)
    task.run(prepared, lambda time_s: None)
    assert replay_report.metrics(prepared)["anees"] == pytest.approx(2.0)


def test_ctrl_c_keeps_the_replay_as_far_as_it_came(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def press(self: Progress, time_s: float, text: str) -> None:
        if time_s >= 4.0:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Progress, "show", press)
    out = tmp_path / "out"
    assert main(["replay", str(logs / "utias"), "--out", str(out), "--json"]) == 130
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert found["interrupted"] is True and found["end"] == "interrupted" and 4.0 <= found["duration_s"] < 4.1
    assert "interrupted after 4.0 s" in printed.err and str(out) in printed.err
    assert sorted(p.name for p in out.iterdir()) == sorted(task.FILES)
    assert read_tum(out / "trajectory_estimate.tum")[0][-1] <= 4.1


gaps = st.lists(st.integers(1, 60), max_size=15)


@given(gaps, st.integers(0, 5))
def test_samples_are_the_references_own_and_fill_its_gaps(steps: list[int], first: int) -> None:
    stamps = (first + np.cumsum([0, *steps])) / 50.0
    log = log_with(stamps, float(stamps[-1]) + 0.5)
    times, rows = task.sample_times(log)
    assert np.all(np.diff(times) > 0) and times[0] >= 0 and times[-1] <= log.duration_s
    assert np.array_equal(times[rows >= 0], stamps[rows[rows >= 0]])
    assert rows.max() == -1 or np.diff(times[rows >= 0]).min(initial=1.0) >= task.SAMPLE_S - 1e-6
    assert np.diff(np.concatenate([[0.0], times, [log.duration_s]])).max() <= 2.0 * task.SAMPLE_S + 1e-9


def log_with(stamps: np.ndarray, duration_s: float) -> Any:
    return SimpleNamespace(reference_times=stamps, duration_s=duration_s)


# ---- bad input ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["nowhere"], ["log nowhere does not exist", "check the path"]),
        (["{logs}"], ["holds no log that is known", "Robot1_Odometry.dat"]),
        (["{logs}/utias", "--slam", "efk"], ["unknown SLAM backend 'efk'", "did you mean 'ekf'?", "odometry"]),
        (["{logs}/utias", "--robot", "4"], ["there is no robot 4", "give --robot 1"]),
        (["{logs}/park", "--robot", "1"], ["leave --robot out"]),
        (["{logs}/utias", "--association", "knwn"], ["unknown association 'knwn'", "did you mean 'known'?"]),
        (["{logs}/park", "--association", "known"], ["does not tell landmarks apart", "--association unknown"]),
        (["{logs}/park", "--slam", "truth"], ["needs true poses"]),
        (["{logs}/utias", "--limit-s", "0"], ["--limit-s", "greater than or equal to 0.001"]),
        (["{logs}/utias", "--limit-s", "nan"], ["--limit-s", "got 'nan'"]),
        (["{logs}/utias", "--seed", "-1"], ["--seed"]),
        ([], ["missing argument"]),
    ],
)
def test_bad_usage(
    argv: list[str], words: list[str], logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    line = refused([word.format(logs=logs) for word in argv] + ["--out", str(out)], capsys)
    assert all(word.lower() in line.lower() for word in words), line
    assert not out.exists()


def test_an_out_that_cannot_be_written_to(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    in_the_way = tmp_path / "file"
    in_the_way.write_text("mine")
    line = refused([str(logs / "utias"), "--out", str(in_the_way / "below")], capsys)
    assert "cannot write to" in line and "choose another --out" in line and in_the_way.read_text() == "mine"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, ["cannot read config", "No such file"]),
        ("slam = [unclosed", ["not TOML"]),
        ("slmm = 'ekf'", ["unknown key of ReplayConfig 'slmm'", "did you mean 'slam'?"]),
        ("slam = 'efk'", ["unknown SLAM backend 'efk'"]),
        ("slam_config = 3", ["slam_config must be a mapping"]),
        ("[slam_config]\ngrid = 1", ["grid"]),
        ("[slam_config.odometry]\nspeed_share = -1.0", ["speed_share must be"]),
        ("[observation]\nrange_m = 0.0", ["range_m must be in [1e-6, 1e6]"]),
        ("[observation]\nbearing_deg = nan", ["bearing_deg must be in [1e-6, 1e6]"]),
        ("[run]\nseed = 'x'", ["seed", "wrong type"]),
        ("[run]\nseed = -3", ["seed ≥ 0"]),
        ("[run]\nassociation = 'guessed'", ["unknown association 'guessed'"]),
        ("[run]\nlimit_s = -1.0", ["must be above 0"]),
        ("run = 3", ["[run]", "table"]),
    ],
)
def test_bad_configs(
    text: str | None, words: list[str], logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "config.toml"
    if text is not None:
        path.write_text(text, "utf-8")
    out = tmp_path / "out"
    line = refused([str(logs / "utias"), "--config", str(path), "--out", str(out)], capsys)
    assert all(word in line for word in words), line
    assert not out.exists()


def test_a_damaged_log_is_named_with_file_and_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_utias(tmp_path / "log", seconds=2.0)
    path = tmp_path / "log" / "Robot1_Measurement.dat"
    path.write_text(path.read_text() + "1002 63 oops 0.1\n")
    line = refused([str(tmp_path / "log"), "--out", str(tmp_path / "out")], capsys)
    assert str(path) in line and "line " in line and "'oops'" in line


# ---- real data ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("log", "argv", "most_m", "landmarks"),
    [("utias6", ["--robot", "1"], 0.3, (5, 15)), ("victoria_park", [], 2.0, (20, 80))],
)
def test_the_first_minute_of_a_real_log(
    log: str, argv: list[str], most_m: float, landmarks: tuple[int, int], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    folder = data_folder(log)
    found = replayed([str(folder), *argv, "--limit-s", "60", "--out", str(tmp_path)], capsys)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(task.FILES)
    assert found["duration_s"] == pytest.approx(60.0) and found["ate_rmse_m"] < most_m
    assert landmarks[0] <= found["landmarks"] <= landmarks[1]
    assert math.isfinite(found["dead_reckoning_ate_m"])
