"""``mecanum benchmark``: rows that survive anything, once each, the same in any number of workers; refusals."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
import tomllib
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import agents
from tests.training.cli.test_bad_input import refused
from tests.training.plans import write_room
from training.benchmark import run as benchmark
from training.benchmark import suites
from training.benchmark.episode import (
    CURVE_POINTS,
    WALL_CLOCK,
    EpisodeFailure,
    EpisodeJob,
    EpisodeRow,
    Key,
    resampled,
    run_job,
)
from training.benchmark.figures import METRICS, Group, comparisons, figures, with_regrets
from training.benchmark.store import FILE, Store
from training.benchmark.suites import SPLITS
from training.cli import main
from training.runs.campaign import run_all
from training.runs.provenance import code_digest, modules_behind
from training.truth import known_map

STEPS = 25


def small(out: Path, *more: str, seeds: str = "0:2") -> list[str]:
    return [
        "benchmark", "--suite", "rooms", "--agents", "nearest-frontier", "--seeds", seeds,
        "--max-steps", str(STEPS), "--workers", "1", "--out", str(out), *more,
    ]  # fmt: skip


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the episodes in this process: starting another takes longer than they do."""

    def in_this_process(*args: Any, apart: bool, workers: int, **more: Any) -> None:
        run_all(*args, apart=False, workers=1, **more)

    monkeypatch.setattr(benchmark, "run_all", in_this_process)


def measure(argv: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    assert main([*argv, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def contents(out: Path) -> dict[Key, tuple[Any, ...]]:
    """Return all that is in a store but wall-clock."""
    with Store(out / FILE) as store:
        made_by = store.made_by()
        return {key: (made_by[key], *without_clock(row)) for key, row in store.rows(made_by)}


def without_clock(row: EpisodeRow) -> tuple[Any, ...]:
    metrics = {name: value for name, value in row.metrics.items() if name not in WALL_CLOCK}
    curves = (row.coverage_by_time, row.coverage_by_path, row.nees)
    return metrics, *(curve.tobytes() for curve in curves), row.thumbnail


def episode(key: Key, **metrics: Any) -> EpisodeRow:
    """Return a made-up row."""
    some = dict.fromkeys(m.key for m in METRICS) | {
        "coverage": 0.99, "time_s": 60.0, "path_length_m": 30.0, "collisions": 0, "limit_s": 300.0,
        "time_to_50_s": 10.0, "time_to_90_s": 40.0, "time_to_95_s": 50.0, "time_to_99_s": None,
        "ate_rmse_m": 0.01, "final_position_error_m": 0.02, "end": "covered",
    }  # fmt: skip
    curve = np.linspace(0.1, 0.99, CURVE_POINTS).astype(np.float32)
    png = cv2.imencode(".png", np.full((30, 40, 3), 200, np.uint8))[1].tobytes()
    return EpisodeRow(
        metrics=some | metrics, coverage_by_time=curve, coverage_by_path=curve,
        nees=np.ones(3, np.float32), thumbnail=png,
    )  # fmt: skip


def made_up_group(agent: str = "a", suite: str = "rooms", **columns: list[Any]) -> Group:
    n = len(next(iter(columns.values())))
    keys = tuple((suite, "rectangular", seed, agent, "ekf") for seed in range(n))
    rows = tuple(
        episode(key, **{name: values[k] for name, values in columns.items()}) for k, key in enumerate(keys)
    )
    return Group(suite=suite, agent=agent, slam="ekf", keys=keys, rows=rows)


# ---- the suites ------------------------------------------------------------------------------------------------


def test_splits_are_disjoint_and_suites_have_all_five_kinds_twice() -> None:
    seeds = [set(split) for split in SPLITS.values()]
    assert not (seeds[0] & seeds[1] or seeds[0] & seeds[2] or seeds[1] & seeds[2])
    assert SPLITS["test"] == range(10000, 10050)
    every = suites.choose("all")
    assert len(every) == 10 and {suite.noise for suite in every} == {"nominal", "slippery"}
    assert {place.rooms for suite in every for place in suite.places} == {
        "rectangular", "apartment", "corridors", "cave", "maze",
    }  # fmt: skip
    assert [s.name for s in suites.choose("mazes-slippery, rooms,mazes-slippery")] == ["mazes-slippery", "rooms"]


def test_floor_plans_are_maps_and_images_that_belong_to_none(tmp_path: Path) -> None:
    write_room(tmp_path / "a.png")
    write_room(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    (tmp_path / "notes.txt").write_text("no plan")
    (suite,) = suites.choose("floor-plans", floor_plans=tmp_path)
    assert [place.name for place in suite.places] == ["a.png", "map.yaml"]
    assert len(suite.seeds("test")) == 5
    assert len(suites.choose("all", floor_plans=tmp_path)) == 12
    before = [place.digest for place in suite.places]
    write_room(tmp_path / "map.pgm", width_m=5.0)
    (suite,) = suites.choose("floor-plans", floor_plans=tmp_path)
    assert [a == b.digest for a, b in zip(before, suite.places, strict=True)] == [True, False]


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
    assert main(small(tmp_path)) == 0
    assert "nearest-frontier" in capsys.readouterr().out


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


def test_ctrl_c_in_an_episode_leaves_no_row(monkeypatch: pytest.MonkeyPatch) -> None:
    from training.benchmark import episode as benchmark_episode

    def pressed(found: Any, progress: Any) -> None:
        found.end, found.interrupted = "interrupted", True

    monkeypatch.setattr(benchmark_episode, "run", pressed)
    with pytest.raises(KeyboardInterrupt):
        run_job(EpisodeJob(
            suite="rooms", place="rectangular", rooms="rectangular", seed=0, agent="random", slam="odometry",
            noise="nominal",
        ))  # fmt: skip


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
    assert main(small(tmp_path, "--report")) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert "1 of 3 episodes failed" in error and "seed 1" in error and "ZeroDivisionError: of all things" in error
    assert {key[2] for key in contents(tmp_path)} == {0, 2}
    assert "nearest-frontier" in (tmp_path / "summary.csv").read_text("utf-8")
    assert "2 episodes an agent" in (tmp_path / "report.html").read_text("utf-8")


def test_killed_in_the_middle_and_run_again_it_has_the_rows_of_an_undisturbed_run(tmp_path: Path) -> None:
    """No row twice, missing or different; from two workers as from one; and no worker outlives its parent."""
    root = Path(__file__).resolve().parents[3]
    killed, whole, seeds = tmp_path / "killed", tmp_path / "whole", "0:19"
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
    assert 3 <= len(before) < 20
    began = time.monotonic()
    while any(map(alive, workers)) and time.monotonic() - began < 60:
        time.sleep(0.02)
    assert not any(map(alive, workers))
    assert main(small(killed, seeds=seeds)) == main(small(whole, seeds=seeds)) == 0
    after = contents(killed)
    assert len(after) == 20 and after == contents(whole)
    assert before.items() <= after.items()


def count(out: Path) -> int:
    try:
        with sqlite3.connect(f"file:{out / FILE}?mode=ro", uri=True) as connection:
            return int(connection.execute("SELECT count(*) FROM episodes").fetchone()[0])
    except sqlite3.Error:  # not there yet
        return 0


def children(pid: int) -> list[int]:
    file = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in file.read_text().split()] if file.exists() else []


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


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
        (["--protocol", "dungeons", "--maps", "nowhere"], ["--maps nowhere", "no folder"]),
        (["--floor-plans", "nowhere"], ["--floor-plans nowhere", "no folder"]),
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


def test_two_runs_into_one_store_do_not_disturb_each_other(tmp_path: Path) -> None:
    job = EpisodeJob(suite="rooms", place="rectangular", seed=1, agent="a", slam="ekf", noise="nominal")
    with Store(tmp_path / FILE) as one, Store(tmp_path / FILE) as other:
        one.add(job, episode(job.key), made_by="x")
        other.add(job, episode(job.key, coverage=0.5), made_by="x")
        ((key, row),) = one.rows([job.key, ("rooms", "rectangular", 2, "a", "ekf")])
    assert key == job.key and without_clock(row) == without_clock(episode(key))


def test_a_curve_holds_until_the_next_row() -> None:
    curve = resampled(np.array([0.1, 0.5, 0.9]), np.array([0.0, 0.0, 127.0]))
    np.testing.assert_array_equal(curve, np.array([0.5] * 127 + [0.9], np.float32))
    np.testing.assert_array_equal(resampled(np.array([0.3]), np.array([0.0])), np.full(128, 0.3, np.float32))


def test_a_digest_follows_imports_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    behind = modules_behind("training.benchmark.episode").keys()
    assert {
        "training.episodes.explore",
        "mecanum_env.env",
        "mecanum_env.rooms.cave",
        "slam.ekf",
        "agents.base",
    } <= behind
    assert (
        not {
            "training.benchmark.report",
            "training.figures.statistics",
            "training.cli.app",
            "agents",
            "agents.random",
        }
        & behind
    )
    package = tmp_path / "an_agent_of_mine"
    package.mkdir()
    for name, text in (("__init__", ""), ("agent", "from .parts import x"), ("parts", "x = 1"), ("rest", "")):
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    bound = modules_behind("training.benchmark.episode", "training.truth.known_map").keys()
    assert "training.truth.known_map" in bound - behind and "training.truth.search" in bound - behind
    assert modules_behind("an_agent_of_mine.agent").keys() == {
        "an_agent_of_mine", "an_agent_of_mine.agent", "an_agent_of_mine.parts",
    }  # fmt: skip
    before = code_digest("an_agent_of_mine.agent")
    (package / "rest.py").write_text("y = 2")
    assert code_digest("an_agent_of_mine.agent") == before
    (package / "parts.py").write_text("x = 2")
    assert code_digest("an_agent_of_mine.agent") != before


def test_regret_is_over_the_least_time_in_the_same_room_whoever_had_it() -> None:
    agent = made_up_group("a", time_to_95_s=[40.0, 18.0, None, 50.0])
    known = made_up_group("known-map", time_to_95_s=[20.0, 20.0, 30.0, 40.0])
    ours, theirs = with_regrets([agent, known])
    assert [row.metrics["regret_95"] for row in ours.rows] == pytest.approx([1.0, 0.0, 9.0, 0.25])
    assert [row.metrics["regret_95"] for row in theirs.rows] == pytest.approx([0.0, 20.0 / 18.0 - 1.0, 0.0, 0.0])
    assert figures(ours)["regret_95"].averages.median.value == pytest.approx(0.625)
    # Without the planner that knows the map there is no bound: none of 99 % here, none at all there.
    assert np.isnan(figures(ours)["regret_99"].centre.value)
    assert np.isnan(figures(with_regrets([agent])[0])["regret_95"].centre.value)


def test_what_was_never_reached_counts_as_the_limit_and_loses() -> None:
    group = made_up_group(time_to_95_s=[40.0, 50.0, None, None], coverage=[1.0, 1.0, 0.9, 0.8])
    found = figures(group)
    assert found["time_to_95_s"].centre.value == pytest.approx((50 + 300) / 2)
    assert found["time_to_95_s"].averages.median.value == math.inf and found["time_to_95_s"].averages.n == 4
    assert found["reached_95"].centre.value == 0.5
    other = made_up_group("b", time_to_95_s=[45.0, 45.0, 290.0, None])
    against = comparisons(group, other)["time_to_95_s"]
    assert against.probability.value == pytest.approx((1 + 0 + 0 + 0.5) / 4) and against.n == 4


def test_what_is_not_defined_is_left_out_and_counted() -> None:
    found = figures(made_up_group(map_iou=[0.5, None, 0.7]))["map_iou"]
    assert found.averages.n == 2 and found.centre.value == pytest.approx(0.6)
    nothing = figures(made_up_group(map_iou=[None, None]))["map_iou"]
    assert nothing.averages.n == 0 and math.isnan(nothing.centre.value)
    pairs = comparisons(made_up_group(map_iou=[0.5, None, 0.7]), made_up_group("b", map_iou=[0.4, 0.4, None]))
    assert pairs["map_iou"].n == 1 and pairs["map_iou"].probability.value == 1.0


def test_collisions_are_all_contacts_over_all_the_way() -> None:
    found = figures(made_up_group(collisions=[0, 3, 0], path_length_m=[10.0, 20.0, 70.0]))
    assert found["collisions_per_100_m"].centre.value == pytest.approx(3.0)
    assert found["collided"].centre.value == pytest.approx(1 / 3)


def test_every_agent_gets_to_a_seed_before_any_gets_to_the_next() -> None:
    plan = benchmark.BenchmarkPlan.parse(suite="rooms,mazes", agents="random,nearest-frontier", slam="ekf")
    jobs = plan.jobs
    assert len(jobs) == len({job.key for job in jobs}) == 200
    assert [job.seed for job in jobs] == sorted(job.seed for job in jobs)
    assert plan.baseline == "nearest-frontier"


def test_a_row_is_what_an_episode_left(tmp_path: Path) -> None:
    """The store takes what an episode of each noise leaves, and gives it back."""
    make = partial(
        EpisodeJob, place="rectangular", rooms="rectangular", seed=3, agent="nearest-frontier", slam="ekf"
    )
    rows = {}
    with Store(tmp_path / FILE) as store:
        for name, noise in (("rooms", "nominal"), ("rooms-slippery", "slippery")):
            job = make(suite=name, noise=noise, max_steps=STEPS)
            row = run_job(job)
            assert isinstance(row, EpisodeRow), row
            store.add(job, row, made_by="x")
            ((_, back),) = store.rows([job.key])
            assert without_clock(back) == without_clock(row) and back.metrics == row.metrics
            rows[noise] = row
    row = rows["nominal"]
    assert row.metrics["limit_s"] == 2.5 and len(row.nees) == 2
    assert row.metrics["ate_aligned_rmse_m"] <= row.metrics["ate_rmse_m"]
    assert row.coverage_by_time[-1] == pytest.approx(row.metrics["coverage"])
    assert np.all(np.diff(row.coverage_by_path) > -0.01)
    picture = cv2.imdecode(np.frombuffer(row.thumbnail, np.uint8), cv2.IMREAD_COLOR)
    assert max(picture.shape) <= 220
    # The noise has reached the episode. (V knows what slips, which has brought the ratio from above 2 to 1.9.)
    assert rows["slippery"].metrics["ate_rmse_m"] > 1.5 * row.metrics["ate_rmse_m"]
