"""``mecanum doctor``: it finds what is there, and names the remedy where something is not."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import agents
from agents.random import RandomAgent
from training import doctor
from training.cli import main

ROOT = Path(__file__).resolve().parents[2]


def test_here_an_episode_has_all_it_needs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_ask", lambda program: "")  # no other process here: the two have their own test
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert {"python", "packages", "numba", "policies", "disk", "cache", "browser", "gpu"} <= {
        line.split()[1] for line in lines if not line.startswith(" ")
    }
    assert main(["doctor", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ok"] is True
    assert all(f["works"] or f["remedy"] for f in said["findings"]), "what does not work has a remedy"


def test_a_package_that_is_missing_or_too_old_fails_and_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_ask", lambda program: "")
    asked = [
        Requirement("numpy>=99"),
        Requirement("no-such-package-anywhere>=1"),
        Requirement('rich>=1; extra == "x"'),
    ]
    monkeypatch.setattr(doctor, "_requirements", lambda: asked)
    assert main(["doctor"]) == 1
    lines = capsys.readouterr().out.splitlines()
    (line,) = [i for i, text in enumerate(lines) if text.startswith("FAILS")]
    version = importlib.metadata.version("numpy")
    assert f"numpy {version}, wanted >=99; no-such-package-anywhere is missing" in lines[line]
    assert lines[line + 1].strip() == "pip install --upgrade mecanum-slam"
    assert any(re.fullmatch(r"ok +extra +x: there", text) for text in lines)


def test_an_extra_that_asks_for_anothers_extra_is_there_with_all_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = {
        "mecanum-slam": ['rich[part]>=1; extra == "x"', 'rich[whole]>=1; extra == "y"'],
        "rich": [
            'no-such-package-anywhere>=1; python_version >= "3" and extra == "part"',
            'numpy>=99; python_version < "3" and extra == "whole"',
            "numpy>=2.0",
        ],
    }
    monkeypatch.setattr(doctor, "requires", needed.__getitem__)
    found = {answer["found"]: answer["works"] for answer in doctor._extras()}
    assert found == {"x: rich[part]: no-such-package-anywhere is missing": False, "y: there": True}


def test_what_breaks_is_a_finding_and_no_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> doctor.Answers:
        raise OSError("no\nway")
        yield {}

    monkeypatch.setattr(doctor, "_CHECKS", (("thing", True, broken), ("other", False, broken)))
    needed, other = doctor.examine()
    assert needed.found == "OSError: no way" and needed.remedy and not needed.ok
    assert other.ok and not other.works


def test_agents_of_other_packages_that_cannot_be_loaded_are_listed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "that_exits.py").write_text("raise SystemExit(3)")
    (tmp_path / "that_breaks.py").write_text("raise ValueError('a; b')")
    monkeypatch.syspath_prepend(tmp_path)
    points = {
        "tour": "agents.tour:Tour", "mine": "agents_of_mine:Mine", "random-too": "numpy:nothing",
        "exits": "that_exits:X", "breaks": "that_breaks:X",
    }  # fmt: skip
    monkeypatch.setattr(agents, "_installed", lambda: points)
    found = list(doctor._own_agents())
    assert not any(answer["works"] for answer in found) and all(answer["remedy"] for answer in found)
    said = " ".join(answer["found"] for answer in found)
    assert "cannot load agent mine (No module named 'agents_of_mine')" in said and "tour" not in said
    assert "random-too" in said and "load agent exits (SystemExit: 3)" in said
    assert "load agent breaks (ValueError: a; b)" in said
    monkeypatch.setattr(agents, "_installed", lambda: {"drunk": "tests.training.test_doctor:Drunk"})
    assert [(a["works"], a["found"]) for a in doctor._own_agents()] == [(True, "drunk can be loaded")]


class Drunk(RandomAgent):
    """An agent of another package."""


def test_the_cache_is_where_numba_says(tmp_path: Path) -> None:
    code = "from training import doctor; print(*doctor._numba_cache())"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kernels"), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    assert "empty: the first episode compiles its kernels" in done.stdout
    assert str(tmp_path / "kernels") in done.stdout


def test_a_program_apart_that_fails_or_hangs_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor._ask("print('first'); print('x11')") == "x11"
    assert doctor._ask("import no_such_module") == ""
    monkeypatch.setattr(doctor, "_ASKED_S", 0.05)
    assert doctor._ask("import time; time.sleep(60)") == ""


@pytest.mark.parametrize(
    ("shell", "words"),
    [("bash", "complete -o default"), ("zsh", "#compdef mecanum"), ("fish", "complete --command")],
)
def test_completion_of_the_shell(shell: str, words: str) -> None:
    assert words in run(_MECANUM_COMPLETE=f"source_{shell}")
    if shell == "bash":
        completed = run(_MECANUM_COMPLETE="complete_bash", COMP_WORDS="mecanum ex", COMP_CWORD="1")
        assert completed.split() == ["explore"]
        assert "--install-completion" in run("--help")


def run(*arguments: str, **variables: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | variables
    command = [sys.executable, "-m", "training.cli", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
