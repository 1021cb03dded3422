"""The house is as its page says: imports flow one way, agents see no truth, importing stays light."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")
FLOORS = ("slam", "mecanum_env", "agents", "training")  # lowest first
HEAVY = (
    "matplotlib",
    "torch",
    "stable_baselines3",
    "pygame",
    "imageio_ffmpeg",
    "mcap",
    "rerun",
    "mkdocs",
    "ray",
    "pyarrow",
)

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


# ---- rooms within the floors -----------------------------------------------------------------------------------


@cache
def module_imports() -> dict[str, frozenset[str]]:
    """Return per module of the house the modules of the house that it imports, anywhere in its source."""
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for floor in FLOORS
        for path in sources(floor)
    }

    def module(name: str) -> str:
        return name if name in modules else name.rpartition(".")[0]

    return {
        name: frozenset(
            module(other)
            for _, other in imported(ast.parse(path.read_text("utf-8")))
            if module(other) in modules and module(other) != name
        )
        for name, path in modules.items()
    }


def circle(graph: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def within(folder: str) -> dict[str, set[str]]:
    """Return what a folder's files and folders import of each other, each folder taken as one."""
    depth = folder.count(".") + 2
    graph: dict[str, set[str]] = {}
    for name, others in module_imports().items():
        if name.startswith(f"{folder}."):
            child = ".".join(name.split(".")[:depth])
            inside = {".".join(o.split(".")[:depth]) for o in others if o.startswith(f"{folder}.")}
            graph.setdefault(child, set()).update(inside - {child})
    return graph


def test_no_two_modules_import_each_other() -> None:
    assert not circle({name: set(others) for name, others in module_imports().items()})


@pytest.mark.parametrize(
    "folder",
    sorted({str(p.parent.relative_to(ROOT)).replace("/", ".") for f in FLOORS for p in sources(f)}),
)
def test_rooms_import_each_other_in_one_direction(folder: str) -> None:
    assert not circle(within(folder))


def test_circles_are_noticed() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})


def rooms_of_the_house() -> set[Path]:
    return {path.parent for floor in FLOORS for path in sources(floor)}


def test_no_room_is_crowded_and_no_file_long() -> None:
    for place in (*FLOORS, "tests", "examples"):
        for path in (ROOT / place).rglob("*"):
            if path.suffix in (".py", ".js", ".css", ".html"):
                assert len(path.read_text("utf-8").splitlines()) <= 400, path
    for folder in {path.parent for place in (*FLOORS, "tests") for path in sources(place)}:
        crowd = 16 if folder.name in FLOORS else 14  # with the face: a dozen; at the top what is picked by name
        assert len(list(folder.glob("*.py"))) <= crowd, folder
    assert len((ROOT / "README.md").read_text("utf-8").splitlines()) <= 200


def test_tests_mirror_the_tree() -> None:
    """Tests lie where what they test lies, and each room is tested there, or as a whole one room further up."""
    beside = {path.parent.relative_to(ROOT / "tests") for path in (ROOT / "tests").rglob("test_*.py")}
    rooms = {path.relative_to(ROOT) for path in rooms_of_the_house()}
    assert beside - rooms == {Path(), Path("examples")}
    for room in rooms - beside:
        name = ".".join(room.parts)
        above = (ROOT / "tests" / room.parent).glob("test_*.py")
        assert any(
            f"{name}." in path.read_text("utf-8") or f"{name} import" in path.read_text("utf-8") for path in above
        ), room


def test_every_room_has_a_face_that_names_what_is_in_it_and_nothing_else() -> None:
    for folder in rooms_of_the_house():
        face = folder / "__init__.py"
        says = face.is_file() and ast.get_docstring(ast.parse(face.read_text("utf-8")))
        assert says, folder
        if folder.name in FLOORS:
            continue  # the page names its rooms
        within = {path.stem for path in folder.glob("*.py")} | {
            path.parent.name for path in folder.glob("*/__init__.py")
        }
        assert set(re.findall(r"``(\w+)``", says)) == within - {"__init__", "__main__"}, folder


# ---- the page --------------------------------------------------------------------------------------------------


def rooms_on_the_page() -> list[str]:
    """Return the modules and folders in the page's tables of rooms, dotted, in its order."""
    text = PAGE.partition("## Rooms")[2].partition("## How one step flows")[0]
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    return [
        name.strip("/").removesuffix(".py").replace("/", ".")
        for row in rows
        for name in re.findall("`(.*?)`", row)
    ]


def room_of(module: str, rooms: list[str]) -> str:
    return max((r for r in rooms if module == r or module.startswith(f"{r}.")), key=len, default="")


def test_the_page_names_every_room() -> None:
    rooms = rooms_on_the_page()
    there = set(module_imports())
    assert set(rooms) <= there
    folders = {name for name in there if (ROOT / name.replace(".", "/")).is_dir()} - set(FLOORS)
    top = {name for name in there if name.count(".") == 1}
    assert folders | top == set(rooms)


def test_rooms_import_only_what_stands_before_them_on_the_page() -> None:
    rooms = rooms_on_the_page()
    place = {name: k for k, name in enumerate(rooms)}
    wrong = [
        f"{name} imports {other}"
        for name, others in module_imports().items()
        for other in others
        if (room := room_of(name, rooms)) and (behind := room_of(other, rooms))
        # A room and those within it are one concern; their own order is tested above.
        if not (room.startswith(behind) or behind.startswith(room)) and place[behind] > place[room]
    ]
    assert not wrong


def test_every_path_on_the_page_exists() -> None:
    paths = re.findall(r"`((?:slam|mecanum_env|agents|training)/[\w/.]*)(?::(\w+))?`", PAGE)
    assert len(paths) > 50
    for path, definition in paths:
        assert (ROOT / path).exists(), path
        if definition:
            source = (ROOT / path).read_text("utf-8")
            assert re.search(rf"^\s*(def|class) {definition}\b", source, re.MULTILINE), f"{path}: {definition}"


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


def test_no_kernel_has_default_values() -> None:
    """One that is an array has another identity in every process, so the kernel would be compiled anew in each."""
    for path in sorted(p for room in FLOORS for p in (ROOT / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list):
                assert not node.args.defaults and not any(node.args.kw_defaults), f"{path}: {node.name}"
