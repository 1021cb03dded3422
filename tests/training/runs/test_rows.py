"""Rows of long runs: whatever becomes of their file, they are what they would be without a break."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from training.runs.errors import BadInput
from training.runs.rows import resume

JOBS = tuple((name, seed) for name in ("a", "b") for seed in range(4))


def work(job: tuple[str, int]) -> dict[str, Any]:
    return {"value": 0.1 * job[1], "name": job[0], "far": math.inf}


def never(job: tuple[str, int]) -> dict[str, Any]:
    raise AssertionError(f"{job} is done again")


DONE = {job: work(job) for job in JOBS}


def test_rows_that_are_there_are_not_computed_again(tmp_path: Path) -> None:
    assert resume(tmp_path / "rows.jsonl", JOBS, work, workers=1) == DONE
    assert resume(tmp_path / "rows.jsonl", JOBS[::-1], never, workers=1) == DONE


@given(st.data())
def test_damaged_rows_are_computed_again(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = tmp_path_factory.mktemp("rows") / "rows.jsonl"
    resume(path, JOBS, work, workers=1)
    content = bytearray(path.read_bytes())
    for at in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=5)):
        content[at] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    assert resume(path, JOBS, work, workers=1) == DONE
    assert resume(path, JOBS, never, workers=1) == DONE


@pytest.mark.parametrize(
    "line",
    [
        b"[" * 100_000, b'{"a":' * 100_000, b"\xff\xfe", b"9" * 5000, b"[]", b"1", b'"ab"', b"[[[1], 0], {}]",
        b'[{"a": 1}, {}]', b'[["a", 0], {"value": 9}, 5]', b'[["a", 0], {}, 1, 2]', b'[["a", false], {}]',
        b'[["a", 0.0], {}]',
    ],
)  # fmt: skip
def test_lines_of_something_else_are_passed_over(line: bytes, tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    path.write_bytes(line + b"\n")
    assert resume(path, JOBS, work, workers=1) == DONE


def test_a_row_without_a_checksum_is_computed_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps([["a", 0], {"value": 9}]) + "\n")  # as damage may leave it
    assert resume(path, JOBS, work, workers=1) == DONE


def test_a_pipe_holds_no_rows(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "rows.jsonl")
    with pytest.raises(BadInput, match="is not a file"):
        resume(tmp_path / "rows.jsonl", JOBS, work, workers=1)
