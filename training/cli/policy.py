"""``mecanum policy`` on the command line."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path
from typing import Annotated

import typer

from training.runs.errors import BadInput, bad_input, check_writable, needs_extra

__all__ = ["policy"]


def policy(
    files: Annotated[
        list[str],
        typer.Argument(
            metavar="SOURCE... TARGET",
            help="From a run's folder, .safetensors, .zip or hf://USER/REPO; to .safetensors (a .json file is "
            "written beside it), .zip or hf://USER/REPO. Several .safetensors become one.",
        ),
    ],
    like: Annotated[
        Path | None,
        typer.Option(help="With a .zip for source: the .json file of the policy that it was trained on from."),
    ] = None,
    private: Annotated[
        bool, typer.Option("--private", help="To a hub: make the repository, if there is none, a private one.")
    ] = False,
    member: Annotated[
        int | None, typer.Option(min=1, max=100, help="To a .zip: which of several networks that choose together.")
    ] = None,
) -> None:
    """Convert a policy: a run's best, the package's files, a zip of stable-baselines3 (ppo-frontier's only).

    Of several policies of ppo-frontier it makes one whose networks choose together.

    The package's files, .safetensors and .json, hold no code; of a zip the weights alone are read. A Hugging Face
    hub, hf://USER/REPO[/NAME][@REVISION], is sent them or has them as they are; commit and SHA-256 are said.

    \b
    Examples:
      mecanum policy out/train mine.safetensors
      mecanum policy mine.safetensors mine.zip
      mecanum policy one.safetensors two.safetensors both.safetensors
      mecanum policy three.safetensors mine.zip --member 2
      mecanum policy mine.zip other.safetensors --like mine.json
      mecanum policy mine.safetensors hf://me/explorer
      mecanum policy hf://me/explorer@v2 theirs.safetensors
    """  # noqa: D301
    if len(files) < 2:
        raise BadInput(f"what shall {files[0]} become? Give a target, too")
    *sources, target = files
    if len(sources) > 1:
        if like is not None or member is not None or private:
            raise BadInput("--like, --member and --private are of one source; leave them out")
        _join([Path(name) for name in sources], Path(target))
        return
    source = sources[0]
    if any(name.startswith("hf://") for name in (source, target)):
        if like is not None or member is not None:
            raise BadInput("--like and --member are of a .zip; a hub has the package's files")
        _over_the_hub(source, target, private)
        return
    if private:
        raise BadInput("--private is of a hub, hf://USER/REPO; leave it out")
    _convert(Path(source), Path(target), like, member)
    print(f"wrote {target}")


def _convert(source: Path, target: Path, like: Path | None, member: int | None) -> None:
    kinds = (_kind(source), target.suffix)
    if kinds not in ((".run", ".safetensors"), (".safetensors", ".zip"), (".zip", ".safetensors")):
        raise BadInput(
            f"cannot make {target} of {source}; a run's folder or a .zip becomes a .safetensors, and that a .zip"
        )
    if (like is not None) != (kinds[0] == ".zip"):
        raise BadInput("--like belongs to a .zip, and a .zip needs it: the .json file of the policy it comes from")
    if member is not None and kinds[1] != ".zip":
        raise BadInput("--member says which network of a .safetensors becomes a .zip")
    check_writable(target.parent, [target.name])
    with needs_extra("train"):
        from training.learning import networks, policies
    target.parent.mkdir(parents=True, exist_ok=True)
    with bad_input():
        if kinds[0] == ".run":
            policies.export_run(source, target)
        elif kinds[0] == ".safetensors":
            policies.write_zip(source, target, member)
        else:
            assert like is not None
            policies.export_policy(networks.read_zip(source), target, _read(like))


def _join(sources: list[Path], target: Path) -> None:
    for path in (*sources, target):
        if path.suffix != ".safetensors":
            raise BadInput(f"cannot join {path}; several .safetensors become one .safetensors")
    if target.resolve() in map(Path.resolve, sources):
        raise BadInput(f"{target} is one of those that are joined, and would be lost; name another target")
    check_writable(target.parent, [target.name])
    with needs_extra("train"):
        from training.learning import policies
    target.parent.mkdir(parents=True, exist_ok=True)
    with bad_input():
        policies.join_policies(sources, target)
    print(f"wrote {target}")


def _over_the_hub(source: str, target: str, private: bool) -> None:
    """Send a policy's files, or fetch them; of what is no policy of ours neither is done."""
    import agents
    from agents.learned import hub
    from agents.learned.policy_files import MOST_BYTES
    from slam.files import read_bytes
    from slam.formats import atomic_write

    if target.startswith(hub.PREFIX):
        weights = Path(source)
        if weights.suffix != ".safetensors":
            raise BadInput(f"cannot send {source}; give a .safetensors file, its .json beside it")
        with bad_input():
            place = hub.parse(target)
            agents.make(str(weights))  # it can be read
            commit = hub.upload(weights, place, private=private)
        print(f"sent to {place._replace(revision=commit)}")
    else:
        path = Path(target)
        if path.suffix != ".safetensors":
            raise BadInput(f"cannot write {target}; give the name of a .safetensors file")
        check_writable(path.parent, (path.name,))
        with bad_input():
            place = hub.parse(source)
            weights, commit = hub.download(place)
            agents.make(str(weights))
            for suffix in (".safetensors", ".json"):
                atomic_write(path.with_suffix(suffix), read_bytes(weights.with_suffix(suffix), limit=MOST_BYTES))
        print(f"wrote {target}, {place._replace(revision=commit)}")
    for suffix in (".safetensors", ".json"):
        print(f"sha256 {sha256(weights.with_suffix(suffix).read_bytes()).hexdigest()}  {suffix}")


def _kind(path: Path) -> str:
    if not path.exists():
        raise BadInput(f"there is no {path}; give a policy's file, or the folder of a training")
    return ".run" if path.is_dir() else path.suffix


def _read(path: Path) -> dict[str, object]:
    from slam.files import read_json
    from slam.settings import from_mapping, to_mapping
    from training.learning.config import TrainConfig

    try:
        described = read_json(path, nan=True)
        if not isinstance(described, dict) or "config" not in described:
            raise ValueError("it does not say with which config the policy was trained")
        described["config"] = to_mapping(from_mapping(TrainConfig, described["config"]))
    except ValueError as error:
        raise BadInput(f"cannot read {path}: {error}") from error
    # What is of the format is written anew.
    return {k: v for k, v in described.items() if k not in ("format", "heads", "candidate", "state", "driver")}
