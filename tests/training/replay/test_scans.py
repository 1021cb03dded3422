"""``mecanum replay`` of a log with scans: every backend, the map it draws, the relations metric, bad input."""

from __future__ import annotations

import json
import os
import re
import signal
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import slam
from tests.slam.logs.logs_on_disk import data_folder
from tests.slam.logs.scans_on_disk import HEIGHT, WIDTH, carmen_lines, dpslam_lines, drive, put_lines
from tests.slam.written_files import read_map_server, read_tum
from tests.training.replay.test_replay import refused, replayed
from training.cli import main
from training.replay import report as replay_report
from training.replay import run as task
from training.runs.progress import Progress

SCANS = 140  # more than twice round


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scans")
    put_lines(folder / "room.log.gz", carmen_lines(SCANS, kind="gfs2log"), packed=True)
    put_lines(folder / "truth.log", carmen_lines(SCANS, kind="corrected"))
    put_lines(folder / "dp.log", dpslam_lines(20))
    return folder


def argv(logs: Path, *more: str) -> list[str]:
    return [str(logs / "room.log.gz"), "--reference", str(logs / "truth.log"), *more]


def test_truth_draws_the_room(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = replayed(argv(logs, "--slam", "truth", "--out", str(tmp_path)), capsys)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted((*task.FILES, *task.MAP_FILES))
    assert found == json.loads((tmp_path / "metrics.json").read_text("utf-8"))
    assert found["scans"] == found["samples"] == SCANS and 0 < found["ms_per_scan"] <= 1e3 * found["wall_s"]
    assert found["relations_trans_m"] == pytest.approx(0.0, abs=1e-6)
    classes, resolution, (x0, y0) = read_map_server(tmp_path / "map.yaml")
    rows, cols = np.nonzero(classes == 100)
    x, y = x0 + (cols + 0.5) * resolution, y0 + (rows + 0.5) * resolution
    to_wall = np.minimum(np.abs(np.abs(x) - WIDTH / 2), np.abs(np.abs(y) - HEIGHT / 2))
    assert to_wall.max() <= 1.5 * resolution and len(x) > 0.9 * 2 * (WIDTH + HEIGHT) / resolution
    picture = cv2.imread(str(tmp_path / "map.png"))
    assert picture is not None and picture.shape[0] > 500
    _, estimate = read_tum(tmp_path / "trajectory_estimate.tum")
    assert np.allclose(estimate[:, :2], drive(SCANS)[0][:, :2], atol=1e-6)


@pytest.mark.parametrize("name", [name for name in slam.names() if name != "truth"])
def test_every_backend_replays_scans(
    name: str, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = replayed(argv(logs, "--slam", name, "--out", str(tmp_path)), capsys)
    assert found["slam"] == name and found["scans"] == SCANS and (tmp_path / "map.pgm").exists()
    assert found["dead_reckoning_ate_m"] > 0.1  # the wheels slip
    assert found["relations_count"] == found["relations_local_count"] + found["relations_closing_count"]
    assert found["relations_closing_count"] > 10 and found["relations_of"] in ("online", "final")
    if name == "odometry":
        assert found["relations_trans_m"] == pytest.approx(found["dead_reckoning_relations_trans_m"])
    else:
        assert found["relations_closing_trans_m"] < 0.5 * found["dead_reckoning_relations_closing_trans_m"]


def test_without_a_reference(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = replayed([str(logs / "dp.log"), "--out", str(tmp_path)], capsys)
    assert found["scans"] == 20 and found["samples"] == 0 and found["association"] == "unknown"
    assert found["ate_rmse_m"] is None and found["relations_trans_m"] is None and found["relations_count"] == 0
    assert "no reference" in found["note"]
    shown = replay_report.summary(found, tmp_path, []).splitlines()
    assert [line[:12].strip() for line in shown] == [
        "replayed", "ended", "trajectory", "landmarks", "took", "files",
    ]  # fmt: skip
    assert shown[2].split(maxsplit=1)[1] == "no reference" and re.fullmatch(r"landmarks +\d+", shown[3])


@pytest.mark.parametrize("name", ["odometry", "ekf"])
def test_the_nees_with_an_exact_reference_is_the_backends_own(name: str, logs: Path, tmp_path: Path) -> None:
    """A reference without an error of its own adds nothing: both are of the error that the backend speaks of."""
    prepared = task.prepare(logs / "room.log.gz", reference=logs / "truth.log", slam=name, out=tmp_path)
    task.run(prepared, lambda time_s: None)
    found = replay_report.metrics(prepared)
    assert found["reference_sigma_m"] < 1e-6
    assert found["anees_reference"] == pytest.approx(found["anees"], rel=1e-6)
    assert found["anees_reference_matched"] == pytest.approx(found["anees"], rel=1e-6)


def test_the_config_repeats_the_replay_with_its_reference(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, again = tmp_path / "first", tmp_path / "again"
    replayed(argv(logs, "--limit-s", "10", "--out", str(first)), capsys)
    config = tomllib.loads((first / "config.toml").read_text())
    assert config["run"]["reference"] == str(logs / "truth.log") and "observation" not in config
    replayed([str(logs / "room.log.gz"), "--config", str(first / "config.toml"), "--out", str(again)], capsys)
    for name in ("trajectory_estimate.tum", "trajectory_true.tum", "map.pgm", "map.yaml", "map.png"):
        assert (again / name).read_bytes() == (first / name).read_bytes(), name


def test_a_backends_final_trajectory_is_what_relations_are_of(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared = task.prepare(
        logs / "room.log.gz", reference=logs / "truth.log", slam="odometry", out=tmp_path, limit_s=10.0
    )
    task.run(prepared, lambda time_s: None)
    assert replay_report.metrics(prepared)["relations_trans_m"] > 1e-4
    monkeypatch.setattr(type(prepared.backend), "scan_poses", drive(21)[0], raising=False)
    found = replay_report.metrics(prepared)
    assert found["relations_trans_m"] < 1e-6 and found["relations_of"] == "final"
    assert found["online_relations_trans_m"] > 1e-4
    monkeypatch.setattr(type(prepared.backend), "scan_poses", drive(20)[0], raising=False)  # one short
    found = replay_report.metrics(prepared)
    assert found["relations_trans_m"] > 1e-4 and found["relations_of"] == "online"


def test_the_summary_speaks_of_scans(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", *argv(logs, "--limit-s", "5", "--out", str(tmp_path))]) == 0
    shown = capsys.readouterr().out
    assert "relations" in shown and "11 scans, " in shown and "map.png" in shown
    assert "of the poses believed at the time" in shown and "that scans bear witness to" in shown
    assert "with the reference's own error" in shown


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--reference", "{logs}/nowhere"], ["reference", "is no file"]),
        (["--reference", "{logs}/dp.cfg"], ["is no log that is known", "give a CARMEN or DP-SLAM log"]),
        (["--slam", "truth"], ["needs true poses", "give --reference"]),
        (["--association", "known"], ["does not tell landmarks apart"]),
        (["--robot", "1"], ["leave --robot out"]),
        (["--config", "{logs}/dp.cfg"], ["room holds scans, no observations", "[observation]"]),
    ],
)
def test_bad_usage_with_scans(
    more: list[str], words: list[str], logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (logs / "dp.cfg").write_text("[observation]\nrange_m = 1.0\n")
    out = tmp_path / "out"
    options = [word.format(logs=logs) for word in more]
    line = refused([str(logs / "room.log.gz"), *options, "--out", str(out)], capsys)
    assert all(word in line for word in words), line
    assert not out.exists()


def test_a_damaged_scan_log_is_named_with_file_and_line(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = put_lines(tmp_path / "bad.log", [*carmen_lines(3), "FLASER 180 1.0 2.0"])
    line = refused([str(path), "--out", str(tmp_path / "out")], capsys)
    assert f"{path}, line {len(carmen_lines(3)) + 1}: " in line and "cut short" in line


def test_the_first_minutes_of_the_intel_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = data_folder("carmen")
    found = replayed(
        [str(folder / "intel.gfs.log.gz"), "--reference", str(folder / "intel-corrected.log.gz"),
         "--slam", "truth", "--limit-s", "300", "--out", str(tmp_path)], capsys,
    )  # fmt: skip
    assert found["relations_trans_m"] < 1e-6 and found["dead_reckoning_relations_local_trans_m"] > 0.3
    classes, _, _ = read_map_server(tmp_path / "map.yaml")
    assert np.count_nonzero(classes == 100) > 1000


def test_ctrl_c_at_the_first_scan_keeps_it(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Progress, "show", lambda self, done, text: os.kill(os.getpid(), signal.SIGINT))
    assert main(["replay", *argv(logs, "--out", str(tmp_path), "--json")]) == 130
    found = json.loads(capsys.readouterr().out)
    assert found["interrupted"] and found["scans"] == 1 and (tmp_path / "map.png").exists()


def test_a_log_cut_to_one_scan(logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = replayed(argv(logs, "--limit-s", "0.1", "--out", str(tmp_path)), capsys)
    assert found["scans"] == 1 and found["samples"] == 1 and found["relations_count"] == 0
    assert found["relations_trans_m"] is None
