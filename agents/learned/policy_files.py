"""Trained policies on disk: weights as safetensors beside a JSON file that says where they come from."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from slam.files import quoted, read_bytes, read_json
from slam.formats import atomic_write
from slam.types import Floats

__all__ = ["MOST_BYTES", "policy_format", "read_policy", "write_policy"]

Made = TypeVar("Made")

MOST_BYTES = 256 * 2**20
"""Of a policy's file."""


def policy_format(path: Path) -> str:
    """Return the format that the JSON file beside a policy's weights names.

    Raises
    ------
    ValueError
        Where one of the two files is missing, or the JSON file cannot be read.
    """
    return str(_described(path).get("format"))


def read_policy(
    path: Path, wanted: str, make: Callable[[dict[str, Floats], dict[str, Any]], Made]
) -> tuple[Made, dict[str, Any]]:
    """Return what ``make`` makes of a policy's weights and of what the JSON file says, and the latter.

    Neither file can run code.

    Raises
    ------
    ValueError
        For a missing or damaged file, or one of another format than ``wanted``; the message names it.
    """
    described = _described(path)
    weights = _weights(path)
    if described.get("format") != wanted:
        found = quoted(str(described.get("format")), 60)
        raise ValueError(
            f"policy {path.with_suffix('.json')}: format is not {wanted!r} but {found}; give another policy"
        )
    try:
        return make(weights, described), described
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"policy {path} does not fit together: {quoted(_words(error), 300)[1:-1]}") from error


def write_policy(
    path: Path, weights: Mapping[str, NDArray[Any]], described: Mapping[str, Any],
    check: Callable[[Path], object] | None = None,
) -> None:  # fmt: skip
    """Write a policy's weights, in half precision, and the JSON file beside them.

    ``check`` reads them first, under another name: a ``ValueError`` of its leaves an earlier policy as it was.
    """
    # Safetensors writes memory as it lies, whatever its order.
    halved = {name: np.asarray(value, dtype=np.float16, order="C") for name, value in weights.items()}
    if check is not None:
        with TemporaryDirectory() as folder:
            trial = Path(folder) / path.name
            write_policy(trial, weights, described)
            try:
                check(trial)
            except ValueError as error:
                raise ValueError(str(error).replace(str(trial), str(path))) from error
    atomic_write(path, save(halved))
    atomic_write(path.with_suffix(".json"), json.dumps(described, indent=1, ensure_ascii=False) + "\n")


def _described(path: Path) -> dict[str, Any]:
    about = path.with_suffix(".json")
    for file in (path, about):
        if not file.is_file():
            raise ValueError(f"policy {path}: {file} is missing; both files are needed")
    try:
        described = read_json(about, what="policy's file", nan=True)
    except ValueError as error:
        raise ValueError(f"policy {path} cannot be read: {error}") from error
    return described if isinstance(described, dict) else {}


def _weights(path: Path) -> dict[str, Floats]:
    try:
        weights = load(read_bytes(path, what="policy", limit=MOST_BYTES))
    except (SafetensorError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"policy {path} cannot be read: {quoted(_words(error), 200)[1:-1]}") from error
    for name, value in weights.items():
        if not np.issubdtype(value.dtype, np.floating) or not np.isfinite(value).all():
            raise ValueError(f"policy {path} cannot be read: {quoted(name)} holds what is no finite number")
    return weights


def _words(error: Exception) -> str:
    return f"{error.args[0]!r} is missing" if isinstance(error, KeyError) and error.args else str(error)
