"""``mecanum explore --robots N`` end to end."""

from __future__ import annotations

import json
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.base import Goal
from mecanum_env.config import from_toml
from mecanum_env.team.team import Team
from slam.landmarks.database import read_landmark_map
from tests.slam.written_files import read_map_server, read_tum
from tests.training.cli.test_bad_input import explore_refused
from tests.training.cli.test_explore import run
from training.cli import main
from training.episodes import team as task
from training.episodes.explore import FILES as SINGLE_FILES
from training.episodes.recording import TeamRecorder
from training.episodes.team import FILES, LANDMARKS, files_of
from training.views.episode_files import Saver
from training.views.team_files import write_team_episode

SHORT = ["explore", "--rooms", "rectangular", "--seed", "3", "--max-steps", "15"]


def files(robots: int) -> list[str]:
    return sorted([*FILES, LANDMARKS, *(name for k in range(robots) for name in files_of(k))])


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("team") / "out"
    command = [*SHORT, "--robots", "2", "--communication", "range", "--range", "4", "--out", str(out)]
    assert main(command) == 0
    return out


def metrics_of(out: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / "metrics.json").read_text("utf-8"))
    return found


def test_every_file_is_there_and_of_the_episode(out: Path) -> None:
    assert sorted(p.name for p in out.iterdir()) == files(2)
    metrics = metrics_of(out)
    assert (metrics["robots"], metrics["communication"]) == (2, "range")
    for k, robot in enumerate(metrics["per_robot"]):
        times, true = read_tum(out / f"trajectory_true_robot_{k}.tum")
        _, estimate = read_tum(out / f"trajectory_estimate_robot_{k}.tum")
        assert len(times) == metrics["steps"] + 1
        apart = np.hypot(*(true[:, :2] - estimate[:, :2]).T)
        assert np.sqrt(np.mean(apart**2)) == pytest.approx(robot["ate_rmse_m"], abs=1e-6)
        landmarks = read_landmark_map(out / f"landmarks_robot_{k}.db").landmarks
        assert len(landmarks) == robot["landmarks"]
    together = read_landmark_map(out / LANDMARKS)
    assert set(together.sightings["robot"].tolist()) == {0, 1}
    merged, own = (read_map_server(out / f"{name}.yaml")[0] for name in ("map", "map_robot_0"))
    assert np.count_nonzero(merged != -1) >= np.count_nonzero(own != -1) > 0
    assert from_toml(out / "config.toml").coverage_target == 0.95


def test_the_config_repeats_the_episode(out: Path, tmp_path: Path) -> None:
    assert main(["explore", "--config", str(out / "config.toml"), "--out", str(tmp_path)]) == 0
    for name in set(files(2)) - {"metrics.json"}:
        assert (tmp_path / name).read_bytes() == (out / name).read_bytes(), name


def test_files_of_another_episode_are_taken_away(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("imageio_ffmpeg")
    there = ["--out", str(tmp_path)]
    (tmp_path / "notes_robot_0.txt").write_text("mine")
    mine = ["notes_robot_0.txt"]
    assert main([*SHORT, "--robots", "3", "--video", *there]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*files(3), "episode.mp4", *mine])
    assert main([*SHORT, "--robots", "2", "--json", *there]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*files(2), *mine])
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == metrics_of(tmp_path)
    assert main([*SHORT, *there]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*SINGLE_FILES, *mine])
    capsys.readouterr()
    assert main([*SHORT, "--robots", "2", *there]) == 0
    assert " landmarks.db," in capsys.readouterr().out
    assert main([*SHORT, "--robots", "2", "--slam", "odometry", *there]) == 0
    assert " landmarks.db," not in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted({*files(2), *mine} - {LANDMARKS})


@pytest.mark.parametrize(("how", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_keeps_the_episode_so_far(tmp_path: Path, how: signal.Signals, code: int) -> None:
    options = ["--robots", "2", "--agent", "random", "--max-steps", "1000000", "--out", str(tmp_path / "out")]
    process = run("explore", *options)
    assert process.stderr is not None
    assert process.stderr.readline().startswith("exploring")
    process.send_signal(how)
    _, err = process.communicate(timeout=120)
    assert process.returncode == code
    assert "interrupted after" in err and "Traceback" not in err
    metrics = metrics_of(tmp_path / "out")
    assert metrics["interrupted"] is True and metrics["end"] == "interrupted"
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == files(2)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--communication", "range"], "--communication is for several robots; give --robots 2"),
        (["--unknown-starts", "--robots", "1"], "--unknown-starts is for several robots"),
        (["--joint-belief"], "--joint-belief is for several robots"),
        (["--robots", "2", "--joint-belief", "--communication", "none"], "unlimited communication"),
        (["--robots", "2", "--joint-belief", "--slam", "dp-slam"], "ekf-lines"),
        (["--robots", "2", "--joint-belief", "--slam", "invariant-ekf"], "leave out --slam invariant-ekf"),
        (["--robots", "2", "--communication", "rang"], "got 'rang' (did you mean 'range'?)"),
        (["--robots", "2", "--range", "5"], "--range 5 means nothing with --communication unlimited"),
        (["--robots", "2", "--communication", "walls", "--range", "-1"], "'--range'"),
        (["--robots", "2", "--starts", "anywhere"], "starts must be one of together, scattered, got 'anywhere'"),
        (["--robots", "2", "--mcap"], "--mcap is for one robot"),
        (["--robots", "0"], "'--robots'"),
        (["--robots", "60", "--rooms", "rectangular"], "has room for"),
        (["--robots", "2", "--agent", "nobody"], "nobody"),
    ],
)
def test_bad_input(argv: list[str], words: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert words in explore_refused(argv, capsys, tmp_path / "out")


def test_what_kills_a_run_takes_no_more_than_a_minute_of_it(tmp_path: Path) -> None:
    episode = task.prepare(
        task.read_team(robots=2), out=tmp_path, agent="random", rooms="rectangular", max_steps=30
    )
    recorder = TeamRecorder()
    seen: list[int] = []

    class Look:
        def take(self, team: Team, goals: Sequence[Goal | None]) -> None:
            if (tmp_path / "metrics.json").exists():
                metrics = metrics_of(tmp_path)
                times, _ = read_tum(tmp_path / "trajectory_true_robot_1.tum")
                assert metrics["end"] == "running" and len(times) == metrics["steps"] + 1
                assert sorted(p.name for p in tmp_path.iterdir()) == files(2)
                seen.append(metrics["steps"])

    saver = Saver(episode, lambda: write_team_episode(episode, recorder.recording()), every_s=0.0)
    task.run(episode, lambda **_: None, [recorder, saver, Look()])
    assert episode.end == "time" and seen and seen[0] <= 1
