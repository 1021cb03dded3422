"""The command line where it cannot write, or others write, too: refused in a line, and nothing is lost."""

from __future__ import annotations

import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from training.benchmark.store import FILE
from training.runs.processes import ONE_THREAD
from training.studies.reliability.kills.alone import argv_of, undisturbed
from training.studies.reliability.kills.results import damaged, differences, results, tidy

__all__ = ["PLACES", "Skipped"]

_COMMANDS = {"benchmark": FILE, "explore": "metrics.json", "replay": "metrics.json", "study": "episodes.jsonl"}
"""What is run, and a file that it writes."""

_PATIENCE_S = 900.0
_TEN_YEARS_S = 10 * 365 * 86400.0


class Skipped(Exception):
    """Why a place cannot be made here."""


def _start(
    argv: Sequence[str], *, within: Sequence[str] = (), most_bytes: int | None = None
) -> subprocess.Popen[str]:
    def bound() -> None:
        if most_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))

    return subprocess.Popen(
        [*within, sys.executable, "-m", "training.cli", *argv], text=True, stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, preexec_fn=bound,
        env=os.environ | ONE_THREAD | {"MECANUM_COMPILING": "0"},
    )  # fmt: skip


def _end(process: subprocess.Popen[str]) -> tuple[int, str]:
    said = process.communicate(timeout=_PATIENCE_S)[1]
    return process.returncode, said


def _judged(name: str, end: tuple[int, str]) -> list[str]:
    """Return what is wrong with how a command was refused: in one line, that says what."""
    code, said = end
    last = said.strip().splitlines()[-1] if said.strip() else ""
    wrong = []
    if code not in (1, 2):
        wrong.append(f"{name} ends with {code}, not refused: {said[-300:]}")
    if "Traceback" in said or not last.startswith("mecanum"):
        wrong.append(f"{name} is not refused in a line: {said[-600:]}")
    return wrong


def _whole(name: str, out: Path) -> list[str]:
    """Run a command where nothing is in the way, and hold it against one that nothing ever was."""
    code, said = _end(_start(argv_of(name, out)))
    if code:
        return [f"{name} ends with {code} once nothing is in the way: {said[-300:]}"]
    tidy(out)
    return [f"{name}, then: {line}" for line in differences(results(out), undisturbed(name)[0])]


@contextmanager
def _folder():  # type: ignore[no-untyped-def]
    with tempfile.TemporaryDirectory(prefix="places-") as folder:
        yield Path(folder)


_MOUNTED = """
mount -t tmpfs -o size=$1 none "$2" || exit 99
[ "$3" = ro ] && mkdir "$2/out" && mount -o remount,ro "$2"
place=$2; copy=$4; shift 4
"$@"; code=$?
cp -a "$place/." "$copy"
exit $code
"""


def _on_mount(argv: Sequence[str], folder: Path, size: str, how: str) -> tuple[int, str]:
    """Run on a disk of a size, mounted for it alone; what it leaves is copied to ``folder/copy``."""
    copy = folder / "copy"
    copy.mkdir()
    if os.geteuid() or shutil.which("unshare") is None or not sys.platform.startswith("linux"):
        raise Skipped("mounting takes Linux, unshare and root")
    shell = ["unshare", "-m", "sh", "-c", _MOUNTED, "sh", size, str(folder / "mount"), how, str(copy)]
    (folder / "mount").mkdir()
    end = _end(_start(argv, within=shell))
    if end[0] == 99 or "unshare:" in end[1]:
        raise Skipped(f"no mounting here: {end[1].strip()[-200:]}")
    return end


def full_disk(seed: int) -> list[str]:
    """Run commands on disks of which a part of what they need is left; then with room."""
    wrong = []
    for k, name in enumerate(_COMMANDS):
        undisturbed(name)
        for size in ("4k", "16k", "64k")[(seed + k) % 3 :][:2]:
            with _folder() as folder:
                end = _on_mount(argv_of(name, folder / "mount" / "out"), folder, size, "rw")
                if end[0] == 0:
                    continue  # it needs no more
                left = folder / "copy" / "out"
                wrong += _judged(f"{name} on {size}", end)
                wrong += [f"{name} on {size}: {line}" for line in (damaged(left) if left.exists() else ())]
                wrong += _whole(name, left)
    return wrong


def small_files(seed: int) -> list[str]:
    """Run commands whose files may not grow beyond a bound; then without."""
    wrong = []
    for k, name in enumerate(_COMMANDS):
        most = (1, 3000, 20_000, 50_000)[(seed + k) % 4]
        with _folder() as folder:
            out = folder / "out"
            end = _end(_start(argv_of(name, out), most_bytes=most))
            if end[0] == 0:
                continue
            wrong += _judged(f"{name} with files of {most} bytes", end)
            wrong += [
                f"{name} with files of {most} bytes: {line}" for line in (damaged(out) if out.exists() else ())
            ]
            wrong += _whole(name, out)
    return wrong


def read_only(seed: int) -> list[str]:
    """Run commands that write to a folder that is mounted read-only."""
    wrong = []
    for name in _COMMANDS:
        with _folder() as folder:
            wrong += _judged(
                f"{name}, read-only", _on_mount(argv_of(name, folder / "mount" / "out"), folder, "1m", "ro")
            )
    return wrong


def in_the_way(seed: int) -> list[str]:
    """Run commands that find a file where their folder should be, folders where their files should be."""
    wrong = []
    for name, file in _COMMANDS.items():
        with _folder() as folder:
            (folder / "out").write_text("mine")
            wrong += _judged(f"{name}, a file for a folder", _end(_start(argv_of(name, folder / "out"))))
            if (folder / "out").read_text() != "mine":
                wrong.append(f"{name} has written over a file")
            (folder / "other" / file / "kept").mkdir(parents=True)
            wrong += _judged(f"{name}, a folder for {file}", _end(_start(argv_of(name, folder / "other"))))
            if not (folder / "other" / file / "kept").is_dir():
                wrong.append(f"{name} has removed a folder")
    return wrong


def locked_store(seed: int) -> list[str]:
    """Have another process hold a store: for a while, and for longer than a benchmark waits."""
    wrong = []
    with _folder() as folder:
        out = folder / "out"
        out.mkdir()
        for held_s, refused in ((5.0, False), (None, True)):
            with closing(sqlite3.connect(out / FILE, isolation_level=None, check_same_thread=False)) as other:
                other.execute("BEGIN EXCLUSIVE")
                process = _start(argv_of("benchmark", out))
                if held_s is not None:
                    time.sleep(held_s)
                    other.execute("ROLLBACK")
                end = _end(process)
            if refused:
                wrong += _judged("benchmark on a locked store", end)
            elif end[0]:
                wrong.append(f"benchmark on a store that was locked for {held_s} s ends with {end}")
        wrong += _whole("benchmark", out)
    return wrong


def two_at_once(seed: int) -> list[str]:
    """Run two benchmarks into one folder at once: both end, or one is refused; the rows are as of one."""
    with _folder() as folder:
        out = folder / "out"
        both = [_start(argv_of("benchmark", out)) for _ in range(2)]
        ends = [_end(process) for process in both]
        wrong = [line for end in ends if end[0] for line in _judged("one of two benchmarks", end)]
        if all(end[0] for end in ends):
            wrong.append("neither of two benchmarks came to its end")
        return wrong + [
            f"of two benchmarks: {line}" for line in differences(results(out), undisturbed("benchmark")[0])
        ]


def clock_set_back(seed: int) -> list[str]:
    """Go on in folders whose files are dated ten years ahead, as after a clock was set back."""
    wrong = []
    for name in _COMMANDS:
        with _folder() as folder:
            out = folder / "out"
            code, said = _end(_start(argv_of(name, out)))
            if code:
                wrong.append(f"{name} ends with {code}: {said[-300:]}")
            for path in (*out.rglob("*"), out):
                os.utime(path, (time.time() + _TEN_YEARS_S,) * 2)
            wrong += _whole(name, out)
    return wrong


PLACES: dict[str, Callable[[int], list[str]]] = {
    "full disk": full_disk, "small files": small_files, "read-only": read_only, "in the way": in_the_way,
    "locked store": locked_store, "two at once": two_at_once, "clock set back": clock_set_back,
}  # fmt: skip
"""Name → what is wrong there, of a seed."""
