"""The part ``places`` in short, and that it finds what is refused badly."""

from __future__ import annotations

from pathlib import Path

import pytest

from training.studies.reliability.places import commands, processes
from training.studies.reliability.places.part import PLACES


@pytest.fixture
def one_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "_COMMANDS", {"explore": "metrics.json"})


@pytest.mark.parametrize("name", ["in the way", "small files"])
def test_a_command_that_cannot_write_is_refused_in_a_line(name: str, one_command: None) -> None:
    assert PLACES.work((name, 1))["wrong"] == []


def test_environments_after_a_fork() -> None:
    assert PLACES.work(("after a fork", 3))["wrong"] == []


def test_many_environments_in_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_MANY", 6)
    assert PLACES.work(("many in one", 3))["wrong"] == []


def test_what_is_refused_badly_is_found() -> None:
    good = "episodes: 0/6\nmecanum explore: cannot write here"
    assert commands._judged("x", (2, good)) == [] == commands._judged("x", (1, good))
    assert len(commands._judged("x", (0, good))) == 1
    assert len(commands._judged("x", (2, "Traceback (most recent call last):\n"))) == 1
    assert len(commands._judged("x", (-11, ""))) == 2


def test_a_place_that_cannot_be_made_is_skipped_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, one_command: None, tmp_path: Path
) -> None:
    monkeypatch.setattr(commands.shutil, "which", lambda name: None)
    row = PLACES.work(("read-only", 0))
    assert row["wrong"] == [] and "unshare" in row["skipped"]
    found = PLACES.sum_up({("read-only", 0): row, ("two at once", 0): {"wrong": ["x"], "seconds": 1.0}})
    assert found["tried"] == 1 and found["failures"] == ["two at once (seed 0): x"]
    assert [line[3] for line in PLACES.table(found)[1]] == [row["skipped"], ""]
