"""``mecanum benchmark``: rows that survive anything, once each, the same in any number of workers; refusals."""

from __future__ import annotations

import json
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest

import agents
from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS
from tests.training.benchmark.small import alive, children, contents, count, measure, small
from tests.training.cli.test_bad_input import refused
from training.benchmark import run as benchmark
from training.benchmark.episode import EpisodeFailure, EpisodeJob, EpisodeRow, run_job
from training.benchmark.figures import METRICS
from training.benchmark.store import FILE
from training.cli import main
from training.episodes.explore import prepare
from training.truth import known_map

# ---- the command -----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("here")
def test_json_has_the_contract_s_keys_and_the_files_are_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = measure(small(tmp_path, "--agents", "nearest-frontier,random", "--report"), capsys)
    assert result["rooms"].keys() == {"nearest-frontier", "random"}
    for found in result["rooms"].values():
        assert found.keys() == {metric.key for metric in METRICS}
        assert all(figure.keys() >= {"iqm", "median", "low", "high", "n"} for figure in found.values())
    coverage = result["rooms"]["nearest-frontier"]["coverage"]
    assert 0 < coverage["low"] <= coverage["iqm"] <= coverage["high"] <= 1 and coverage["n"] == 3
    assert result["comparison"]["rooms"].keys() == {"random"}
    assert sum(result["ends"]["rooms"]["random"].values()) == 3
    assert result["config"]["seeds"] == {"rooms": [0, 1, 2]} and result["config"]["split"] is None
    assert json.loads((tmp_path / "summary.json").read_text("utf-8")) == result
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "results.sqlite", "settings.json", "config.toml", "episodes.csv", "summary.csv", "comparison.csv",
        "summary.json", "tables.md", "report.html",
    }  # fmt: skip
    lines = (tmp_path / "episodes.csv").read_text("utf-8").splitlines()
    assert lines[0].startswith("suite,place,seed,agent,slam,coverage,") and len(lines) == 7
    (tmp_path / "episodes.parquet").touch()
    assert main(small(tmp_path)) == 0
    assert "nearest-frontier" in capsys.readouterr().out
    left = {path.name for path in tmp_path.iterdir()}
    assert left == names - {"report.html"}, "what shows other episodes than the tables goes"


@pytest.mark.usefixtures("here")
def test_the_planner_that_knows_the_map_stands_beside_the_agents(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, less in (("_STARTS", 1), ("_TRIES", 1000), ("_TIMED", 4), ("_MARGINS", (0.001, 0.01))):
        monkeypatch.setattr(known_map, name, less)
    result = measure(small(tmp_path, "--agents", "nearest-frontier,known-map", "--report", seeds="0:0"), capsys)
    assert result["rooms"].keys() == {"nearest-frontier", "known-map"}
    assert "are no agents" in (tmp_path / "report.html").read_text("utf-8")


@pytest.mark.usefixtures("here")
def test_another_robot_or_lidar_is_what_explores_and_has_a_folder_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lidar = tmp_path / "lidar.toml"
    lidar.write_text("[lidar]\nbeams = 90\n\n[noise]\nrange_sigma_m = 0.02\n", "utf-8")
    command = small(tmp_path / "out", "--config", str(lidar), seeds="0")
    measure(command, capsys)
    used = tomllib.loads((tmp_path / "out" / "config.toml").read_text("utf-8"))
    assert (used["lidar"]["beams"], used["noise"]["range_sigma_m"], used["rooms"]) == (90, 0.02, "rectangular")
    plan = benchmark.BenchmarkPlan.parse(
        suite="rooms,rooms-slippery", agents="random", slam=None, robot="cavity", config=lidar
    )
    nominal, slippery = (prepare(**job.options).config for job in plan.jobs[:2])
    assert nominal.robot == slippery.robot == ROBOT_PRESETS["cavity"]
    assert (nominal.noise, slippery.noise) == (NOISE_PRESETS["cavity"], NOISE_PRESETS["slippery"])
    assert "choose another --out" in refused(small(tmp_path / "out", seeds="0"), capsys)
    lidar.write_text("[lidar]\nbeams = 91\n", "utf-8")
    assert "choose another --out" in refused(command, capsys)
    assert "valid: " in refused(small(tmp_path / "new", "--robot", "youbo"), capsys)
    assert not (tmp_path / "new").exists()
    lidar.write_text('slam = "ekf"\n\n[run]\nseed = 3\n', "utf-8")
    assert benchmark.BenchmarkPlan.parse(suite="rooms", agents="random", slam=None, config=lidar).backends == (
        "ekf",
    )
    lidar.write_text("[run]\nagent = 3\n", "utf-8")
    assert "[run] agent has the wrong type" in refused(small(tmp_path / "new", "--config", str(lidar)), capsys)


@pytest.mark.usefixtures("here")
def test_a_policy_of_ones_own_runs_and_its_rows_are_not_mixed_with_those_of_other_weights(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped, mine = agents.make("ppo-frontier").policy_path, tmp_path / "mine.safetensors"  # type: ignore[attr-defined]
    mine.write_bytes(shipped.read_bytes())
    about = json.loads(shipped.with_suffix(".json").read_text("utf-8"))
    mine.with_suffix(".json").write_text(json.dumps(about), "utf-8")
    command = small(tmp_path / "out", "--agents", str(mine), seeds="0")
    assert measure(command, capsys)["rooms"].keys() == {str(mine)}
    about["driver"]["control"]["speed_share"] = 0.5
    mine.with_suffix(".json").write_text(json.dumps(about), "utf-8")
    assert "choose another --out" in refused(command, capsys)


@pytest.mark.usefixtures("here")
def test_config_toml_explores_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    measure(small(tmp_path, seeds="0"), capsys)
    argv = ["explore", "--config", str(tmp_path / "config.toml"), "--max-steps", "5", "--out", str(tmp_path / "e")]
    assert main([*argv, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rooms"] == "rectangular"


@pytest.mark.usefixtures("here")
def test_ctrl_c_keeps_the_rows_and_the_same_command_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[int] = []

    def interrupted(job: EpisodeJob) -> EpisodeRow | EpisodeFailure:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(job.seed)
        return run_job(job)

    monkeypatch.setattr(benchmark, "run_job", interrupted)
    assert main(small(tmp_path)) == 130
    assert "interrupted after 2 of 3 episodes; run the same command again" in capsys.readouterr().err
    assert len(contents(tmp_path)) == 2
    done.clear()
    measure(small(tmp_path), capsys)
    assert done == [2]
    done.clear()
    measure(small(tmp_path, seeds="1:3"), capsys)  # other seeds of the same
    assert done == [3] and len(contents(tmp_path)) == 4


@pytest.mark.usefixtures("here")
def test_an_episode_that_fails_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from agents.nearest_frontier import NearestFrontier

    inner = NearestFrontier.reset

    def breaks(self: NearestFrontier, belief: Any, seed: int = 0) -> None:
        if seed == 1:
            raise ZeroDivisionError("of\nall things")
        inner(self, belief, seed)

    monkeypatch.setattr(NearestFrontier, "reset", breaks)
    monkeypatch.setenv("MECANUM_TRACEBACK", "1")
    assert main(small(tmp_path, "--report")) == 1
    *trace, error = capsys.readouterr().err.splitlines()
    assert any('raise ZeroDivisionError("of' in line for line in trace), "the line that failed"
    assert "1 of 3 episodes failed" in error and "seed 1" in error and "ZeroDivisionError: of all things" in error
    assert {key[2] for key in contents(tmp_path)} == {0, 2}
    assert "nearest-frontier" in (tmp_path / "summary.csv").read_text("utf-8")
    assert "2 episodes an agent" in (tmp_path / "report.html").read_text("utf-8")
    assert main(small(tmp_path, "--json")) == 1
    told = capsys.readouterr()
    assert json.loads(told.out)["rooms"]["nearest-frontier"]["coverage"]["n"] == 2
    assert "1 of 1 episodes failed" in told.err
    assert main(small(tmp_path)) == 1
    assert "nearest-frontier" in capsys.readouterr().out, "the table, too"


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("harm", ["status", "row"])
def test_an_agent_that_makes_rows_no_table_can_be_made_of_fails_alone(
    harm: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from agents.random import RandomAgent

    if harm == "status":
        monkeypatch.setattr(RandomAgent, "status", property(lambda self: None))
        words = "random, invariant-ekf: TypeError: status of agent RandomAgent must be a word (str), got None"
    else:

        def unreadable(job: EpisodeJob) -> EpisodeRow | EpisodeFailure:
            row = run_job(job)
            if job.agent == "random" and isinstance(row, EpisodeRow):
                row.metrics["end"] = None
            return row

        monkeypatch.setattr(benchmark, "run_job", unreadable)
        words = "random, invariant-ekf: a row's metrics lack end, a word"
    assert main(small(tmp_path, "--agents", "nearest-frontier,random", "--json", seeds="0")) == 1
    told = capsys.readouterr()
    assert words in told.err and json.loads(told.out)["rooms"].keys() == {"nearest-frontier"}
    assert {key[3] for key in contents(tmp_path)} == {"nearest-frontier"}


def test_killed_in_the_middle_and_run_again_it_has_the_rows_of_an_undisturbed_run(tmp_path: Path) -> None:
    """No row twice, missing or different; from two workers as from one; and no worker outlives its parent."""
    root = Path(__file__).resolve().parents[3]
    killed, whole, seeds = tmp_path / "killed", tmp_path / "whole", "0:59"
    run = subprocess.Popen(
        [sys.executable, "-m", "training.cli", *small(killed, "--workers", "2", seeds=seeds)],
        cwd=root, env=os.environ | {"PYTHONPATH": str(root)}, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    began = time.monotonic()
    while count(killed) < 3 and run.poll() is None and time.monotonic() - began < 120:
        time.sleep(0.002)
    workers = children(run.pid)
    run.send_signal(signal.SIGKILL)
    assert run.wait() == -signal.SIGKILL
    before = contents(killed)
    assert 3 <= len(before) < 60
    began = time.monotonic()
    while any(map(alive, workers)) and time.monotonic() - began < 60:
        time.sleep(0.02)
    assert not any(map(alive, workers))
    assert main(small(killed, seeds=seeds)) == main(small(whole, seeds=seeds)) == 0
    after = contents(killed)
    assert len(after) == 60 and after == contents(whole)
    assert before.items() <= after.items()


@pytest.mark.usefixtures("here")
def test_the_documented_agent_is_found_by_its_entry_point(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (Path(__file__).resolve().parents[3] / "BENCHMARK.md").read_text("utf-8")
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    assert len(code.splitlines()) <= 20
    toml = tomllib.loads(re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[0])
    site = tmp_path / "site"
    info = site / "my_agents-0.1.dist-info"
    info.mkdir(parents=True)
    (site / "my_agents.py").write_text(code, "utf-8")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-agents\nVersion: 0.1\n")
    ((group, points),) = toml["project"]["entry-points"].items()
    (info / "entry_points.txt").write_text(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()))
    monkeypatch.syspath_prepend(site)
    agents._installed.cache_clear()
    try:
        result = measure(small(tmp_path / "out", "--agents", "most-area-per-metre", seeds="0"), capsys)
        (info / "entry_points.txt").write_text(f"[{group}]\nmost-area-per-metre = nowhere:Agent\n")
        agents._installed.cache_clear()
        line = refused(small(tmp_path / "out", "--agents", "most-area-per-metre"), capsys)
    finally:
        monkeypatch.undo()
        agents._installed.cache_clear()
    assert result["rooms"]["most-area-per-metre"]["coverage"]["value"] > 0.3
    assert "cannot load agent most-area-per-metre" in line and "nowhere" in line


# ---- what is refused -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ["--suite", "appartments"],
            ["unknown suite 'appartments'", "did you mean 'apartments'?", "mazes", "all"],
        ),
        (["--suite", "rooms,"], ["unknown suite ''"]),
        (["--suite", "floor-plans"], ["--floor-plans DIR"]),
        (["--agents", "nearest"], ["unknown agent 'nearest'", "random"]),
        (["--agents", ""], ["unknown agent ''"]),
        (["--slam", "efk"], ["unknown SLAM backend 'efk'", "did you mean 'ekf'?"]),
        (["--split", "tests"], ["unknown split 'tests'", "validation"]),
        (["--seeds", "5:1"], ["--seeds", "upwards"]),
        (["--seeds", "x"], ["--seeds 'x'", "0:9"]),
        (["--seeds", "0:99999"], ["more than 10000"]),
        (["--baseline", "random"], ["--baseline random", "--agents"]),
        (["--max-steps", "0"], ["--max-steps"]),
        (["--workers", "0"], ["--workers"]),
        (["--protocol", "dungeon"], ["unknown protocol 'dungeon'", "did you mean dungeons?"]),
        (["--protocol", "dungeons"], ["--maps DIR"]),
        (["--maps", "somewhere"], ["--protocol dungeons"]),
        (["--protocol", "dungeons", "--maps", "x", "--slam", "ekf"], ["no --slam"]),
        (["--protocol", "dungeons", "--maps", "x", "--split", "test"], ["no --split"]),
        (["--scan", "continuous"], ["--scan belongs to", "--protocol dungeons"]),
        (["--sensor", "public"], ["--sensor belongs to", "--protocol dungeons"]),
        (["--protocol", "dungeons", "--maps", "nowhere"], ["--maps nowhere", "no folder"]),
        (["--floor-plans", "nowhere"], ["--floor-plans nowhere", "no folder"]),
        (["--floor-plans", ".", "--suite", "rooms"], ["--floor-plans belongs to the suite floor-plans"]),
        (["--split", "validation", "--seeds", "3"], ["--seeds are others than those of --split"]),
    ],
)
def test_bad_input(argv: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["benchmark", "--out", str(tmp_path / "out"), *argv], capsys)
    assert line.startswith("mecanum benchmark: ")
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


def test_bad_floor_plans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plans = tmp_path / "plans"
    plans.mkdir()
    argv = ["benchmark", "--floor-plans", str(plans), "--out", str(tmp_path / "out")]
    assert "holds no plan" in refused(argv, capsys)
    (plans / "broken.png").write_bytes(b"no picture")
    assert "broken.png" in refused(argv, capsys)
    assert not (tmp_path / "out").exists()


def test_an_out_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    assert "is not a folder" in refused(small(tmp_path / "file"), capsys)
    (tmp_path / "out" / FILE).mkdir(parents=True)
    assert "it is a folder" in refused(small(tmp_path / "out"), capsys)


@pytest.mark.usefixtures("here")
def test_rows_of_other_settings_or_code_are_not_mixed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    measure(small(tmp_path, seeds="0"), capsys)
    before = contents(tmp_path)
    line = refused(small(tmp_path, "--max-steps", "26"), capsys)
    assert "holds runs with max_steps = 25, not 26" in line and "another --out" in line
    monkeypatch.setattr(benchmark, "code_digest", lambda *modules: "another version")
    line = refused(small(tmp_path), capsys)
    assert "rows of nearest-frontier with invariant-ekf on rooms that other code" in line
    monkeypatch.undo()
    assert contents(tmp_path) == before


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("harm", "words"),
    [
        ("bytes", ["not a database", "another --out"]),
        ("version", ["version 99, not 1"]),
        ("other", ["no store of a benchmark"]),
        ("half", ["cannot use"]),
    ],
)
def test_a_store_that_cannot_be_used(
    harm: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / FILE
    if harm == "bytes":
        path.write_bytes(b"something else, and long enough for a header" * 40)
    elif harm == "other":
        with sqlite3.connect(path) as connection:
            connection.execute("CREATE TABLE mine (x)")
    else:
        measure(small(tmp_path, seeds="0"), capsys)
        if harm == "version":
            with sqlite3.connect(path) as connection:
                connection.execute("PRAGMA user_version = 99")
        else:
            path.write_bytes(path.read_bytes()[:5000])
    before = path.read_bytes()
    line = refused(small(tmp_path), capsys)
    assert all(word in line for word in [*words, FILE]), line
    assert path.read_bytes() == before


def test_the_dungeons_protocol_gets_its_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from training.dungeons import protocol as dungeons

    given: list[Any] = []

    def run(*args: Any, **more: Any) -> dict[str, Any]:
        given.append((args, more))
        return {"agents": {}}

    monkeypatch.setattr(dungeons, "run_dungeons", run)
    argv = ["--protocol", "dungeons", "--maps", "m", "--agents", "random, tour", "--workers", "2", "--json"]
    assert main(["benchmark", "--out", str(tmp_path), *argv, "--scan", "continuous"]) == 0
    assert json.loads(capsys.readouterr().out) == {"agents": {}}
    how = {"scan": "continuous", "sensor": "public"}
    assert given == [((Path("m"), ["random", "tour"]), {"out": tmp_path, "workers": 2} | how)]


# ---- the parts -------------------------------------------------------------------------------------------------


def test_every_agent_gets_to_a_seed_before_any_gets_to_the_next() -> None:
    plan = benchmark.BenchmarkPlan.parse(suite="rooms,mazes", agents="random,nearest-frontier", slam="ekf")
    jobs = plan.jobs
    assert len(jobs) == len({job.key for job in jobs}) == 200
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    assert plan.baseline == "nearest-frontier"
