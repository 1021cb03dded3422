"""``mecanum policy`` on the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from training.runs.errors import BadInput, bad_input, check_writable, needs_extra

__all__ = ["policy"]


def policy(
    source: Annotated[Path, typer.Argument(help="Folder of a run, .safetensors or .zip.")],
    target: Annotated[Path, typer.Argument(help=".safetensors (a .json file is written beside it) or .zip.")],
    like: Annotated[
        Path | None,
        typer.Option(help="With a .zip for source: the .json file of the policy that it was trained on from."),
    ] = None,
    member: Annotated[
        int | None, typer.Option(min=1, max=100, help="To a .zip: which of several networks that choose together.")
    ] = None,
) -> None:
    """Convert a policy: a run's best, the package's files, a zip of stable-baselines3 (ppo-frontier's only).

    The package's files, .safetensors and .json, hold no code; of a zip the weights alone are read.

    \b
    Examples:
      mecanum policy out/train mine.safetensors
      mecanum policy mine.safetensors mine.zip
      mecanum policy three.safetensors mine.zip --member 2
      mecanum policy mine.zip other.safetensors --like mine.json
    """  # noqa: D301
    kinds = (_kind(source), target.suffix)
    if kinds not in ((".run", ".safetensors"), (".safetensors", ".zip"), (".zip", ".safetensors")):
        raise BadInput(
            f"cannot make {target} of {source}; a run's folder or a .zip becomes a .safetensors, and that a .zip"
        )
    if (like is not None) != (kinds[0] == ".zip"):
        raise BadInput("--like belongs to a .zip, and a .zip needs it: the .json file of the policy it comes from")
    if member is not None and kinds[1] != ".zip":
        raise BadInput("--member says which network of a .safetensors becomes a .zip")
    check_writable(target.parent)
    with needs_extra("train"):
        from training.learning import networks, policies
    with bad_input():
        if kinds[0] == ".run":
            policies.export_run(source, target)
        elif kinds[0] == ".safetensors":
            policies.write_zip(source, target, member)
        else:
            assert like is not None
            policies.export_policy(networks.read_zip(source), target, _read(like))
    print(f"wrote {target}")


def _kind(path: Path) -> str:
    if not path.exists():
        raise BadInput(f"there is no {path}")
    return ".run" if path.is_dir() else path.suffix


def _read(path: Path) -> dict[str, object]:
    from slam.files import read_json

    try:
        described = read_json(path, nan=True)
        if not isinstance(described, dict) or "config" not in described:
            raise ValueError("it does not say with which config the policy was trained")
    except ValueError as error:
        raise BadInput(f"cannot read {path}: {error}") from error
    # What is of the format is written anew.
    return {k: v for k, v in described.items() if k not in ("format", "heads", "candidate", "state", "driver")}
