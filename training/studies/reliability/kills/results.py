"""What a command left in its folder, without what its clock said: to be compared with another run's."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import re
import shutil
import sqlite3
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["damaged", "differences", "kept", "results", "tidy"]

_CLOCK = re.compile(r"wall(_time)?_s$|(^|_)ms(_|$)|realtime|took|command|^identity$")  # an identity is drawn
_TOLD = (".html", ".md", ".png", ".v2", ".0")  # pictures and pages, with times in them: whether they are there


def results(folder: Path) -> dict[str, Any]:
    """Return what every file of a folder says, by its name in it."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = str(path.relative_to(folder))
            if name.startswith("log/"):  # TensorBoard's: a file a start
                continue
            found[name] = "there" if path.suffix in _TOLD else _READERS.get(path.suffix, _digest)(path)
    return found


def damaged(folder: Path) -> list[str]:
    """Return what is wrong with the files under their final names: half a file, or one that cannot be read."""
    wrong = []
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith(".") and path.suffix != ".jsonl":
            try:
                if path.suffix in (".sqlite", ".db"):
                    _check_database(path)
                elif path.suffix in _READERS:
                    _READERS[path.suffix](path)
                elif not path.stat().st_size and path.suffix != ".tum":
                    raise ValueError("empty")
            except Exception as error:
                wrong.append(f"{path.name}: {type(error).__name__}: {error}")
    return wrong


def kept(folder: Path) -> set[str]:
    """Return the rows that a command has kept so far, and what it calls itself."""
    stores = [str(row) for path in folder.glob("*.sqlite") for row in _database(path).get("episodes", [])]
    lines = [line for path in folder.glob("episodes.jsonl") for line in _lines(path)]
    names = [json.loads(path.read_text("utf-8"))["identity"] for path in folder.glob("progress.json")]
    return {*stores, *map(str, lines), *names}


def tidy(folder: Path) -> int:
    """Take away the temporary files that a command left in a folder; return how many there were."""
    stale = [path for path in folder.iterdir() if path.name.startswith(".")]
    for path in stale:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return len(stale)


def differences(one: Any, other: Any, at: str = "") -> list[str]:
    """Return where two results differ."""
    if isinstance(one, dict) and isinstance(other, dict):
        return [
            line for key in sorted({*one, *other})
            for line in differences(one.get(key, "absent"), other.get(key, "absent"), f"{at}/{key}")
        ]  # fmt: skip
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [
            line
            for k, (a, b) in enumerate(zip(one, other, strict=True))
            for line in differences(a, b, f"{at}[{k}]")
        ]
    same = one == other or (one != one and other != other)
    return [] if same else [f"{at}: {str(one)[:80]} is not {str(other)[:80]}"]


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        clock = _CLOCK.search(str(value.get("metric", "")))
        return {key: _timeless(inner) for key, inner in value.items() if not clock and not _CLOCK.search(key)}
    return [_timeless(inner) for inner in value] if isinstance(value, list) else value


def _csv(path: Path) -> Any:
    with path.open(newline="", encoding="utf-8") as file:
        return [row for row in map(_timeless, csv.DictReader(file)) if row]


def _database(path: Path) -> Any:
    connection = sqlite3.connect(f"file:{path}?mode=ro", uri=True)
    try:
        names = [row[0] for row in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        tables = {name: [list(row) for row in connection.execute(f'SELECT * FROM "{name}"')] for name in names}
    finally:
        connection.close()
    return {name: sorted((_cells(row) for row in rows), key=str) for name, rows in tables.items()}


def _cells(row: list[Any]) -> list[Any]:
    return [_timeless(json.loads(v)) if isinstance(v, str) and v.startswith("{") else v for v in row]


def _check_database(path: Path) -> None:
    connection = sqlite3.connect(path)  # rolls back what was not committed, as whoever goes on does
    try:
        said = connection.execute("PRAGMA integrity_check").fetchone()[0]
    finally:
        connection.close()
    if said != "ok":
        raise ValueError(said)


def _lines(path: Path) -> list[Any]:
    """Return the lines that are whole: what was cut off is done again."""
    found = []
    for line in path.read_text("utf-8").splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            found.append(_timeless(json.loads(line)))
    return found


def _zip(path: Path) -> Any:
    """Return the numbers in a zip of stable-baselines3: their bytes differ with how they came to be."""
    import torch

    with zipfile.ZipFile(path) as archive:
        return {
            name: _numbers(torch.load(io.BytesIO(archive.read(name)), weights_only=True, map_location="cpu"))
            for name in ("policy.pth", "policy.optimizer.pth")
        }


def _numbers(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _numbers(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_numbers(inner) for inner in value]
    return _of(value.numpy().tobytes()) if hasattr(value, "numpy") else value


def _of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def _digest(path: Path) -> str:
    return _of(path.read_bytes())


_READERS: dict[str, Callable[[Path], Any]] = {
    ".json": lambda path: _timeless(json.loads(path.read_text("utf-8"))),
    ".toml": lambda path: tomllib.loads(path.read_text("utf-8")),
    ".csv": _csv, ".sqlite": _database, ".db": _database, ".zip": _zip,
    ".jsonl": lambda path: sorted(map(str, _lines(path))),
}  # fmt: skip
