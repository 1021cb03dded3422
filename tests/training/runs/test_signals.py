"""SIGTERM ends a run whatever became of Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from training.cli import main
from training.runs.processes import process_pool
from training.runs.signals import heed_sigterm, interrupt_flag


@pytest.fixture(params=[signal.default_int_handler, signal.SIG_IGN, signal.SIG_DFL])
def sigint(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Handle Ctrl-C as Python does, as a shell has it for what it starts in the background, and as the system."""
    before = signal.signal(signal.SIGINT, request.param)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("sigint")
def test_sigterm_interrupts() -> None:
    with heed_sigterm() as came:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1.0)
        assert came.is_set()


@pytest.mark.usefixtures("sigint")
def test_sigterm_takes_effect_between_two_steps() -> None:
    with heed_sigterm() as came, interrupt_flag() as interrupted:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        assert came.is_set() and interrupted.is_set()


def test_a_worker_leaves_ctrl_c_to_its_parent() -> None:
    with process_pool(1) as pool:
        assert pool.submit(_pressed_twice).result() is False


def _pressed_twice() -> bool:
    with interrupt_flag() as interrupted:
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        return interrupted.is_set()


@pytest.mark.parametrize("broken", [False, True])
def test_ctrl_c_before_a_command_begins_is_a_line(
    broken: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("typer.main.get_command", interrupted)
    if broken:  # what was imported as it came
        monkeypatch.setitem(sys.modules, "slam.files", None)
    assert main(["study"]) == 130
    assert capsys.readouterr().err == "mecanum: interrupted before the results were written\n"


def test_sigterm_amid_an_import_that_fails_of_it_is_sigterm(monkeypatch: pytest.MonkeyPatch) -> None:
    def half_imported(*_: Any) -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1.0)
        except KeyboardInterrupt:
            raise AttributeError("partially initialized module") from None

    monkeypatch.setattr("typer.main.get_command", half_imported)
    assert main(["study"]) == 143


_INTERRUPTED_AMID_AN_EXEC = """
import os, signal, sys, time
import slam.files
from training.cli.app import app, main

@app.command()
def dataclass_is_made():
    exec("os.kill(os.getpid(), signal.SIGTERM); time.sleep(1.0)")

sys.exit(main(["dataclass-is-made"]))
"""


def test_an_interrupt_amid_an_exec_leaves_the_exit_code_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "interrupted.py").write_text(_INTERRUPTED_AMID_AN_EXEC)
    where = {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run(
        [sys.executable, "-m", "interrupted"], capture_output=True, text=True, env=os.environ | where, check=False
    )
    assert done.returncode == 143  # not SIGINT's
    assert done.stderr == "mecanum dataclass-is-made: interrupted before the results were written\n"
