"""Files of unknown origin: bounded in size, depth and time, and every fault in one line."""

from __future__ import annotations

import gzip
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.files import (
    check_tables,
    databases,
    open_database,
    parse_json,
    parse_toml,
    parse_yaml,
    plain_name,
    read_bytes,
)
from slam.landmarks.database import read_landmark_map, write_landmark_map
from slam.logs import open_log
from slam.logs.tables import read_lines

DEEP = 100_000


def refused(call: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        call()
    text = str(caught.value)
    assert type(caught.value) is ValueError and text.isprintable() and len(text) < 500, text[:200]


@pytest.mark.parametrize("text", [b"[" * DEEP, b'{"a":' * DEEP])
def test_json_of_any_depth_is_refused_in_one_line(text: bytes) -> None:
    refused(lambda: parse_json(text, what="rows"), "rows is damaged: JSON nested too deep")


@pytest.mark.parametrize("text", [b"", b"{", b"\xff", b"9" * 5000, b"NaN", b"[1e999]", b"[Infinity]", b'{"a" 1}'])
def test_what_is_no_json_is_refused(text: bytes) -> None:
    refused(lambda: parse_json(text, what="rows"), "rows is damaged: not JSON")
    assert parse_json(b'{"a": [1, 2.5]}', what="rows") == {"a": [1, 2.5]}
    assert str(parse_json(b"[NaN]", what="rows", nan=True)) == "[nan]"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"a = " + b"[" * DEEP, "TOML nested too deep"),
        (b".".join([b"a"] * DEEP) + b" = 1", "TOML nested too deep"),
        (b"[" + b".".join([b'"a"'] * DEEP) + b"]", "TOML nested too deep"),
        (b"a = \xff", "not TOML"),
        (b"a = " + b"9" * 5000, "not TOML"),
        (b"a = ", "not TOML"),
    ],
)
def test_what_is_no_toml_is_refused(text: bytes, words: str) -> None:
    refused(lambda: parse_toml(text, what="config"), words)


def test_toml_of_a_usual_depth_is_read() -> None:
    text = b"[a.b.c]\nx = [0.5, 1.5, " + b"0.25, " * 500 + b"]\n'odd key'.y = 1\n"
    assert parse_toml(text, what="config")["a"]["b"]["c"]["odd key"] == {"y": 1}
    assert parse_toml(b"\xef\xbb\xbfslam = 'ekf'\r\n", what="config") == {"slam": "ekf"}, "as Notepad saves it"


@pytest.mark.parametrize(
    "text",
    [
        b"a: &a [1]\nb: *a", b"a: &a [*a]", b"[" * 5000, b"- " * 5000, b"!!python/name:os.system", b"\0", b"? [a]",
        b"a: 'b", b"%YAML 9.9\n---\n", b"\xff\xfe",
    ],
)  # fmt: skip
def test_yaml_with_aliases_tags_or_depth_is_refused(text: bytes) -> None:
    refused(lambda: parse_yaml(text, what="map"), "map is damaged")


def test_nothing_but_regular_files_is_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "circle").symlink_to("circle")
    for name, words in (("pipe", "is not a file"), ("circle", "No such file"), ("none", "No such file")):
        refused(lambda name=name: read_bytes(tmp_path / name), words)  # type: ignore[misc]
    refused(lambda: read_bytes(Path("/dev/zero")), "is not a file")
    refused(lambda: read_bytes(tmp_path), "is not a file")
    refused(lambda: read_bytes(tmp_path / ("a" * 5000)), "cannot read")
    refused(lambda: read_bytes(tmp_path / "a\0b"), "cannot read")
    refused(lambda: read_bytes(Path(os.fsdecode(bytes(tmp_path) + b"/\xff"))), "no UTF-8; rename it")
    refused(lambda: list(read_lines(tmp_path / "pipe")), "is not a file")
    (tmp_path / "large").write_bytes(bytes(2000))
    refused(lambda: read_bytes(tmp_path / "large", limit=1999), "is larger than")
    assert len(read_bytes(tmp_path / "large", limit=2000)) == 2000


def test_a_packed_log_does_not_unpack_to_many_times_its_size(tmp_path: Path) -> None:
    piece = gzip.compress(b"FLASER 2 1 1 0 0 0 0 0 0 1 host 1\n" * 30_000)
    (tmp_path / "bomb.log").write_bytes(piece * 12)
    refused(lambda: sum(1 for _ in read_lines(tmp_path / "bomb.log")), "larger than any log's")
    # As many short lines are no less work.
    (tmp_path / "short.log").write_bytes(gzip.compress(b"1\n" * 400_000))
    refused(lambda: sum(1 for _ in read_lines(tmp_path / "short.log")), "larger than any log's")
    (tmp_path / "sound.log").write_bytes(gzip.compress(b"1\n" * 50_000))
    assert sum(1 for _ in read_lines(tmp_path / "sound.log")) == 50_000


def test_a_pipe_is_no_log(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "run.log")
    refused(lambda: open_log(tmp_path / "run.log"), "is not a file")


# ---- names -----------------------------------------------------------------------------------------------------


@given(st.text('ab é平\n\x00\x1b\u202e\u2028\udcff<&"\U0001f600'), st.integers(2, 40))
def test_a_name_that_is_shown_is_one_printable_line(text: str, longest: int) -> None:
    shown = plain_name(text, longest)
    assert shown.isprintable() and len(shown) <= longest
    if text.isprintable() and len(text) <= longest:
        assert shown == text


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("plan.png", "plan.png"), ("été 平面.png", "été 平面.png"), ("a\nb", "a\\nb"), ("\x1b[31m", "\\x1b[31m"),
        ("gnp.\u202egnp", "gnp.\\u202egnp"), (os.fsdecode(b"\xff"), "\\udcff"),
    ],
)  # fmt: skip
def test_marks_that_act_are_written_out(name: str, shown: str) -> None:
    assert plain_name(name) == shown


# ---- databases -------------------------------------------------------------------------------------------------


def database_of(path: Path, script: str) -> Path:
    if not path.exists():
        write_landmark_map(path, [[0.0, 0.0], [1.0, 2.0]], cov=[[[0.1, 0.0], [0.0, 0.1]]] * 2)
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.executescript("PRAGMA ignore_check_constraints = ON;" + script)
    return path


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"
COLUMNS = (
    "i AS id, 'convex' AS kind, 1 AS x, 1 AS y, 1 AS var_x, 1 AS var_y, 0 AS cov_xy, 0 AS angle, 1 AS times_seen"
)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (f"DROP TABLE landmarks; CREATE VIEW landmarks AS {ENDLESS} SELECT {COLUMNS} FROM n", "holds the 'view'"),
        (f"DROP TABLE meta; CREATE VIEW meta AS {ENDLESS} SELECT i AS key, i AS value FROM n", "holds the 'view'"),
        ("DROP TABLE sightings; CREATE TABLE sightings (landmark, robot AS (zeroblob(9)))", "is computed"),
        ("UPDATE landmarks SET kind = 'convexity'", "kind is none of"),
        ("UPDATE landmarks SET x = 9e999", "x is no finite number"),
        ("UPDATE landmarks SET var_x = 'nan'", "var_x is no finite number"),
        ("INSERT INTO relations VALUES (7, 9, 1, 1, 1)", "no landmark that a row names as its a"),
        ("UPDATE meta SET value = 'a' || char(10) WHERE key = 'schema_version'", "schema version"),
        ("UPDATE meta SET value = hex(zeroblob(99999)) WHERE key = 'schema_version'", "schema version"),
    ],
)
def test_nothing_in_a_landmark_map_is_run_or_believed(script: str, words: str, tmp_path: Path) -> None:
    path = database_of(tmp_path / "landmarks.db", script)
    refused(lambda: read_landmark_map(path), words)


def test_what_one_adds_to_a_landmark_map_is_no_matter(tmp_path: Path) -> None:
    path = database_of(
        tmp_path / "landmarks.db", "CREATE VIEW mine AS SELECT x FROM landmarks; CREATE TABLE a (b)"
    )
    assert len(read_landmark_map(path).landmarks) == 2


def test_a_pipe_or_device_is_no_database(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "landmarks.db")
    refused(lambda: read_landmark_map(tmp_path / "landmarks.db"), "is not a file")


def test_what_takes_too_long_in_a_database_is_broken_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = database_of(tmp_path / "landmarks.db", "")
    monkeypatch.setattr(databases, "_LONGEST_QUERY_S", 0.05)
    with open_database(path) as database, pytest.raises(sqlite3.OperationalError, match="interrupted"):
        database.execute(f"{ENDLESS} SELECT count(*) FROM n").fetchone()


def test_a_database_that_is_written_to_holds_nothing_else(tmp_path: Path) -> None:
    trigger = "CREATE TRIGGER t AFTER INSERT ON landmarks BEGIN DELETE FROM landmarks; END"
    path = database_of(tmp_path / "landmarks.db", trigger)
    names = ("meta", "landmarks", "relations", "sightings")
    with open_database(path) as database:
        check_tables(database, names)
        with pytest.raises(sqlite3.DatabaseError, match="trigger"):
            check_tables(database, names, alone=True)
