"""Tests on every supported Python, with the lowest and the newest versions of what is depended on: ``nox``.

``nox -s lowest`` and ``nox -s newest-3.13`` run one of them; what follows ``--`` is for pytest. Interpreters that
are not at hand are left out.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import nox

nox.options.default_venv_backend = "venv"
nox.options.error_on_missing_interpreters = False

PROJECT = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]
# Needs no training library; the episode after it runs the highest floor.
SMOKE = ("tests/slam/test_ekf.py", "tests/mecanum_env/test_env.py", "tests/agents/test_agents.py")
TESTS = ("pytest", "pytest-xdist", "hypothesis", "pettingzoo")


@nox.session(python=["3.11", "3.12", "3.13"])
def newest(session: nox.Session) -> None:
    """Test with the newest versions that the index has."""
    session.install(".", *TESTS)
    _test(session)


@nox.session(python="3.11")  # the oldest NumPy has no wheels for newer ones
def lowest(session: nox.Session) -> None:
    """Test with the lowest versions that pyproject.toml allows."""
    session.install(*(text.replace(">=", "==") for text in PROJECT["dependencies"]), ".", *TESTS)
    _test(session)


def _test(session: nox.Session) -> None:
    session.run("python", "-m", "pytest", *(session.posargs or SMOKE), env={"OMP_NUM_THREADS": "1"})
    session.run("mecanum", "explore", "--rooms", "rectangular", "--out", f"{session.create_tmp()}/explored")
    session.run("mecanum", "doctor")
