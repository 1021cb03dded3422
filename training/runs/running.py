"""What every long run needs: files that come together, values as JSON has them, versions."""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from slam.formats import atomic_write
from training.runs.signals import interrupt_flag

__all__ = ["plain", "versions", "write_json", "written_together"]

_LIBRARIES = ("mecanum-slam", "gymnasium", "numpy", "numba", "opencv-python-headless", "pymunk")


@contextmanager
def written_together(out: Path, *, without: Iterable[str] = ()) -> Iterator[Path]:
    """Give a folder within ``out`` whose files come to lie in ``out`` when the block ends.

    They are renamed one after the other, ``metrics.json`` last, once an earlier one and the files that shall be
    there no more (``without``) are taken away: a run that fails while writing leaves the results of an earlier one
    as they were, and one Ctrl-C does not leave half the files of this run, half of another.
    """
    last = "metrics.json"
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".writing-", dir=out, ignore_cleanup_errors=True) as folder, interrupt_flag():
        yield Path(folder)
        for name in (last, *without):
            (out / name).unlink(missing_ok=True)
        for path in sorted(Path(folder).iterdir(), key=lambda path: path.name == last):
            path.replace(out / path.name)


def versions() -> dict[str, str]:
    """Return the versions of Python, of the project and of the libraries that results depend on."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers of Python's own, null for what is not finite."""
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON, the file whole or not at all."""
    atomic_write(path, json.dumps(value, indent=1, ensure_ascii=False) + "\n")
