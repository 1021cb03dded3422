"""The part ``kills`` in short, and that it tells lost, doubled and damaged results from sound ones."""

from __future__ import annotations

import json
import signal
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import pytest

from training.studies.reliability.kills import killing
from training.studies.reliability.kills.alone import argv_of
from training.studies.reliability.kills.commands import COMMANDS, installed
from training.studies.reliability.kills.killing import Moment, Run, run
from training.studies.reliability.kills.part import KILLS, _judged
from training.studies.reliability.kills.results import damaged, differences, kept, results


def test_an_episode_that_is_killed_and_run_again_is_that_of_one_left_alone() -> None:
    row = KILLS.work(("explore", 4, 0, 1))
    assert row["wrong"] == [] and len(row["codes"]) <= 1
    found = KILLS.sum_up(
        {("explore", 4, 0, 1): row | {"kills": 2, "codes": [-9, 143], "wrong": ["2 rows are gone"]}}
    )
    assert found["tried"] == 2 and found["failures"] == ["explore 4 0 1: 2 rows are gone"]
    assert found["commands"]["explore"]["codes"] == {"-9": 1, "143": 1} and "benchmark" in found["not_run"]


def test_so_many_kills_over_all_commands() -> None:
    jobs = KILLS.jobs(30, 1)
    assert sum(job[-1] for job in jobs) == 30 and {job[0] for job in jobs} == set(installed()) <= set(COMMANDS)


def ended(code: int, error: str = "", left: tuple[str, ...] = ()) -> Run:
    return Run(code=code, killed=code != 0, seconds=1.0, changes=3, error=error, left=left)


def test_how_a_killed_run_ends_is_judged() -> None:
    term, hard = Moment(signal=signal.SIGTERM, after_s=1.0), Moment(signal=signal.SIGKILL, changes=1)
    for done, moment in (
        (ended(143), term),
        (ended(-15), term),
        (ended(-9), hard),
        (ended(0), None),
        (ended(-9, left=("ray::Agent",)), hard),
    ):
        assert _judged(done, moment) == []
    for done, moment in (
        (ended(1), term), (ended(143, "Traceback (most recent call last):"), term), (ended(-9, left=("x",)), hard),
        (ended(2), None), (ended(-15), hard),
    ):  # fmt: skip
        assert len(_judged(done, moment)) == 1


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    (tmp_path / "metrics.json").write_text('{"coverage": 0.5, "wall_time_s": 3.1}')
    (tmp_path / "episodes.csv").write_text("seed,coverage,decision_ms_median\n1,0.5,3.25\n2,0.6,4.5\n")
    (tmp_path / "episodes.jsonl").write_text('[[1], {"a": 1}, 5]\n[[2], {"a": 2}, 6]\n')
    with sqlite3.connect(tmp_path / "results.sqlite") as database:
        database.execute("CREATE TABLE episodes (seed, metrics)")
        database.executemany("INSERT INTO episodes VALUES (?, ?)", [(1, '{"x": 1, "wall_time_s": 2}'), (2, "{}")])
    database.close()
    yield tmp_path


def test_results_are_compared_without_what_the_clock_said(folder: Path) -> None:
    whole = results(folder)
    (folder / "metrics.json").write_text('{"coverage": 0.5, "wall_time_s": 99.0}')
    text = (folder / "episodes.csv").read_text()
    (folder / "episodes.csv").write_text(text.replace("3.25", "7.5"))
    assert differences(results(folder), whole) == []
    (folder / "episodes.csv").write_text(text.replace("0.6", "0.7"))
    assert differences(results(folder), whole) == ["/episodes.csv[1]/coverage: 0.7 is not 0.6"]


def test_what_is_doubled_or_gone_is_seen(folder: Path) -> None:
    whole, rows = results(folder), kept(folder)
    assert len(rows) == 4
    lines = folder / "episodes.jsonl"
    lines.write_text(lines.read_text() + "[[3], {")  # cut off: to be done again
    assert differences(results(folder), whole) == [] and kept(folder) == rows
    lines.write_text('[[1], {"a": 1}, 5]\n[[1], {"a": 1}, 5]\n[[2], {"a": 2}, 6]\n')
    assert differences(results(folder), whole)
    lines.write_text('[[2], {"a": 2}, 6]\n')
    assert len(rows - kept(folder)) == 1
    (folder / "metrics.json").unlink()
    assert any("metrics.json" in line and "absent" in line for line in differences(results(folder), whole))


def test_a_training_run_that_was_begun_anew_is_seen(tmp_path: Path) -> None:
    progress = tmp_path / "progress.json"
    progress.write_text('{"steps": 3, "identity": "a"}')
    whole, names = results(tmp_path), kept(tmp_path)
    progress.write_text('{"steps": 3, "identity": "b"}')
    assert differences(results(tmp_path), whole) == [] and names - kept(tmp_path) == {"a"}


def test_half_a_file_is_seen(folder: Path) -> None:
    assert damaged(folder) == []
    (folder / "metrics.json").write_text(json.dumps({"coverage": 0.5})[:-3])
    (folder / "map.pgm").write_bytes(b"")
    store = folder / "results.sqlite"
    store.write_bytes(store.read_bytes()[:5000])
    assert [line.split(":")[0] for line in damaged(folder)] == ["map.pgm", "metrics.json", "results.sqlite"]


def test_a_run_is_killed_when_its_folder_changes_and_nothing_of_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = tmp_path / "training" / "cli" / "__main__.py"
    module.parent.mkdir(parents=True)
    module.write_text(
        "import pathlib, subprocess, sys, time\n"
        "out = pathlib.Path(sys.argv[1])\nout.mkdir()\n"
        "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(100)'])\n"
        "for k in range(100):\n    (out / str(k)).touch()\n    time.sleep(0.05)\n"
    )
    (module.parent / "__init__.py").touch()
    (module.parents[1] / "__init__.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(killing, "_LEAVE_S", 0.2)
    done = run([str(tmp_path / "out")], tmp_path / "out", Moment(signal=signal.SIGKILL, changes=3))
    assert done.code == -9 and done.killed and len(list((tmp_path / "out").iterdir())) < 50
    assert len(done.left) == 1 and "time.sleep" in done.left[0]


def test_a_command_is_told_to_go_on_only_where_there_is_something_to_go_on_with(tmp_path: Path) -> None:
    assert "--resume" not in argv_of("train", tmp_path)
    (tmp_path / "progress.json").touch()
    assert "--resume" in argv_of("train", tmp_path)
