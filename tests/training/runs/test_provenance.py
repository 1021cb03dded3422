"""Digests of the code behind a result."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

import agents
import slam
from agents.random import RandomAgent
from slam.dead_reckoning import OdometrySlam
from slam.gaussian.settings import EkfConfig
from training.runs import provenance
from training.runs.errors import BadInput
from training.runs.provenance import (
    behind_agent,
    code_digest,
    modules_behind,
    modules_of_backend,
    own_code,
)


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


def test_what_lies_beside_an_own_agent_counts_unless_another_distribution_brought_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "space_of_mine").mkdir()  # without __init__.py
    (tmp_path / "space_of_mine" / "walk.py").write_text("import json, helper_of_mine, theirs_beside, slam.ekf")
    (tmp_path / "helper_of_mine.py").write_text("v = 1")
    (tmp_path / "theirs_beside.py").write_text("v = 1")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(provenance, "_distributions", lambda: {"theirs_beside": ["theirs"]})
    behind = modules_behind("space_of_mine.walk").keys()
    assert {"space_of_mine.walk", "helper_of_mine", "slam.ekf"} <= behind
    assert not {"json", "theirs_beside"} & behind


def test_an_own_agent_is_told_by_its_entry_point_the_modules_it_comes_from_and_its_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    factory, policy = tmp_path / "factory_of_mine.py", tmp_path / "weights.npy"
    factory.write_text(
        "from agents.random import RandomAgent\ndef one(c, **k): return RandomAgent(c, **k)\ntwo = one"
    )
    monkeypatch.syspath_prepend(tmp_path)

    def digest(entry: str) -> dict[str, str]:
        monkeypatch.setattr(agents, "_installed", lambda: {"mine": entry, "random": "agents.random:RandomAgent"})
        return own_code(["mine", "random"], [])

    first = digest("factory_of_mine:one")
    assert first.keys() == {"agent mine"} and first != digest("factory_of_mine:two")
    assert behind_agent("mine")[0] == ("factory_of_mine", "agents.random")
    factory.write_text(factory.read_text() + "\n# edited")
    assert digest("factory_of_mine:one") != first
    monkeypatch.setattr(RandomAgent, "policy_path", str(policy), raising=False)
    with pytest.raises(BadInput, match=r"no such file: .*weights.npy"):
        behind_agent("mine")
    policy.write_bytes(b"1")
    one = own_code(["mine"], [])
    policy.write_bytes(b"2")
    assert own_code(["mine"], []) != one
    policy.with_suffix(".json").write_text("{}")  # described beside it
    assert own_code(["mine"], []) != one


def forget() -> None:
    provenance._found.cache_clear()
    provenance._file.cache_clear()


def test_a_backend_of_the_running_script_is_known_by_the_script_or_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Config(EkfConfig):
        pass

    class Own(OdometrySlam):
        pass

    Own.__module__ = Config.__module__ = "__main__"
    monkeypatch.setattr(slam.registry, "_BACKENDS", slam.registry._BACKENDS | {"own": (Own, Config)})
    script = tmp_path / "script.py"
    script.write_text("x = 1")
    forget()
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__spec__=None, __file__=str(script)))
    assert modules_of_backend("own") == ("__main__", "__main__")
    assert own_code([], ["own", "ekf"]).keys() == {"backend own"}
    forget()
    monkeypatch.setitem(sys.modules, "__main__", SimpleNamespace(__spec__=None))
    with pytest.raises(BadInput, match=r"backend own has no source file .* module of its own"):
        modules_of_backend("own")
    forget()
