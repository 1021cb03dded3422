"""SIGTERM ends a run whatever became of Ctrl-C; neither takes effect while a kernel compiles."""

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
from numba import njit
from numba.core import event

from training.cli import main
from training.runs.processes import process_pool
from training.runs.signals import heed_signals, interrupt_flag


@pytest.fixture(params=[signal.default_int_handler, signal.SIG_IGN, signal.SIG_DFL])
def sigint(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Handle Ctrl-C as Python does, as a shell has it for what it starts in the background, and as the system."""
    before = signal.signal(signal.SIGINT, request.param)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("sigint")
def test_sigterm_interrupts() -> None:
    with heed_signals() as heard:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1.0)
        assert heard.sigterm


@pytest.mark.usefixtures("sigint")
def test_sigterm_takes_effect_between_two_steps() -> None:
    with heed_signals() as heard, interrupt_flag() as interrupted:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
        assert heard.sigterm and interrupted.is_set()


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


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_amid_an_import_that_fails_of_it_is_no_error(
    signum: int, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def half_imported(*_: Any) -> None:
        try:
            os.kill(os.getpid(), signum)
            time.sleep(1.0)
        except KeyboardInterrupt:
            raise AttributeError("partially initialized module") from None

    monkeypatch.setattr("typer.main.get_command", half_imported)
    assert main(["study"]) == code
    assert capsys.readouterr().err == "mecanum: interrupted before the results were written\n"


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


# ---- while kernels compile -------------------------------------------------------------------------------------


def kernels_that_raise(signals: list[int]) -> Any:
    """Return a kernel that calls another; within its compiler, and once, signals come."""

    class Amid(event.Listener):
        def on_start(self, _: Any) -> None:
            pass

        def on_end(self, _: Any) -> None:
            while signals:
                signal.raise_signal(signals.pop(0))

    @njit
    def inner(x: float) -> float:
        return x + 1.0

    @njit
    def outer(x: float) -> float:
        return inner(x)  # type: ignore[no-any-return]

    def compiled() -> Any:
        with event.install_listener("numba:run_pass", Amid()):
            outer(1.0)

    return outer, compiled


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_kernel_is_compiled_to_its_end_before_a_signal_takes_effect(signum: int) -> None:
    outer, compiled = kernels_that_raise([signum])
    with heed_signals() as heard, pytest.raises(KeyboardInterrupt):
        compiled()
    assert heard.broken_off and heard.sigterm == (signum == signal.SIGTERM)
    assert outer.signatures and outer(1.0) == 2.0
    other, compiled = kernels_that_raise([])
    compiled()  # nobody waits any more
    assert other.signatures


def test_a_flag_is_pressed_while_a_kernel_compiles() -> None:
    outer, compiled = kernels_that_raise([signal.SIGINT])
    with heed_signals(), interrupt_flag() as interrupted:
        compiled()
        assert interrupted.is_set() and outer.signatures


_TWICE = """
import signal, sys
from tests.training.runs.test_signals import kernels_that_raise
from training.runs.signals import heed_signals, interrupt_flag
from contextlib import nullcontext

first, second, flag = sys.argv[1:]
with heed_signals(), interrupt_flag() if flag == "flag" else nullcontext():
    kernels_that_raise([int(first), int(second)])[1]()
"""


@pytest.mark.parametrize("flag", ["flag", "none"])
def test_the_second_signal_while_a_kernel_compiles_ends_the_process(flag: str) -> None:
    words = [str(int(signal.SIGINT)), str(int(signal.SIGTERM)), flag]
    command = [sys.executable, "-c", _TWICE, *words]
    where = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=where, check=False)
    assert done.returncode == 143
    assert done.stderr == "mecanum: interrupted before the results were written\n"
