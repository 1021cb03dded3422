"""Digests of the code behind a result."""

from __future__ import annotations

from pathlib import Path

import pytest

from training.runs.provenance import code_digest, modules_behind


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
