"""Agents of other people on the command line: they end in their own words, print, exit, or cannot be made."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import agents
from agents.base import Agent, Goal
from slam.belief import Belief
from slam.types import Floats
from tests.training.cli.test_bad_input import refused
from training.cli import main
from training.play.session import Session


class Own(Agent):
    """Stands, says so, and has had enough at once."""

    _goal_once = Goal(pose=np.zeros(3), path=[(0.0, 0.0), (1.0, 0.0)])  # type: ignore[arg-type]

    @property
    def status(self) -> str:
        return "done"

    @property
    def ended(self) -> bool:
        return True

    def choose(self, belief: Belief) -> Goal | None:
        return None

    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        print("a word of the agent")
        self._goal = self._goal_once if self._goal is None else None
        return np.zeros(3, np.float32)


class Leaves(Own):
    def act(self, observation: Mapping[str, Any] | None, belief: Belief) -> Floats:
        sys.exit()


class Unfinished(Agent):
    pass


class Plain:
    def __init__(self) -> None:
        pass


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    here = {name.lower(): f"{__name__}:{name}" for name in ("Own", "Leaves", "Unfinished", "Plain", "Missing")}
    monkeypatch.setattr(agents, "_installed", lambda: here | {"nowhere": "no_such_module:X"})


def explore(agent: str, out: Path, *more: str) -> int:
    argv = ["explore", "--agent", agent, "--rooms", "rectangular", "--slam", "odometry", "--out", str(out)]
    return main([*argv, "--max-steps", "30", *more])


def test_an_ending_of_its_own_is_told_and_json_stands_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Own, "_goal_once", None)
    assert explore("own", tmp_path, "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["end"] == "done" and "a word of the agent" in printed.err
    assert "done: a word of the agent&#x27;s own" in (tmp_path / "report.html").read_text("utf-8")
    assert explore("own", tmp_path / "team", "--robots", "2") == 0
    assert "done (a word of the agent's own)" in capsys.readouterr().out
    session = Session(agent="own", rooms="rectangular", slam="odometry")
    session.agent = session._make_agent(session.env, 0)
    assert session.driver_note == "done: a word of the agent's own"


def test_a_path_may_be_any_sequence(tmp_path: Path) -> None:
    assert explore("own", tmp_path) == 0


def test_an_agent_that_exits_is_no_success(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert explore("leaves", tmp_path) == 1
    assert "sys.exit() was called amid the work" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["unfinished", "plain", "missing", "nowhere"])
def test_an_agent_that_cannot_be_made(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["explore", "--agent", name, "--out", str(tmp_path / "out")], capsys)
    assert f"cannot load agent {name} (" in line and "leave it out" in line
    with pytest.raises(ValueError, match=f"cannot load agent {name}"):
        agents.make(name)
