"""Progress: a line at once and every half a minute, with what is left; on a terminal a bar."""

from __future__ import annotations

import sys

import pytest

from training.runs import progress
from training.runs.progress import Progress


def shown(monkeypatch: pytest.MonkeyPatch, *, eta: bool) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])  # type: ignore[attr-defined]
    with Progress("replaying", 100.0, eta=eta) as shown:
        for now[0], done in ((0.0, 0.0), (10.0, 40.0), (30.0, 75.0), (31.0, 80.0), (600.0, 80.0)):
            shown.show(done, f"{done:.0f} of 100 s")


def test_lines_are_few_and_say_what_is_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown(monkeypatch, eta=True)
    assert capsys.readouterr().err.splitlines() == [
        "replaying: 0 of 100 s",
        "replaying: 75 of 100 s, about 10 s left",
        "replaying: 80 of 100 s, about 2 min left",
    ]
    shown(monkeypatch, eta=False)
    assert "left" not in capsys.readouterr().err


def test_nobody_says_what_is_left_before_it_can_be_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now, compiled = [0.0], [3.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])  # type: ignore[attr-defined]
    monkeypatch.setattr(progress, "compiled_s", lambda: compiled[0])
    with Progress("replaying", 100.0) as shown:
        for now[0], compiled[0], done in ((60.0, 62.0, 0.1), (90.0, 73.0, 50.0)):
            shown.show(done, f"{done:.0f} of 100 s")
    assert capsys.readouterr().err.splitlines() == [
        "replaying: 0 of 100 s",
        "replaying: 50 of 100 s, about 20 s left",  # 70 of the 90 s were compiling
    ]


def test_a_terminal_gets_a_bar(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    shown(monkeypatch, eta=True)
    said = capsys.readouterr().err
    assert "\x1b[" in said and "80 of 100 s" in said
