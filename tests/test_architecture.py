"""The house keeps its floors: imports flow downward, agents see no truth, importing stays light."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ("slam", "mecanum_env", "agents", "training")  # lowest first
HEAVY = ("torch", "stable_baselines3", "pygame", "imageio_ffmpeg", "mcap", "rerun", "mkdocs")

# What an agent must not touch: the environment's ground truth, what holds it, and what info tells of it.
TRUTH_NAMES = {"truth", "true_pose", "floor_plan", "FloorPlan", "position_error_m", "heading_error_rad"}
TRUTH_ATTRIBUTES = TRUTH_NAMES | {"world"}
TRUTH_MODULES = ("mecanum_env.ground_truth", "mecanum_env.physics.world", "mecanum_env.rooms")


def sources(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def imported(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of every absolute import, however deep, and of importlib's with a literal."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield from ((node.lineno, f"{node.module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if called in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                yield node.lineno, node.args[0].value


def upward_imports(source: str, package: str) -> list[str]:
    above = FLOORS[FLOORS.index(package) + 1 :]
    return [f"{line}: {name}" for line, name in imported(ast.parse(source)) if name.split(".")[0] in above]


def touches_of_truth(source: str) -> list[str]:
    tree = ast.parse(source)
    found = [
        (line, name)
        for line, name in imported(tree)
        if name.startswith(TRUTH_MODULES) or TRUTH_NAMES & set(name.split("."))
    ]
    for node in ast.walk(tree):
        match node:
            case ast.Attribute(attr=name) if name.lstrip("_") in TRUTH_ATTRIBUTES:
                found.append((node.lineno, name))
            case ast.Name(id=name) | ast.arg(arg=name) if name.lstrip("_") in TRUTH_NAMES:
                found.append((node.lineno, name))
            case ast.Constant(value=str(name)) if name in TRUTH_NAMES:  # getattr(env, "truth"), info["true_pose"]
                found.append((node.lineno, name))
    return [f"{line}: {name}" for line, name in sorted(found)]


@pytest.mark.parametrize("package", FLOORS)
def test_no_package_imports_upward(package: str) -> None:
    assert sources(package), f"{package} has no source"
    bad = {
        str(path.relative_to(ROOT)): lines
        for path in sources(package)
        if (lines := upward_imports(path.read_text("utf-8"), package))
    }
    assert not bad


def test_no_agent_touches_the_truth() -> None:
    bad = {
        str(path.relative_to(ROOT)): lines
        for path in sources("agents")
        if (lines := touches_of_truth(path.read_text("utf-8")))
    }
    assert not bad


@pytest.mark.parametrize(
    "line",
    [
        "import agents",
        "from training.cli import main",
        "if TYPE_CHECKING:\n    import agents.base as base",
        "def f():\n    from agents import base",
        "importlib.import_module('agents.base')",
    ],
)
def test_upward_imports_are_noticed(line: str) -> None:
    assert upward_imports(line, "mecanum_env")
    assert not upward_imports(line, "training")


@pytest.mark.parametrize(
    "line",
    [
        "env.unwrapped.truth.pose",
        "env.unwrapped._truth",
        "getattr(env.unwrapped, 'truth')",
        "info['true_pose']",
        "env.unwrapped.world.body",
        "def act(observation, truth): ...",
        "from mecanum_env.rooms.floor_plan import FloorPlan",
        "import mecanum_env.physics.world",
    ],
)
def test_touches_of_truth_are_noticed(line: str) -> None:
    assert touches_of_truth(line)


def test_an_honest_agent_passes() -> None:
    assert not touches_of_truth("from slam.types import Belief\npose_world = belief.pose\nenv.unwrapped.belief")


def test_importing_the_environments_loads_no_learning_library(tmp_path: Path) -> None:
    # Decoys make the libraries importable, so that the test can fail where they are not installed.
    for name in HEAVY:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("")
    code = f"import sys, mecanum_env; print(sorted(set({HEAVY!r}) & set(sys.modules)))"
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    result = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": path},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


def test_no_kernel_leaves_its_rounding_to_the_compiler() -> None:
    """Contraction and reassociation depend on inlining, and that on what comes from the cache: other last bits."""
    harmless = {"nnan", "nsz"}  # no nan comes in, and the sign of a zero matters to nobody
    for path in sorted(p for room in FLOORS for p in (ROOT / room).rglob("*.py")):
        for flags in re.findall(r"fastmath=(\{[^}]*\}|\w+)", path.read_text()):
            assert set(re.findall(r"\w+", flags)) <= harmless | {"False"}, f"{path}: {flags}"
