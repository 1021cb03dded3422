"""``mecanum explore`` end to end: every file there, readable, and of one and the same episode."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import training
from agents.base import Goal
from mecanum_env.arguments import make_config
from mecanum_env.config import from_toml
from mecanum_env.env import ExploreEnv
from slam.grids.occupancy import FREE, OCCUPIED
from slam.landmarks.database import read_landmark_map
from tests.slam.written_files import read_map_server, read_tum
from tests.training.plans import write_room
from training.cli import main
from training.episodes import explore as task
from training.episodes.explore import EXTRAS, FILES
from training.episodes.recording import Recorder
from training.runs.running import plain
from training.views.episode_files import Saver, write_episode

ROOT = Path(__file__).resolve().parents[3]

METRICS = {
    "coverage", "time_s", "steps", "path_length_m", "collisions", "time_to_50_s", "time_to_90_s", "time_to_95_s",
    "map_iou", "map_precision", "map_recall", "corner_mean_m", "corner_max_m", "ate_rmse_m",
    "final_position_error_m", "final_heading_error_rad", "anees", "landmarks", "decision_ms_median", "success",
    "agent", "slam", "rooms", "seed",
}  # fmt: skip


def run(*argv: str, **kwargs: Any) -> subprocess.Popen[str]:
    # Started where the results go, to see that nothing depends on the folder it runs in. A shell's background job
    # has Ctrl-C ignored, and all that it starts: here it is to be heard.
    return subprocess.Popen(
        [sys.executable, "-m", "training.cli", *argv],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL), **kwargs,
    )  # fmt: skip


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Explore a room from a floor plan in a process of its own; return its folder and what it printed."""
    folder = tmp_path_factory.mktemp("episode")
    write_room(folder / "room.png")
    process = run(
        "explore", "--floor-plan", "room.png", "--slam", "ekf", "--start", "1.0,0.9,0.5", "--seed", "7", "--out",
        "deep/out", "--json", cwd=folder,
    )  # fmt: skip
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert out.count("\n") == 1
    return folder / "deep" / "out", json.loads(out)


def test_json_prints_the_metrics(episode: tuple[Path, dict[str, Any]]) -> None:
    folder, printed = episode
    assert printed == json.loads((folder / "metrics.json").read_text("utf-8"))
    assert printed.keys() >= METRICS
    assert printed["success"] is True and printed["coverage"] >= 0.95
    assert printed["agent"] == "nearest-frontier" and printed["slam"] == "ekf" and printed["seed"] == 7
    assert printed["rooms"] is None and printed["floor_plan"].endswith("room.png")
    assert printed["interrupted"] is False and printed["decision_ms_median"] > 0


def test_no_file_is_missing_and_none_is_left_over(episode: tuple[Path, dict[str, Any]]) -> None:
    assert sorted(p.name for p in episode[0].iterdir()) == sorted(FILES)


def test_the_trajectories_are_the_episode(episode: tuple[Path, dict[str, Any]]) -> None:
    folder, printed = episode
    times, true = read_tum(folder / "trajectory_true.tum")
    times_too, estimate = read_tum(folder / "trajectory_estimate.tum")
    assert len(times) == printed["steps"] + 1 and np.array_equal(times, times_too)
    assert times[-1] == pytest.approx(printed["time_s"])
    assert np.allclose(true[0], 0.0) and np.allclose(estimate[0], 0.0)
    apart = np.hypot(*(true[:, :2] - estimate[:, :2]).T)
    assert math.sqrt(np.mean(apart**2)) == pytest.approx(printed["ate_rmse_m"], abs=1e-6)
    assert np.hypot(*np.diff(true[:, :2], axis=0).T).sum() == pytest.approx(printed["path_length_m"], abs=1e-5)


def test_the_map_is_the_room_seen_from_the_start(episode: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = episode
    classes, resolution, origin = read_map_server(folder / "map.yaml")
    assert resolution == 0.05
    # The room is 4 × 3 m from (0.25, 0.25), less a pillar of 0.6 m; its frame here is that of the start.
    free = np.count_nonzero(classes == FREE) * resolution**2
    assert free == pytest.approx(4.0 * 3.0 - 0.6**2, rel=0.06)
    turn = np.array([[math.cos(0.5), math.sin(0.5)], [-math.sin(0.5), math.cos(0.5)]])
    for plan_x, plan_y, expected in (
        (1.5, 2.5, FREE), (4.0, 0.5, FREE), (2.25, 1.5, OCCUPIED), (4.27, 2.0, OCCUPIED), (2.0, 0.23, OCCUPIED),
    ):  # fmt: skip
        x, y = turn @ (plan_x - 1.0, plan_y - 0.9)
        col, row = int((x - origin[0]) // resolution), int((y - origin[1]) // resolution)
        assert expected in classes[row - 1 : row + 2, col - 1 : col + 2], (plan_x, plan_y)
        if expected == FREE:
            assert OCCUPIED not in classes[row - 1 : row + 2, col - 1 : col + 2]


def test_the_landmarks_are_the_corners(episode: tuple[Path, dict[str, Any]]) -> None:
    folder, printed = episode
    landmarks, _, meta, sightings = read_landmark_map(folder / "landmarks.db")
    assert len(sightings) == 0  # one robot alone made the map
    assert len(landmarks) == printed["landmarks"] >= 4
    assert meta["backend"] == "ekf" and np.all(landmarks["times_seen"] > 0)
    positions = np.array([landmarks["x"], landmarks["y"]]).T
    corners = np.array([(x, y) for x in (0.25, 4.25) for y in (0.25, 3.25)]) - (1.0, 0.9)
    corners = corners @ np.array([[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]])
    nearest = np.linalg.norm(corners[:, None] - positions[None], axis=2).min(axis=1)
    assert nearest.max() < 0.1


def test_the_pictures_lie_on_each_other(episode: tuple[Path, dict[str, Any]]) -> None:
    believed, true = (cv2.imread(str(episode[0] / name)) for name in ("map.png", "truth.png"))
    assert believed is not None and true is not None
    assert believed.shape == true.shape and max(believed.shape) >= 600
    # Floor is white in both: at nearly all the same places.
    white = [np.all(p[:-64] > 250, axis=2) for p in (believed, true)]
    both, either = np.count_nonzero(white[0] & white[1]), np.count_nonzero(white[0] | white[1])
    assert both / either > 0.93


def test_the_config_is_the_effective_one(episode: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = episode
    plan = str(folder.parents[1] / "room.png")
    assert from_toml(folder / "config.toml") == replace(make_config(slam="ekf"), floor_plan=plan)


def test_the_config_repeats_the_episode(
    episode: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, printed = episode
    assert main(["explore", "--config", str(folder / "config.toml"), "--out", str(tmp_path / "again")]) == 0
    shown = capsys.readouterr().out
    for words in (f"{100 * printed['coverage']:.1f} %", "success", str(tmp_path / "again")):
        assert words in shown
    for name in set(FILES) - {"metrics.json", "landmarks.db"}:  # wall-clock in one, a database's own header
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


def test_options_go_before_the_config(
    episode: tuple[Path, dict[str, Any]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = ["--config", str(episode[0] / "config.toml"), "--out", str(tmp_path / "out")]
    room = ["--rooms", "rectangular", "--seed", "3", "--noise", "slippery"]
    who = ["--slam", "odometry", "--agent", "random", "--max-steps", "30", "--coverage-target", "0.99"]
    assert main(["explore", *config, *room, *who, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["rooms"], printed["floor_plan"], printed["seed"]) == ("rectangular", None, 3)
    assert (printed["slam"], printed["agent"], printed["end"]) == ("odometry", "random", "time")
    assert printed["steps"] == 30 and printed["time_s"] == 3.0 and printed["success"] is False
    assert printed["time_to_95_s"] is None
    effective = from_toml(tmp_path / "out" / "config.toml")
    assert effective.noise.slip == 0.1 and effective.coverage_target == 0.99


def test_json_has_null_for_what_is_not_finite() -> None:
    values = [np.float64("nan"), math.inf, np.int64(3), np.bool_(True), None, "ekf", 0.5]
    assert json.dumps([plain(v) for v in values]) == '[null, null, 3, true, null, "ekf", 0.5]'


def test_a_folder_where_a_file_goes_is_found_before_the_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "map.png").mkdir()
    assert main(["explore", "--rooms", "rectangular", "--out", str(tmp_path)]) == 2
    assert "map.png: it is a folder" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["map.png"]


@pytest.mark.parametrize("robots", [[], ["--robots", "2"]])
def test_the_plan_that_is_explored_is_not_overwritten(
    robots: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_room(tmp_path / "map.pgm")
    Path("map.yaml").write_text(
        "image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for plan in ("map.yaml", str(tmp_path / "map.pgm")):
        assert main(["explore", "--floor-plan", plan, "--max-steps", "2", "--out", ".", *robots]) == 2
        assert "would be lost; choose another --out" in capsys.readouterr().err
        with pytest.raises(ValueError, match="would be lost"):
            training.explore(floor_plan=plan, max_steps=2, out=".")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert main(["explore", "--floor-plan", "map.yaml", "--max-steps", "2", "--out", "out"]) == 0


def test_ctrl_c_keeps_the_episode_so_far(tmp_path: Path) -> None:
    options = ["--agent", "random", "--max-steps", "1000000", "--out", str(tmp_path / "out")]
    process = run("explore", *options, "--json")
    assert process.stderr is not None
    assert process.stderr.readline().startswith("exploring")
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "interrupted after" in err and str(tmp_path / "out") in err and "Traceback" not in err
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text("utf-8"))
    assert json.loads(out) == metrics
    assert metrics["interrupted"] is True and metrics["end"] == "interrupted" and metrics["steps"] < 1000000
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(FILES)
    times, _ = read_tum(tmp_path / "out" / "trajectory_true.tum")
    assert len(times) == metrics["steps"] + 1


def test_sigterm_is_ctrl_c_but_for_the_exit_code(tmp_path: Path) -> None:
    process = run("explore", "--agent", "random", "--max-steps", "1000000", "--out", str(tmp_path / "out"))
    assert process.stderr is not None
    assert process.stderr.readline().startswith("exploring")
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 143
    assert "interrupted after" in err and "Traceback" not in err
    assert json.loads((tmp_path / "out" / "metrics.json").read_text("utf-8"))["interrupted"] is True
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(FILES)


def test_what_kills_a_run_takes_no_more_than_a_minute_of_it(tmp_path: Path) -> None:
    """The files are there while it runs, whole, and each writing's are of one moment."""
    episode, recorder = task.prepare(out=tmp_path, agent="random", rooms="rectangular", max_steps=60), Recorder()
    saver = Saver(episode, lambda: write_episode(episode, recorder.recording()), every_s=0.0)
    seen: list[int] = []

    class Look:
        def take(self, env: ExploreEnv, goal: Goal | None) -> None:
            if (tmp_path / "metrics.json").exists():
                metrics = json.loads((tmp_path / "metrics.json").read_text("utf-8"))
                times, _ = read_tum(tmp_path / "trajectory_true.tum")
                assert metrics["end"] == "running" and len(times) == metrics["steps"] + 1
                assert sorted(p.name for p in tmp_path.iterdir()) == sorted(FILES)
                seen.append(metrics["steps"])

    task.run(episode, lambda **_: None, [recorder, saver, Look()])
    assert episode.end == "time" and seen and seen[0] <= 1


_INTERRUPTED_AT = """
import os, signal, sys

class CtrlC:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[1]:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, CtrlC())
from training.cli import main
sys.exit(main(sys.argv[2:]))
"""


def test_ctrl_c_before_the_episode_writes_nothing(tmp_path: Path) -> None:
    # It comes when the command imports what explores.
    result = subprocess.run(
        [sys.executable, "-c", _INTERRUPTED_AT, "training.episodes.explore", "explore", "--out", tmp_path / "out"],
        capture_output=True, text=True, check=False, timeout=60,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert result.returncode == 130
    assert result.stderr == "mecanum explore: interrupted before the results were written\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
def test_what_is_not_the_users_fault_is_one_line_with_exit_code_1(tmp_path: Path) -> None:
    with open("/dev/full", "w") as full:
        result = subprocess.run(
            [sys.executable, "-m", "training.cli", "rooms", "--seeds", "0", "--out", str(tmp_path), "--json"],
            stdout=full, stderr=subprocess.PIPE, text=True, cwd=ROOT, timeout=120,
        )  # fmt: skip
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1 and "MECANUM_TRACEBACK=1" in result.stderr
    assert result.stderr.startswith("mecanum rooms: OSError")


def test_help_is_quick_and_loads_nothing_heavy() -> None:
    code = (
        "import sys; from training.cli import main; code = main(['explore', '--help']);"
        "print(sorted({'numba', 'numpy', 'cv2', 'gymnasium', 'torch', 'rich'} & set(sys.modules)), code)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=60)
    assert result.stdout.splitlines()[-1] == "[] 0", result.stderr
    assert "mecanum explore --floor-plan" in result.stdout


@pytest.mark.parametrize("command", ["explore", "rooms", "speed"])
def test_help_shows_runnable_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert sum(line.startswith(f"mecanum {command}") for line in lines) >= 2


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("mecanum-slam")


def test_what_is_asked_for_besides_is_written_and_what_is_left_of_another_episode_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in ("imageio_ffmpeg", "mcap", "rerun"):
        pytest.importorskip(module)
    out = tmp_path / "out"
    command = ["explore", "--rooms", "rectangular", "--max-steps", "12", "--out", str(out)]
    assert main([*command, "--video", "--mcap", "--rerun"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in EXTRAS.values())
    assert sorted(p.name for p in out.iterdir()) == sorted([*FILES, *EXTRAS.values()])
    assert all((out / name).stat().st_size > 1000 for name in EXTRAS.values())
    assert main([*command, "--mcap"]) == 0
    assert sorted(p.name for p in out.iterdir()) == sorted([*FILES, "episode.mcap"])


def test_an_extra_that_is_not_installed_is_named_before_the_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, option, extra in (
        ("imageio_ffmpeg", "--video", "video"), ("mcap.writer", "--mcap", "ros"), ("rerun", "--rerun", "rerun"),
    ):  # fmt: skip
        monkeypatch.setitem(sys.modules, module, None)
        assert main(["explore", option, "--out", str(tmp_path / "out")]) == 2
        line = capsys.readouterr().err
        assert line.count("\n") == 1 and f"pip install 'mecanum-slam[{extra}]'" in line
    assert not (tmp_path / "out").exists()


def test_a_film_that_fails_costs_the_film_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho no space left on device >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(broken))
    out = tmp_path / "out"
    command = ["explore", "--rooms", "rectangular", "--max-steps", "12", "--out", str(out), "--video"]
    assert main(command) == 1
    assert "no space left on device; all but the film is in" in capsys.readouterr().err
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "none"))
    assert main(command) == 2
    assert "a film needs ffmpeg" in capsys.readouterr().err


def test_an_error_while_filming_leaves_the_episode_before_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "out"
    command = ["explore", "--rooms", "rectangular", "--max-steps", "12", "--out", str(out), "--video"]
    assert main(command) == 0
    before = {p.name: p.read_bytes() for p in out.iterdir()}

    def failing(*_: Any, **__: Any) -> Any:
        raise RuntimeError("of a test")

    monkeypatch.setattr("training.views.episode_files.episode_page", failing)
    assert main(command) == 1
    assert {p.name: p.read_bytes() for p in out.iterdir()} == before
