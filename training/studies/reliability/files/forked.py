"""The command in a fork of a process that has it loaded: starting Python for it takes a second a file.

What is run is what ``python -m training.cli`` runs, with an exit code and a standard error of its own.
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
import tempfile
import traceback
from collections.abc import Sequence
from typing import NoReturn

import cv2

__all__ = ["load_command", "run_forked"]

_COMMAND = "training.cli"  # by name: this floor knows nothing of it


def load_command() -> None:
    """Load what a fork shall find loaded."""
    cv2.setNumThreads(1)  # threads do not follow into a fork, and who waits for them waits for ever
    importlib.import_module(_COMMAND)


def run_forked(argv: Sequence[str]) -> tuple[int, str]:
    """Run ``mecanum`` in a fork of this process; return its exit code, and what it said on standard error."""
    load_command()
    sys.stdout.flush()
    with tempfile.TemporaryFile() as said:
        pid = os.fork()
        if pid == 0:
            _be_command(argv, said.fileno())
        _, status = os.waitpid(pid, 0)
        said.seek(0)
        return os.waitstatus_to_exitcode(status), said.read().decode("utf-8", "replace")


def _be_command(argv: Sequence[str], said: int) -> NoReturn:
    code = 1
    try:
        nothing = os.open(os.devnull, os.O_RDWR)
        for number, to in enumerate((nothing, nothing, said)):
            os.dup2(to, number)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False)  # noqa: SIM115
        sys.argv = ["mecanum", *argv]
        runpy.run_module(_COMMAND, run_name="__main__")
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:  # not as Python ends: the process that this one was forked from has still to do so
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)
