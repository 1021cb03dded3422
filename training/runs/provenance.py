"""What a result was made by: a digest of the code behind it, so that no table mixes two versions of it."""

from __future__ import annotations

import ast
import hashlib
import sys
from collections.abc import Iterable
from functools import cache
from importlib.metadata import packages_distributions
from importlib.util import find_spec, resolve_name
from pathlib import Path

import agents
import slam
from training.runs.errors import BadInput, bad_input

__all__ = [
    "behind_agent", "code_digest", "modules_behind", "modules_of_backend", "own_code", "policy_digest",
    "project_digest", "short_digest",
]  # fmt: skip

_PROJECT = ("slam", "mecanum_env", "agents", "training")
_READ = frozenset({".py", ".safetensors", ".json", ".toml"})
# Who explores is asked for by its own module: neither the registry of the agents nor the bound that knows the map,
# which stand beside what runs an episode, changes what another agent does.
_ONLY_IF_ASKED = frozenset({"agents", "training.truth.known_map"})


def short_digest(parts: Iterable[bytes]) -> str:
    """Return 16 hexadecimal digits that tell sequences of byte strings apart."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(len(part).to_bytes(8, "big"))
        digest.update(part)
    return digest.hexdigest()[:16]


def code_digest(*modules: str) -> str:
    """Return a digest of the source of modules and of all they import, as :func:`modules_behind` finds it."""
    files = modules_behind(*modules)
    return short_digest(part for name in sorted(files) for part in (name.encode(), files[name].read_bytes()))


def project_digest() -> str:
    """Return a digest of all of the project that results may depend on: its source, its policies."""
    files = []
    for package in _PROJECT:
        found = _file(package)
        assert found is not None
        files += [(path.relative_to(found.parents[1]), path) for path in found.parent.rglob("*")]
    kept = sorted((str(name), path) for name, path in files if path.suffix in _READ)
    return short_digest(part for name, path in kept for part in (name.encode(), path.read_bytes()))


def _is_own(module: str) -> bool:
    """Tell whether a module is a user's own, and not the project's."""
    return module.partition(".")[0] not in _PROJECT


def modules_behind(*modules: str) -> dict[str, Path]:
    """Return the modules that ``modules`` import, themselves included, as name → file; read, not run.

    Imports inside of functions count. Followed are the project's own packages, those that ``modules`` are of, and
    what lies beside the latter, unless another distribution brought it; left out are the registry of the agents
    and the planner that knows the map, unless it is one of ``modules``.
    """
    roots = {*_PROJECT, *(name.partition(".")[0] for name in modules)}
    own = frozenset(filter(_is_own, roots))
    found: dict[str, Path] = {}
    open_names = list(modules)
    while open_names:
        name = open_names.pop()
        if name in _ONLY_IF_ASKED and name not in modules:
            continue
        top = name.partition(".")[0]
        if name in found or not (top in roots or (own and _beside(top, own))):
            continue
        path = _file(name)
        if path is None:  # something within a module, or not written in Python
            continue
        found[name] = path
        open_names += _imports(name, path)
        open_names += [name.rpartition(".")[0]] if "." in name else []
    return found


@cache
def _beside(top: str, own: frozenset[str]) -> bool:
    """Whether a package lies where one of ``own`` does, and came with it: site-packages holds everybody's."""
    if not set(_folders(top)) & {folder for name in own for folder in _folders(name)}:
        return False
    brought = _distributions()
    theirs = set(brought.get(top, ()))
    return not theirs or any(theirs & set(brought.get(name, ())) for name in own)


_distributions = cache(packages_distributions)


def _folders(top: str) -> list[Path]:
    origin, places = _found(top)
    return [place.parent for place in places or ([origin] if origin is not None else [])]


@cache
def _found(top: str) -> tuple[Path | None, tuple[Path, ...]]:
    """Return the file of what is imported as ``top``, and the folders of what is within it."""
    try:
        spec = find_spec(top)
    except ValueError:  # of the script that runs, or of what was made at run time
        file = getattr(sys.modules.get(top), "__file__", None)
        return (None if file is None else Path(file).absolute()), ()
    if spec is None:
        return None, ()
    places = tuple(map(Path, spec.submodule_search_locations or ()))
    return (None if spec.origin is None else Path(spec.origin)), places


@cache
def _file(name: str) -> Path | None:
    top, *rest = name.split(".")
    origin, places = _found(top)
    if rest:
        inner = [place.joinpath(*rest) for place in places]
        files = [file for path in inner for file in (path / "__init__.py", path.with_suffix(".py"))]
    else:
        files = [] if origin is None else [origin]
    return next((file for file in files if file.suffix == ".py" and file.is_file()), None)


@cache
def _imports(module: str, path: Path) -> tuple[str, ...]:
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    names: list[str] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = resolve_name("." * node.level + base, package)
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return tuple(names)


# ---- behind a name --------------------------------------------------------------------------------------------


def behind_agent(name: str) -> tuple[tuple[str, ...], str]:
    """Return an agent's modules, and a digest of what makes it and of the file that it names ``policy_path``.

    Raises
    ------
    BadInput
        For an agent that cannot be made without settings of its own, or whose source is not found.
    """
    with bad_input():
        entry, agent = agents.entry_point(name), agents.make(name)
        modules = _with_source(f"agent {name}", entry.partition(":")[0], type(agent).__module__)
    policy: str | Path | None = getattr(agent, "policy_path", None)
    return modules, short_digest([entry.encode(), b"" if policy is None else policy_digest(Path(policy)).encode()])


def modules_of_backend(name: str) -> tuple[str, ...]:
    """Return a backend's modules: its own and that of its configuration; ``BadInput`` where there is no source."""
    with bad_input():
        kinds = type(slam.make(name)), slam.config_type(name)
    return _with_source(f"backend {name}", *(kind.__module__ for kind in kinds))


def own_code(agent_names: Iterable[str], backends: Iterable[str]) -> dict[str, str]:
    """Return a digest of each agent and backend that is a user's own, by its name."""
    found = {}
    for name in agent_names:
        if _is_own(agents.entry_point(name)):
            modules, told = behind_agent(name)
            found[f"agent {name}"] = short_digest([code_digest(*modules).encode(), told.encode()])
    for name in backends:
        modules = modules_of_backend(name)
        if any(map(_is_own, modules)):
            found[f"backend {name}"] = code_digest(*modules)
    return found


def policy_digest(path: Path) -> str:
    """Return a digest of a file that an agent reads, and of the JSON beside it, if any, that describes it."""
    with bad_input():
        if not path.is_file():
            raise ValueError(f"no such file: {path}, which is an agent's policy_path")
    files = [path, path.with_suffix(".json")]
    return short_digest(file.read_bytes() for file in dict.fromkeys(files) if file.is_file())


def _with_source(what: str, *modules: str) -> tuple[str, ...]:
    if not any(module in modules_behind(module) for module in modules):
        raise BadInput(
            f"{what} has no source file by which its results could be told from others'; "
            "put it in a module of its own"
        )
    return modules
