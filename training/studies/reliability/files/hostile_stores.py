"""Databases and rows that are made to do harm: views without end, triggers, foreign schemas, corrupt pages."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Callable
from contextlib import closing
from typing import Any

from training.studies.reliability.files import results, samples
from training.studies.reliability.files.samples import Files, Hostile, Link, Pipe, Sound, one

__all__ = ["LANDMARKS", "ROWS", "RUN_FILES", "STORES"]

_ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


def _sql(name: str, sound: Callable[[], Sound], script: str) -> Callable[[], Files]:
    """Return a database on which a script was run."""

    def made() -> Files:
        with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
            database.deserialize(sound()[name])
            database.executescript("PRAGMA ignore_check_constraints = ON; PRAGMA writable_schema = OFF;" + script)
            return {name: database.serialize()}

    return made


def _bytes(name: str, sound: Callable[[], Sound], change: Callable[[bytes], bytes]) -> Callable[[], Files]:
    return lambda: {name: change(sound()[name])}


def _empty(script: str) -> bytes:
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        database.executescript(script)
        return database.serialize()


def _put(data: bytes, at: int, what: bytes) -> bytes:
    return data[:at] + what + data[at + len(what) :]


def _any(name: str, sound: Callable[[], Sound]) -> dict[str, Callable[[], Files]]:
    """Return what harms any reader of a database."""
    return {
        "empty": lambda: {name: b""},
        "a database of something else": lambda: {name: _empty("CREATE TABLE a (b); INSERT INTO a VALUES (1)")},
        "a database of nothing": lambda: {name: _empty("PRAGMA user_version = 7")},
        "a header and no more": _bytes(name, sound, lambda data: data[:100]),
        "cut in a page": _bytes(name, sound, lambda data: data[:5000]),
        "pages that are zero": _bytes(name, sound, lambda data: data[:4096] + bytes(len(data) - 4096)),
        "pages that are ones": _bytes(name, sound, lambda data: data[:4096] + b"\xff" * (len(data) - 4096)),
        "its first page is ones": _bytes(name, sound, lambda data: data[:100] + b"\xff" * 3996 + data[4096:]),
        "a page count of 2³²": _bytes(name, sound, lambda data: _put(data, 28, b"\xff" * 4)),
        "a page size of 3": _bytes(name, sound, lambda data: _put(data, 16, b"\0\3")),
        "a write-ahead log that is not there": _bytes(name, sound, lambda data: _put(data, 18, b"\2\2")),
        "a format of the future": _bytes(name, sound, lambda data: _put(data, 18, b"\7\7")),
        "text in UTF-16": lambda: {name: _empty("PRAGMA encoding = 'UTF-16'; CREATE TABLE a (b)")},
        "a hot journal beside it": lambda: {f"{name}-journal": bytes.fromhex("d9d505f920a163d7") + b"\xff" * 504},
        "a write-ahead log beside it": lambda: {f"{name}-wal": b"\x37\x7f\x06\x82" + b"\xff" * 500},
        "a pipe": lambda: {name: Pipe()},
        "a folder": lambda: {"other.sqlite/": b""},
        "a link to itself": lambda: {name: Link(name)},
        "an endless device": lambda: {name: Link("/dev/zero")},
        "a schema that does not parse": _sql(
            name, sound, "CREATE TABLE more (a); PRAGMA writable_schema = ON; "
            "UPDATE sqlite_schema SET sql = 'CREATE TABLE (((' WHERE name = 'more'",
        ),
        "a schema of 10 MB": _sql(
            name, sound, f"CREATE TABLE more (a); PRAGMA writable_schema = ON; "
            f"UPDATE sqlite_schema SET sql = 'CREATE TABLE more (a, {'b' * 10_000_000})' WHERE name = 'more'",
        ),
        "a thousand tables": _sql(name, sound, "".join(f"CREATE TABLE t{k} (a);" for k in range(1000))),
        "a virtual table": _sql(name, sound, "CREATE VIRTUAL TABLE words USING fts5 (a)"),
    }  # fmt: skip


def _view(table: str, columns: str) -> str:
    return f"DROP TABLE {table}; CREATE VIEW {table} AS {_ENDLESS} SELECT {columns} FROM n"


_LANDMARK = (
    "i AS id, 'convex' AS kind, 1.0 AS x, 1.0 AS y, 1.0 AS var_x, 1.0 AS var_y, 0.0 AS cov_xy, 0.0 AS angle, "
    "1 AS times_seen"
)


def _landmark(script: str) -> Callable[[], Files]:
    return _sql("landmarks.db", samples.landmarks, script)


LANDMARKS: Hostile = {
    **_any("landmarks.db", samples.landmarks),
    "a view without end": _landmark(_view("landmarks", _LANDMARK)),
    "a view without end for what it says": _landmark(_view("meta", "'schema_version' AS key, '2' AS value")),
    "a view of sightings without end": _landmark(_view("sightings", "i AS landmark, i AS robot")),
    "a view that asks for memory": _landmark(
        "DROP TABLE meta; CREATE VIEW meta AS SELECT 'schema_version' AS key, hex(zeroblob(900000000)) AS value"
    ),
    "a column that is computed": _landmark(
        "DROP TABLE sightings; CREATE TABLE sightings (landmark INTEGER, robot AS (zeroblob(1000000)))"
    ),
    "triggers on all": _landmark("".join(
        f"CREATE TRIGGER {t}_{w} BEFORE {w} ON {t} BEGIN SELECT RAISE(ABORT, 'x'); END;"
        for t in ("landmarks", "relations") for w in ("INSERT", "UPDATE", "DELETE")
    )),
    **{f"{column} = {value[:30]}": _landmark(f"UPDATE landmarks SET {column} = {value} WHERE id = 3")
       for column in ("x", "var_x", "angle", "times_seen", "kind")
       for value in ("'text'", "9e999", "1e308", "-1", "x'00ff'", "9223372036854775807", "zeroblob(5000000)",
                     "''")},
    "a relation of none": _landmark("INSERT INTO relations VALUES (100, 200, 1, 1, 1)"),
    "ids below 0": _landmark("UPDATE landmarks SET id = -id"),
    "a version of the future": _landmark("UPDATE meta SET value = '99' WHERE key = 'schema_version'"),
    "a version that is long": _landmark(
        "UPDATE meta SET value = hex(zeroblob(1000000)) WHERE key = 'schema_version'"
    ),
    "no version": _landmark("DELETE FROM meta"),
    "a frame of bytes": _landmark("UPDATE meta SET value = x'ff00' WHERE key = 'frame'"),
    "a key of numbers": _landmark("INSERT INTO meta VALUES (1, 2)"),
    "a name with a line break": _landmark(
        "UPDATE meta SET value = 'a' || char(10) || 'b' WHERE key = 'schema_version'"
    ),
}  # fmt: skip


def _store(script: str) -> Callable[[], Files]:
    return _sql("results.sqlite", results.store, script)


def _metrics(text: str) -> Callable[[], Files]:
    quoted = text.replace("'", "''")
    return _store(f"UPDATE episodes SET metrics = '{quoted}' WHERE seed = 1")


_KEPT = "suite, place, seed, agent, slam, made_by, metrics, coverage_by_time, coverage_by_path, nees, thumbnail"

_VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1.5, "x", [1], {}, 10**400, 1e308, -1e308, math.inf, math.nan, "\n|<b>",
)  # fmt: skip

STORES: Hostile = {
    **_any("results.sqlite", results.store),
    "a trigger that takes rows away": _store(
        "DELETE FROM episodes WHERE seed = 1; CREATE TRIGGER t AFTER INSERT ON episodes "
        "BEGIN DELETE FROM episodes; END"
    ),
    "a trigger that never ends": _store(
        "DELETE FROM episodes WHERE seed = 1; CREATE TRIGGER t AFTER INSERT ON episodes BEGIN "
        "UPDATE episodes SET seed = seed WHERE (WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
        "SELECT count(*) FROM n); END"
    ),
    "a view in the place of the rows": _store(
        f"ALTER TABLE episodes RENAME TO e; CREATE VIEW episodes AS {_ENDLESS} SELECT {_KEPT} FROM e, n"
    ),
    "a view of teams without end": _store(
        f"CREATE VIEW team_episodes AS {_ENDLESS} SELECT {_KEPT}, i AS robots, 'x' AS communication "
        "FROM episodes, n"
    ),
    "an index that computes": _store("CREATE INDEX i ON episodes (length(hex(metrics)))"),
    "a row more than there should be": _store(
        "INSERT INTO episodes SELECT 'x', 'y', 3, 'z', 'w', 'v', '{}', x'', x'', x'', x''"
    ),
    "another table of teams": _store("CREATE TABLE team_episodes (a)"),
    "a column less": _store("ALTER TABLE episodes DROP COLUMN thumbnail"),
    "another application": _store("PRAGMA application_id = 1"),
    "a version of the future": _store("PRAGMA user_version = 9"),
    "curves of 3 bytes": _store("UPDATE episodes SET nees = x'010203' WHERE seed = 1"),
    "curves of nothing": _store(
        "UPDATE episodes SET coverage_by_time = x'', coverage_by_path = x'' WHERE seed = 1"
    ),
    "curves of nan": _store(
        "UPDATE episodes SET coverage_by_time = x'0000c07f', nees = x'0000c07f' WHERE seed = 1"
    ),
    "curves of 100 MB": _store("UPDATE episodes SET nees = zeroblob(100000000) WHERE seed = 1"),
    "metrics of 50 MB": _store(
        "UPDATE episodes SET metrics = '\"' || hex(zeroblob(25000000)) || '\"' WHERE seed = 1"
    ),
    "another digest": _store("UPDATE episodes SET made_by = 'x' WHERE seed = 1"),
    **{f"metrics {text[:40]}": _metrics(text) for text in (
        "", "{}", "[]", "null", "1", '{"coverage": NaN}', "[" * 100_000, '{"a":' * 100_000, "9" * 5000,
    )},
    **{f"{' and '.join(names)} of {str(value)[:20]}":
       _metrics(json.dumps(results.metrics_of(1) | dict.fromkeys(names, value)))
       for names in (("coverage",), ("time_s", "path_length_m", "limit_s"), ("collisions",), ("end",), ("anees",))
       for value in _VALUES},
}  # fmt: skip


# ---- rows, settings, summaries ---------------------------------------------------------------------------------


def _rows(text: bytes) -> Callable[[], Files]:
    return lambda: {"rows.jsonl": text + b"\n" + results.rows()["rows.jsonl"]}


ROWS: Hostile = {
    "empty": lambda: {"rows.jsonl": b""},
    "a pipe": lambda: {"rows.jsonl": Pipe()},
    "a link to itself": lambda: {"rows.jsonl": Link("rows.jsonl")},
    "an endless device": lambda: {"rows.jsonl": Link("/dev/zero")},
    "a line of 100 MB": lambda: {"rows.jsonl": b'[["a", 0], "' + b"x" * 100_000_000 + b'"]'},
    **{repr(text[:40]): _rows(text) for text in (
        b"\xff\xfe", b"\0" * 1000, b"[" * 100_000, b'{"a":' * 100_000, b"9" * 5000, b"null", b"1", b'"ab"', b"[]",
        b"[1, 2]", b'[["a", 0], 5]', b'[["a", 0], null]', b'[["a", 0], {"value": 7}]', b'[[["a"], 0], {}]',
        b'[{"a": 1}, {}]', b'[["a", 0], {"value": NaN, "name": "a", "list": [1]}]', b'[["a", 0.0], {"value": 9}]',
        b'[["a", true], {"value": 9}]', b'[["a", false], {"value": 9}]', b'["a0", {"value": 9}]',
        b'[["a", 0], {"value": 0.0, "name": "a", "list": [1, 2, 3]}, 1]', b'[["a", 0], {}, 3, 4]',
    )},
}  # fmt: skip


_CONTENTS: dict[str, bytes | Pipe | Link] = {
    "empty": b"", "deep": b"[" * 100_000, "deep mappings": b'{"a":' * 100_000, "digits": b"9" * 5000,
    "a list": b"[]", "null": b"null", "a number": b"1", "no text": b"\xff", "a pipe": Pipe(),
    "100 MB": b'"' + b"a" * 10**8 + b'"', "an endless device": Link("/dev/zero"), "mappings": b'{"a": {"b": 1}}',
    "a suite that is a number": b'{"a": 1, "config": {}}',
}  # fmt: skip

RUN_FILES: Hostile = {
    f"{name}: {what}": one(name, data)
    for name in ("settings.json", "summary.json", "page.md")
    for what, data in (_CONTENTS | {"a link to itself": Link(name)}).items()
}
