"""The rows of a benchmark, in one SQLite file: one transaction a row, one row a job."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slam.files import check_tables, open_database, parse_json, plain_name, quoted, trust
from training.benchmark.episode import EpisodeJob, EpisodeRow, Key
from training.benchmark.figures import METRICS
from training.runs.errors import BadInput

__all__ = ["FILE", "Store"]

FILE = "results.sqlite"

_APPLICATION = 0x4D534C42  # "MSLB", in the file's header: this is a store of ours
_VERSION = 1
_SCHEMA = """
CREATE TABLE IF NOT EXISTS episodes (
    suite TEXT NOT NULL,
    place TEXT NOT NULL,              -- the generator of the rooms, or the plan's file name
    seed INTEGER NOT NULL,
    agent TEXT NOT NULL,
    slam TEXT NOT NULL,
    made_by TEXT NOT NULL,            -- digest of the code, configuration and plan behind the row
    metrics TEXT NOT NULL,            -- JSON: name -> number, word or null
    coverage_by_time BLOB NOT NULL,   -- little-endian float32, evenly spaced from 0 to time_s
    coverage_by_path BLOB NOT NULL,   -- the same, from 0 to path_length_m
    nees BLOB NOT NULL,               -- little-endian float32, one each simulated second
    thumbnail BLOB NOT NULL,          -- PNG: believed map and path
    PRIMARY KEY (suite, place, seed, agent, slam)
) STRICT
"""
# Rows of teams, in a table of their own: a store of single robots stays as it was.
_TEAM_SCHEMA = (
    _SCHEMA.replace("episodes (", "team_episodes (")
    .replace("    made_by", "    robots INTEGER NOT NULL,\n    communication TEXT NOT NULL,\n    made_by", 1)
    .replace("agent, slam)", "agent, slam, robots, communication)")
)
_TABLES = {5: "episodes", 7: "team_episodes"}  # by the length of their keys
_KEYS = {5: "suite, place, seed, agent, slam", 7: "suite, place, seed, agent, slam, robots, communication"}
_NEEDED = ("coverage", "time_s", "path_length_m", "collisions", "limit_s")  # never null
_LARGEST = 1e15  # of any metric
_TOLD = ("time_to_95_s", "ate_rmse_m", "final_position_error_m")  # null where not reached
_CURVES = ("coverage_by_time", "coverage_by_path", "nees")
_COLUMNS = ("metrics", *_CURVES, "thumbnail")  # what a row holds besides its key and what made it


class Store:
    """Rows by their key, in a file that is made where there is none. Whatever kills the process leaves whole rows.

    Raises
    ------
    BadInput
        For a file that is damaged, of another version, or no such store.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._blaming_the_file(), ExitStack() as opened:
            self._connection = opened.enter_context(open_database(path, mode="rwc"))
            self._check()
            trust(self._connection)
            self._opened = opened.pop_all()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def add(self, job: EpisodeJob, row: EpisodeRow, *, made_by: str) -> None:
        """Keep a row; where another process has kept it in the meantime, theirs stays, which is the same.

        Raises
        ------
        ValueError
            For a row that could not be read again; nothing is kept.
        """
        columns = _encode(row)
        _decode(columns)
        values = (*job.key, made_by, *columns.values())
        marks = ", ".join("?" * len(values))
        with self._blaming_the_file():
            if len(job.key) == 7:
                self._connection.execute(_TEAM_SCHEMA)
            self._connection.execute(f"INSERT OR IGNORE INTO {_TABLES[len(job.key)]} VALUES ({marks})", values)

    def made_by(self) -> dict[Key, str]:
        """Return what every row was made by."""
        found: dict[Key, str] = {}
        with self._blaming_the_file():
            for size in self._sizes():
                rows = self._connection.execute(f"SELECT {_KEYS[size]}, made_by FROM {_TABLES[size]}").fetchall()
                found |= {tuple(row[:-1]): row[-1] for row in rows}
        return found

    def rows(self, keys: Iterable[Key]) -> Iterator[tuple[Key, EpisodeRow]]:
        """Yield the rows of keys that there are, in the order of the keys."""
        with self._blaming_the_file():
            sizes = self._sizes()
        for key in keys:
            if (size := len(key)) not in sizes:
                continue
            marks = ", ".join("?" * size)
            query = f"SELECT {', '.join(_COLUMNS)} FROM {_TABLES[size]} WHERE ({_KEYS[size]}) = ({marks})"
            with self._blaming_the_file():
                found = self._connection.execute(query, key).fetchone()
                if found is not None:
                    row = _decode(dict(zip(_COLUMNS, found, strict=True)))
            if found is not None:
                yield key, row

    def _sizes(self) -> list[int]:
        """Return the lengths of keys for which there is a table."""
        found = self._connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall()
        return [size for size, table in _TABLES.items() if (table,) in found]

    def _check(self) -> None:
        application, version = (
            self._connection.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
        )
        if (application, version) == (0, 0) and not self._connection.execute(
            "SELECT count(*) FROM sqlite_schema"
        ).fetchone()[0]:
            # All or nothing: a run killed here leaves an empty file, which is made again.
            self._connection.executescript(
                f"BEGIN IMMEDIATE; {_SCHEMA}; PRAGMA application_id = {_APPLICATION}; "
                f"PRAGMA user_version = {_VERSION}; COMMIT;"
            )
            return
        if application != _APPLICATION:
            raise BadInput(f"{self._path} is no store of a benchmark; choose another --out")
        if version != _VERSION:
            raise BadInput(f"{self._path} is a store of version {version}, not {_VERSION}; choose another --out")
        # Nothing else: a trigger in it would run when rows are added.
        check_tables(self._connection, _TABLES.values(), alone=True)

    @contextmanager
    def _blaming_the_file(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, ValueError) as error:
            problem = plain_name(" ".join(str(error).split()), 300)
            raise BadInput(f"cannot use {self._path} ({problem}); choose another --out, or remove it") from error


def _encode(row: EpisodeRow) -> dict[str, Any]:
    # What is beyond all bounds, such as the NEES of a covariance next to zero, is null as infinity is.
    told = {k: None if isinstance(v, float) and abs(v) >= _LARGEST else v for k, v in row.metrics.items()}
    try:
        metrics = json.dumps(told, ensure_ascii=False, allow_nan=False)
        metrics.encode("utf-8")  # a lone surrogate has no bytes
    except TypeError as error:
        raise ValueError(f"a row's metrics are no JSON: {error}") from error
    curves = [np.asarray(getattr(row, name), "<f4").tobytes() for name in _CURVES]
    return dict(zip(_COLUMNS, (metrics, *curves, row.thumbnail), strict=True))


def _decode(columns: dict[str, Any]) -> EpisodeRow:
    curves = {name: np.frombuffer(columns[name], "<f4").astype(np.float32) for name in _CURVES}
    metrics = parse_json(columns["metrics"], what="a row's metrics")
    _check_metrics(metrics)
    if not curves["coverage_by_time"].size or not curves["coverage_by_path"].size:
        raise ValueError("a row's curve is empty")
    return EpisodeRow(metrics=metrics, thumbnail=columns["thumbnail"], **curves)


def _check_metrics(metrics: Any) -> None:
    """Raise ``ValueError`` for metrics that the tables cannot be made of."""
    if not isinstance(metrics, dict):
        raise ValueError("a row's metrics are no table of numbers and words")
    for key in (*_NEEDED, *_TOLD, *(metric.key for metric in METRICS if metric.of is None)):
        value = metrics.get(key)
        if (key in _TOLD and key not in metrics) or (key in _NEEDED and value is None):
            raise ValueError(f"a row's metrics lack {key}")
        if not (value is None or (type(value) in (int, float) and abs(value) < _LARGEST)):
            raise ValueError(f"a row's {key} is {quoted(value)}, which is no such number")
    if not isinstance(metrics.get("end"), str):
        raise ValueError("a row's metrics lack end, a word")
