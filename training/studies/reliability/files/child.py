"""A process that reads what it is told to, within a bound of memory: a line in, a line out for each file.

``python -m training.studies.reliability.files.child`` takes ``[reader, seed, first, count]`` and answers each file
with how it went; whoever started it (``guard``) watches its time.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any

from training.runs.errors import BadInput
from training.runs.processes import memory_mb
from training.studies.reliability.files.readers import READERS, Reader

__all__ = ["BOUND_MB", "main", "one_file"]

BOUND_MB = 3072
"""Memory that reading a file may take beyond what the process had before."""

_LONGEST = 600  # characters of an error


def one_file(reader: Reader, seed: int, index: int, folder: Path) -> dict[str, Any]:
    """Make a file, have it read, and return how it went.

    ``end`` is ``read``, ``refused`` (by the project's own error, in one line) or what went wrong.
    """
    case = reader.case(seed, index)
    path = case.put(folder)
    row: dict[str, Any] = {"index": index, "case": case.name, "by_command": reader.by_command(index)}
    _forget_peak()
    before, began = memory_mb("VmRSS"), time.process_time()
    try:
        reader.read(path, index)
        row["end"] = "read"
    except (BadInput, ValueError) as error:
        row["end"], row["said"] = _judged(error, path, named=reader.named), str(error)[:_LONGEST]
    except MemoryError:
        row["end"], row["said"] = "memory", _where(sys.exc_info()[1])
    except Exception as error:
        row["end"], row["said"] = "traceback", f"{type(error).__name__}: {str(error)[:200]}; {_where(error)}"
    row["seconds"] = round(time.process_time() - began, 3)
    row["mb"] = round(memory_mb("VmHWM") - before, 1)
    return row


def _judged(error: Exception, path: Path, *, named: bool) -> str:
    """Return ``refused`` where an error is one of the project's own, in one line that names what it is about."""
    text = str(error)
    if type(error) not in (BadInput, ValueError) and type(error).__module__.split(".")[0] not in _OURS:
        return "traceback"
    if not text or "\n" in text or len(text) > _LONGEST or re.search(r"[\x00-\x1f\x7f]", text):
        return "no one line"
    return "refused" if not named or path.stem in text or path.parent.name in text else "no name"


_OURS = ("slam", "mecanum_env", "agents", "training")


def _where(error: BaseException | None) -> str:
    frames = traceback.extract_tb(error.__traceback__) if error else []
    ours = [
        f for f in frames if f"{os.sep}site-packages{os.sep}" not in f.filename and "/lib/python" not in f.filename
    ]
    return " < ".join(f"{Path(f.filename).name}:{f.lineno} {f.name}" for f in reversed(ours[-4:]))


def _forget_peak() -> None:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def main() -> None:
    """Answer the lines on standard input until there are no more."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what a reader prints is no answer
    sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    soft = int((memory_mb("VmSize") + BOUND_MB) * 2**20)
    resource.setrlimit(resource.RLIMIT_AS, (soft, resource.RLIM_INFINITY))
    warm: set[str] = set()
    for line in sys.stdin:
        name, seed, first, count = json.loads(line)
        if name not in warm:
            READERS[name].warm_up()
            warm.add(name)
        answers.write("ready\n")
        answers.flush()
        for index in range(first, first + count):
            folder = Path(tempfile.mkdtemp(prefix="files-"))
            try:
                row = one_file(READERS[name], seed, index, folder)
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            answers.write(json.dumps(row) + "\n")
            answers.flush()


if __name__ == "__main__":
    main()
