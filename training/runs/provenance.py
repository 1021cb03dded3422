"""What a result was made by: a digest of the code behind it, so that no table mixes two versions of it."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterable
from functools import cache
from importlib.util import find_spec, resolve_name
from pathlib import Path

__all__ = ["code_digest", "modules_behind", "project_digest", "short_digest"]

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


def modules_behind(*modules: str) -> dict[str, Path]:
    """Return the modules that ``modules`` import, themselves included, as name → file; read, not run.

    Imports inside of functions count. Followed are the project's own packages and those that ``modules`` are of;
    left out are the registry of the agents and the planner that knows the map, unless it is one of ``modules``.
    """
    roots = {*_PROJECT, *(name.partition(".")[0] for name in modules)}
    found: dict[str, Path] = {}
    open_names = list(modules)
    while open_names:
        name = open_names.pop()
        if name in _ONLY_IF_ASKED and name not in modules:
            continue
        if name in found or name.partition(".")[0] not in roots:
            continue
        path = _file(name)
        if path is None:  # something within a module, or not written in Python
            continue
        found[name] = path
        open_names += _imports(name, path)
        open_names += [name.rpartition(".")[0]] if "." in name else []
    return found


@cache
def _file(name: str) -> Path | None:
    top, _, rest = name.partition(".")
    spec = find_spec(top)
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin)
    if rest:
        if spec.submodule_search_locations is None:
            return None
        path = path.parent.joinpath(*rest.split("."))
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return path if path.suffix == ".py" and path.is_file() else None


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
