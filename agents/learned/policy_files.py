"""Trained policies on disk: weights as safetensors beside a JSON file that says where they come from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

__all__ = ["policy_format", "read_policy"]


def policy_format(path: Path) -> str:
    """Return the format that the JSON file beside a policy's weights names.

    Raises
    ------
    ValueError
        Where one of the two files is missing, or the JSON file cannot be read.
    """
    about = path.with_suffix(".json")
    for file in (path, about):
        if not file.is_file():
            raise ValueError(f"policy {path}: {file} is missing; both files are needed")
    try:
        described = json.loads(about.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"policy {path} cannot be read: {error}") from error
    return str(described.get("format")) if isinstance(described, dict) else ""


def read_policy(path: Path, wanted: str) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
    """Return a policy's weights, and what the JSON file beside them says; neither file can run code.

    Raises
    ------
    ValueError
        For a missing or damaged file, or one of another format than ``wanted``; the message names it.
    """
    about = path.with_suffix(".json")
    try:
        described = json.loads(about.read_text(encoding="utf-8"))
        weights = load_file(path)
    except FileNotFoundError as error:
        raise ValueError(f"policy {path}: {error.filename or path} is missing; both files are needed") from error
    except (OSError, ValueError, SafetensorError) as error:
        raise ValueError(f"policy {path} cannot be read: {error}") from error
    if not isinstance(described, dict) or described.get("format") != wanted:
        raise ValueError(f"policy {about}: format is not {wanted!r}")
    return weights, described
