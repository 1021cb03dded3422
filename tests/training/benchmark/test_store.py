"""A benchmark's store from elsewhere: nothing in it runs, and rows that no table can be made of are refused."""

from __future__ import annotations

import json
import math
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from tests.training.benchmark.small import count, episode, small, without_clock
from training.benchmark import run as benchmark
from training.benchmark.episode import EpisodeJob
from training.benchmark.store import FILE, Store
from training.cli import main
from training.runs.errors import BadInput, Interrupted
from training.studies.reliability.files import results

JOB = EpisodeJob(suite="rooms", place="rectangular", seed=1, agent="a", slam="ekf", noise="nominal")


@pytest.fixture(scope="module")
def sound() -> bytes:
    return results.store()["results.sqlite"]


def stored(folder: Path, sound: bytes, script: str = "") -> Path:
    path = folder / "results.sqlite"
    path.write_bytes(sound)
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.executescript(script)
    return path


def keys(path: Path) -> list[Any]:
    with Store(path) as store:
        return [key for key, _ in store.rows(store.made_by())]


def refused(path: Path, words: str) -> None:
    with pytest.raises(BadInput, match=words) as caught:
        keys(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 700


def test_a_sound_one_is_read(tmp_path: Path, sound: bytes) -> None:
    assert len(keys(stored(tmp_path, sound))) == 3


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ("CREATE TRIGGER t AFTER INSERT ON episodes BEGIN DELETE FROM episodes; END", "holds the 'trigger' 't'"),
        ("CREATE VIEW team_episodes AS SELECT * FROM episodes", "holds the 'view'"),
        ("CREATE INDEX i ON episodes (length(metrics))", "holds the 'index'"),
        ("CREATE TABLE other (a)", "holds the 'table' 'other'"),
        ("ALTER TABLE episodes DROP COLUMN thumbnail", "thumbnail"),
        (
            "CREATE TABLE other (a); PRAGMA writable_schema = ON; "
            "UPDATE sqlite_schema SET sql = 'CREATE TABLE other (' || char(5) || ')' WHERE name = 'other'",
            "malformed|unrecognized",  # SQLite tells the character itself
        ),
        ("PRAGMA application_id = 1", "no store of a benchmark"),
        ("UPDATE episodes SET nees = x'010203'", "cannot use"),
        ("UPDATE episodes SET coverage_by_time = x''", "curve is empty"),
        ("UPDATE episodes SET metrics = printf('%.*c', 100000, '[')", "nested too deep"),
    ],
)
def test_what_its_writer_did_not_write_is_refused(script: str, words: str, tmp_path: Path, sound: bytes) -> None:
    refused(stored(tmp_path, sound, script), words)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("coverage", None), ("coverage", "x"), ("time_s", None), ("limit_s", -math.inf), ("collisions", True),
        ("anees", 1e308), ("anees", math.nan), ("end", 3), ("time_to_95_s", [1]), ("ate_rmse_m", 10**400),
    ],
)  # fmt: skip
def test_metrics_that_no_table_can_be_made_of_are_refused(
    name: str, value: Any, tmp_path: Path, sound: bytes
) -> None:
    text = json.dumps(results.metrics_of(1) | {name: value})
    refused(stored(tmp_path, sound, f"UPDATE episodes SET metrics = '{text}' WHERE seed = 1"), "cannot use")


@pytest.mark.parametrize(
    ("name", "value"), [("end", None), ("end", object()), ("end", "\udcff"), ("coverage", None), ("anees", "x")]
)
def test_a_row_that_could_not_be_read_again_is_not_written(name: str, value: Any, tmp_path: Path) -> None:
    with Store(tmp_path / FILE) as store:
        with pytest.raises(ValueError):
            store.add(JOB, episode(JOB.key, **{name: value}), made_by="x")
        assert store.made_by() == {}
        store.add(JOB, episode(JOB.key), made_by="x")
        assert len(list(store.rows([JOB.key]))) == 1


def test_two_runs_into_one_store_do_not_disturb_each_other(tmp_path: Path) -> None:
    with Store(tmp_path / FILE) as one, Store(tmp_path / FILE) as other:
        one.add(JOB, episode(JOB.key), made_by="x")
        other.add(JOB, episode(JOB.key, coverage=0.5), made_by="x")
        ((key, row),) = one.rows([JOB.key, ("rooms", "rectangular", 2, "a", "ekf")])
    assert key == JOB.key and without_clock(row) == without_clock(episode(key))


def test_what_is_beyond_all_bounds_is_null(tmp_path: Path) -> None:
    with Store(tmp_path / FILE) as store:
        store.add(JOB, episode(JOB.key, anees=1e20), made_by="x")
        ((_, row),) = store.rows([JOB.key])
    assert row.metrics["anees"] is None and row.metrics["coverage"] == 0.99


@pytest.mark.usefixtures("here")
def test_a_folder_without_an_episode_yet_takes_other_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise Interrupted("interrupted after 0 of 3 episodes")

    monkeypatch.setattr(benchmark, "run_all", interrupted)
    assert main(small(tmp_path)) == 130
    assert main(small(tmp_path, "--max-steps", "30")) == 130
    assert "0 of 3" in capsys.readouterr().err and count(tmp_path) == 0
    assert '"max_steps": 30' in (tmp_path / "settings.json").read_text("utf-8")
