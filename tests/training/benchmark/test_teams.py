"""Teams in a benchmark: rows beside those of single robots, figures by the number of robots."""

from __future__ import annotations

import json
import math
import re
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mecanum_env.team.config import TeamConfig
from tests.training.benchmark.small import episode, made_up_group, without_clock
from tests.training.cli.test_bad_input import refused
from training.benchmark import team_episode
from training.benchmark.episode import CURVE_POINTS, EpisodeFailure, EpisodeJob, run_job
from training.benchmark.figures import Group, group_rows
from training.benchmark.output import Report, as_json, markdown, table
from training.benchmark.report import page
from training.benchmark.report_charts import COLOURS, scaling_charts, team_chart
from training.benchmark.run import BenchmarkPlan
from training.benchmark.store import FILE, Store
from training.benchmark.suites import teams_of
from training.benchmark.team_episode import TeamJob
from training.benchmark.team_figures import scaling_of, scaling_table
from training.cli import main
from training.episodes.team import prepare, run
from training.runs.errors import BadInput

NOTHING: dict[str, Any] = {"communication": None, "range_m": None, "starts": None, "unknown_starts": False}


def small(out: Path, *more: str) -> list[str]:
    return [
        "benchmark", "--suite", "rooms", "--agents", "nearest-frontier", "--seeds", "0:1", "--max-steps", "15",
        "--workers", "1", "--out", str(out), *more,
    ]  # fmt: skip


def job(robots: int = 2, **more: Any) -> TeamJob:
    about: dict[str, Any] = {"suite": "rooms", "place": "rectangular", "seed": 3, "agent": "nearest-frontier"}
    about |= {"slam": "invariant-ekf", "noise": "nominal", "rooms": "rectangular", "max_steps": 25}
    return TeamJob(team=TeamConfig(robots=robots), **(about | more))


def tables_in(path: Path) -> set[str]:
    with sqlite3.connect(path) as connection:
        return {name for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}


# ---- options and rows ------------------------------------------------------------------------------------------


def test_teams_of_options() -> None:
    assert teams_of("1", **NOTHING) == (None,)
    found = teams_of("3,1,2", **(NOTHING | {"communication": "range, none,range", "starts": "scattered"}))
    assert found[0] is None
    said = [(team.robots, team.communication.model, team.starts) for team in found if team is not None]
    assert said == [(n, how, "scattered") for n in (2, 3) for how in ("range", "none")]


def test_a_file_s_team_is_benchmarked_and_options_come_first(tmp_path: Path) -> None:
    file = tmp_path / "team.toml"
    file.write_text(
        '[run]\nagent = "random"\nseed = 7\n[run.team]\nrobots = 2\nstarts = "scattered"\nbelief = "joint"\n'
    )
    (found,) = teams_of(None, **NOTHING, config=file)
    assert found is not None and (found.robots, found.starts, found.belief) == (2, "scattered", "joint")
    one, three = teams_of("3,1", **(NOTHING | {"starts": "together"}), config=file)
    assert one is None
    assert three is not None and (three.robots, three.starts, three.belief) == (3, "together", "joint")
    assert teams_of("1", **NOTHING, config=file) == (None,) == teams_of(None, **NOTHING)
    plan = BenchmarkPlan.parse(suite="rooms", agents="tour", slam=None, seeds="3", config=file, teams=(found,))
    assert plan.backends == ("ekf-lines",), "that of a joint belief"
    assert [(job.agent, job.seed) for job in plan.jobs] == [("tour", 3)], "not the file's"
    with pytest.raises(BadInput, match="leave out --slam ekf"):
        BenchmarkPlan.parse(suite="rooms", agents="tour", slam="ekf", config=file, teams=(found,))
    file.write_text('[run.team]\nrobots = 2\ncommunication = { model = "none" }\n')
    told = [team.communication.model for team in teams_of(None, **NOTHING, config=file) if team is not None]
    assert told == ["none"]
    file.write_text("[run.team]\nrobot = 2\n")
    with pytest.raises(BadInput, match="robot"):
        teams_of(None, **NOTHING, config=file)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--robots", "1,x"], "--robots '1,x' must be whole numbers in 1 … 64"),
        (["--communication", "range"], "is for several robots"),
        (
            ["--robots", "1,2", "--agents", "tour,known-map"],
            "known-map is the fastest way of one robot",
        ),
        (["--robots", "1,2", "--communication", "range,fool"], "line-of-sight, walls, none, got 'fool'"),
        (["--protocol", "dungeons", "--maps", ".", "--robots", "2"], "--protocol dungeons has no --robots"),
    ],
)
def test_bad_input(argv: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert words in refused(["benchmark", "--out", str(tmp_path / "out"), *argv], capsys)
    assert not (tmp_path / "out").exists()


def test_a_row_has_what_a_single_robots_has() -> None:
    row = run_job(job())
    assert not isinstance(row, EpisodeFailure)
    again, alone = run_job(job()), run_job(EpisodeJob(**{
        name: getattr(job(), name) for name in EpisodeJob.__dataclass_fields__
    }))  # fmt: skip
    assert not isinstance(again, EpisodeFailure) and not isinstance(alone, EpisodeFailure)
    assert without_clock(row) == without_clock(again)
    # Which agent comes back is for `return_error_m`; all else is there.
    assert row.metrics.keys() >= alone.metrics.keys() - {"return_error_m"}
    assert json.loads(json.dumps(row.metrics)) == row.metrics
    assert len(row.coverage_by_time) == len(row.coverage_by_path) == CURVE_POINTS
    assert row.coverage_by_time[-1] == pytest.approx(row.metrics["coverage"])
    assert row.nees.shape == (2 * 2,) and np.isfinite(row.nees).all()  # two robots, two whole seconds
    assert row.thumbnail.startswith(b"\x89PNG")
    assert 0.5 <= row.metrics["first_share_max"] <= 1.0
    assert row.metrics["path_length_max_m"] <= row.metrics["path_length_m"]


def test_a_robot_that_ended_early_counts_in_the_ate_by_its_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    episode = prepare(TeamConfig(robots=2), out=Path("nowhere"), rooms="rectangular", seed=3, max_steps=20)
    run(episode, lambda **_: None)
    longer, shorter = (member.truth.record for member in episode.team.members)
    poses = {id(longer): np.zeros((21, 3)), id(shorter): np.zeros((11, 3))}
    monkeypatch.setattr(type(shorter), "estimates", property(lambda self: poses[id(self)]))
    monkeypatch.setattr(team_episode, "ate_aligned", lambda _, estimates: 0.0 if len(estimates) == 21 else 3.0)
    found = team_episode._metrics(episode)["ate_aligned_rmse_m"]
    assert found == pytest.approx(math.sqrt(9.0 * 11 / 32))


def test_an_error_in_an_episode_is_its_result() -> None:
    failure = run_job(job(robots=60))
    assert isinstance(failure, EpisodeFailure) and "has room for" in failure.message


def test_a_store_of_single_robots_stays_as_it_was(tmp_path: Path) -> None:
    alone, together = EpisodeJob(
        suite="rooms", place="rectangular", seed=1, agent="a", slam="ekf", noise="nominal"
    ), job(agent="a", slam="ekf", seed=1)  # fmt: skip
    with Store(tmp_path / FILE) as store:
        store.add(alone, episode(alone.key), made_by="x")
        assert tables_in(tmp_path / FILE) == {"episodes"}
        assert not list(store.rows([together.key]))
        store.add(together, episode(together.key, coverage=0.5), made_by="y")
        store.add(together, episode(together.key, coverage=0.6), made_by="z")  # theirs stays
    assert tables_in(tmp_path / FILE) == {"episodes", "team_episodes"}
    with Store(tmp_path / FILE) as store:
        assert store.made_by() == {alone.key: "x", together.key: "y"}
        found = list(store.rows([together.key, alone.key]))
    assert [key for key, _ in found] == [together.key, alone.key]
    assert [row.metrics["coverage"] for _, row in found] == [0.5, 0.99]
    first, second = group_rows(found)
    assert (first.robots, first.communication, second.robots) == (2, "unlimited", 1)


# ---- the command -----------------------------------------------------------------------------------------------


def test_teams_are_added_to_single_robots_and_the_command_goes_on(
    here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(small(out)) == 0
    single = (out / "episodes.csv").read_text("utf-8")
    assert ",robots," not in single.splitlines()[0] and "robots" not in capsys.readouterr().out
    more = ["--robots", "1,2", "--communication", "range,none", "--report", "--json"]
    assert main(small(out, *more)) == 0
    found = json.loads(capsys.readouterr().out)
    names = {"nearest-frontier", "nearest-frontier ×2 range", "nearest-frontier ×2 none"}
    assert found["rooms"].keys() == names
    assert [(row["name"], row["robots"]) for row in found["teams"]["rooms"]] == [
        (f"nearest-frontier, {how}", n) for how in ("range", "none") for n in (1, 2)
    ]
    rows = (out / "episodes.csv").read_text("utf-8").splitlines()
    assert rows[0].startswith("suite,place,seed,agent,slam,robots,communication") and len(rows) == 1 + 2 * 3
    # The single robots' rows are those that were there, not run again.
    assert rows[1].split(",")[7:] == single.splitlines()[1].split(",")[5:] + [""] * (
        len(rows[0].split(",")) - 2 - len(single.splitlines()[0].split(","))
    )
    assert "Several robots" in (out / "report.html").read_text("utf-8")
    assert (out / "teams.png").stat().st_size > 5000
    assert main(small(out, "--robots", "2", "--communication", "range", "--range", "3")) == 2
    assert "other code, configuration or plans" in capsys.readouterr().err


def test_the_team_of_a_file_explores(here: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "team.toml"
    file.write_text('[run]\nseed = 7\nmax_steps = 9999\n[run.team]\nrobots = 2\nbelief = "joint"\n')
    assert main(small(tmp_path / "out", "--config", str(file), "--json")) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rooms"].keys() == {"nearest-frontier ×2"}
    assert found["config"]["backends"] == ["ekf-lines"] and found["config"]["seeds"] == {"rooms": [0, 1]}
    assert [team["belief"] for team in found["config"]["teams"]] == ["joint"]
    assert found["rooms"]["nearest-frontier ×2"]["time_s"]["value"] <= 1.5


# ---- figures ---------------------------------------------------------------------------------------------------


def team_group(robots: int, times: list[float | None], *, contacts: int = 0, hears: str = "range") -> Group:
    """Return a made-up group, its paths 30 m long."""
    n = len(times)
    group = made_up_group("a", time_to_95_s=times, robot_collisions=[contacts] * n)
    keys = tuple((*key[:5], robots, hears) if robots > 1 else key for key in group.keys)
    rows = tuple(
        episode(key, time_to_95_s=t, robot_collisions=contacts, limit_s=300.0)
        for key, t in zip(keys, times, strict=True)
    )
    nees = np.repeat([1.0, 3.0, 5.0][:robots], 3).astype(np.float32)
    rows = tuple(replace(row, nees=nees) for row in rows)
    return group_rows(list(zip(keys, rows, strict=True)))[0]


def test_figures_by_the_number_of_robots() -> None:
    alone = team_group(1, [100.0, 120.0, 140.0, 160.0])
    three = team_group(3, [50.0, 60.0, 70.0, 80.0], contacts=6)
    (found,) = scaling_of([three, alone], suite="rooms")
    assert (found.name, found.robots, found.episodes) == ("a", (1, 3), (4, 4))
    assert found.time[0].value == pytest.approx(130.0) and found.time[1].value == pytest.approx(65.0)
    assert math.isnan(found.ratio[0].value) and math.isnan(found.touching[0].value)
    # In pairs: every episode takes half as long, whichever are drawn.
    assert found.ratio[1].value == pytest.approx(0.5)
    assert found.ratio[1].low == pytest.approx(0.5) and found.ratio[1].high == pytest.approx(0.5)
    assert found.touching[1].value == pytest.approx(20.0)
    (apart,) = scaling_of([team_group(3, [50.0] * 4)], suite="rooms")
    # Of two robots at a time: 3.7 such contacts, counted twice, in four times 30 m.
    assert apart.touching[0].value == 0.0 and apart.touching[0].high == pytest.approx(2 * 3.689 / 1.2, rel=1e-3)
    # Each robot is a run of its own.
    assert found.nees == (pytest.approx(1.0 / 3.0), pytest.approx(1.0))
    assert found.nees_each == (pytest.approx((1.0 / 3.0,)), pytest.approx((1.0 / 3.0, 1.0, 5.0 / 3.0)))
    assert three.consistency()["nees_band_95"][1] < alone.consistency()["nees_band_95"][1]
    assert scaling_of([alone], suite="rooms") == []
    unknown = replace(found, nees_each=((np.nan,), (1.0, np.nan, 1.25)))  # episodes of less than a second
    assert [cells[-1].text for _, cells in scaling_table([unknown]).rows] == ["–", "1.00, –, 1.25"]


def test_tables_and_page_show_them() -> None:
    groups = [team_group(n, [200.0 / n + k for k in range(4)]) for n in (1, 2, 3)]
    config = {"agents": ["a"], "split": "test"}
    report = Report.of(groups, baseline=None, config=config)
    assert [entry.name for entry in report.entries] == ["a", "a ×2", "a ×3"]
    for text in (table(report), markdown(report)):
        assert "a ×3" in text and "against one robot" in text
    shown = page(report, config_text="")
    assert shown.count("Several robots") == 1 and "times as fast as one robot" in shown
    ratio = as_json(report)["teams"]["rooms"][1]["ratio_to_one"]
    assert ratio["low"] <= ratio["value"] <= ratio["high"] < 0.6
    alone = Report.of(groups[:1], baseline=None, config=config)
    assert "teams" not in as_json(alone) and "Several robots" not in page(alone, config_text="")


def test_each_model_of_communication_has_charts_of_its_own() -> None:
    groups = [team_group(1, [200.0] * 4)]
    groups += [
        team_group(n, [200.0 / n + k for k in range(4)], hears=how) for how in ("none", "walls") for n in (2, 3)
    ]
    report = Report.of(groups, baseline=None, config={"agents": ["a"], "split": "test"})
    shown = page(report, config_text="")
    assert re.findall("Who hears whom: ([a-z]+)", shown) == ["none", "walls"]
    assert shown.count("<h4>") == 2 and "a, walls ×3" in shown


def test_a_picture_has_a_chart_for_each_suite_and_model() -> None:
    groups = [team_group(n, [200.0 / n] * 3 + [None if n == 3 else 60.0], hears="walls") for n in (1, 2, 3)]
    lines = scaling_of(groups, suite="rooms")
    suites = {"rooms": lines, "others": [replace(line, communication="none") for line in lines]}
    found = cv2.imdecode(np.frombuffer(team_chart(suites), np.uint8), cv2.IMREAD_COLOR)
    assert found.shape == (610, 540, 3) and found.std() > 10.0
    assert team_chart(suites) == team_chart(suites)
    # A policy's file may be called anything: this would be a formula, and none that can be set.
    assert team_chart({"rooms": [replace(line, agent="a$_$.safetensors") for line in lines]})


def test_charts_keep_many_lines_within_and_need_one_robot_for_gains() -> None:
    (line,) = scaling_of([team_group(n, [200.0 / n + k for k in range(4)]) for n in (2, 3)], suite="rooms")
    chart = scaling_charts([replace(line, agent=f"team {k}") for k in range(40)])
    assert chart.count("<svg") == 1 and "times as fast" not in chart
    dots = [float(x) for x in re.findall(r'<circle[^>]* cx="([^"]*)"', chart)]
    assert len(dots) == 80 and min(dots) > 44.0 and max(dots) < 468.0  # of the axes
    assert chart.count('dashed" d=') == 40 - COLOURS
