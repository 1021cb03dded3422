"""The documentation holds: Python runs, commands parse, links lead somewhere, tables say what the code does."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import pkgutil
import re
import shlex
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote, urlsplit

import gymnasium
import pytest
import typer
from gymnasium.error import DependencyNotInstalled

import agents
import mecanum_env
import slam.registry
from mecanum_env import rooms
from mecanum_env.config import RewardConfig
from training.cli.study import STUDIES, study_command

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
SOURCES = [*PAGES, ROOT / "README.md", ROOT / "BENCHMARK.md", ROOT / "CHANGELOG.md"]
ENVIRONMENTS = {
    "mecanum_env/Explore-v0": "reference/environment.md",
    "mecanum_env/ExploreWheels-v0": "reference/wheels_environment.md",
    "mecanum_env/ExploreFrontier-v0": "reference/frontier_environment.md",
}

assert mecanum_env, "registers the environments"


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block of a page: the line it begins at, its language, its text, whether it says not to be run."""

    line: int
    language: str
    text: str
    left_out: bool


@cache
def blocks(page: Path) -> tuple[Block, ...]:
    """Return the fenced blocks of a page; one after a comment ``<!-- not run: why -->`` is not run."""
    found, text = [], page.read_text(encoding="utf-8")
    for match in re.finditer(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", text, re.MULTILINE | re.DOTALL):
        before = text[: match.start()]
        lines = [line.removeprefix(match[1]) for line in match[3].splitlines(keepends=True)]
        left_out = before.rstrip().endswith("-->") and "<!-- not run: " in before.rstrip().splitlines()[-1]
        found.append(Block(before.count("\n") + 2, match[2], "".join(lines), left_out))
    return tuple(found)


def prose(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^( *)```.*?^\1```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def names(paths: list[Path]) -> list[str]:
    return [str(path.relative_to(ROOT)) for path in paths]


# ---- Python ----------------------------------------------------------------------------------------------------

WITH_PYTHON = [page for page in SOURCES if any(block.language == "python" for block in blocks(page))]


@pytest.mark.parametrize("page", WITH_PYTHON, ids=names(WITH_PYTHON))
def test_python_blocks_run_in_order(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType(f"docs_{page.stem.replace('-', '_')}")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # dataclasses look their module up
    monkeypatch.setattr(rooms.registry, "_GENERATORS", dict(rooms.registry._GENERATORS))
    monkeypatch.setattr(slam.registry, "_BACKENDS", dict(slam.registry._BACKENDS))
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if block.language == "python":
            # With the page's own line numbers, for tracebacks.
            code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
            if not block.left_out:
                with without_missing_extras(page):
                    exec(code, module.__dict__)


@contextmanager
def without_missing_extras(page: Path) -> Iterator[None]:
    """Skip where a page asks for an extra that is not installed."""
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, DependencyNotInstalled) or (
                isinstance(cause, ModuleNotFoundError) and not (ROOT / str(cause.name).partition(".")[0]).exists()
            ):
                pytest.skip(f"{page.name} needs an extra that is not installed: {cause}")
            cause = cause.__cause__
        raise


# ---- commands --------------------------------------------------------------------------------------------------


def command_lines(page: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the commands of a page's shell blocks, comments off and continued lines joined."""
    for block in blocks(page):
        if block.language in ("", "bash", "sh", "shell"):
            joined = re.sub(r"\\\n\s*", " ", block.text)
            for number, line in enumerate(joined.splitlines(), block.line):
                if re.match(r"(mecanum|python|make|pip) ", line):
                    yield number, shlex.split(line, comments=True)


@cache
def cli() -> Any:
    from training.cli import app

    return typer.main.get_command(app)


@pytest.mark.parametrize("page", SOURCES, ids=names(SOURCES))
def test_commands_parse(page: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    for line, words in command_lines(page):
        where = f"{page.name}:{line}: {shlex.join(words)}"
        if words[0] == "mecanum" and words[1].startswith("--"):
            assert words[1] in {option for parameter in cli().params for option in parameter.opts}, where
        elif words[0] == "mecanum":
            command, arguments = command_of(words, where)
            try:
                command.make_context(words[1], arguments)  # parses, and does not run
            except Exception as error:
                raise AssertionError(f"{where}: {error}") from error
        elif words[0] == "python" and words[1] != "-m":
            assert (ROOT / words[1]).is_file(), where
        elif words[0] == "make":
            assert is_target(words[1]), where
        elif words[0] == "pip":
            for extra in re.findall(r"\[([a-z,]+)\]", " ".join(words)):
                assert set(extra.split(",")) <= set(extras), where


@pytest.mark.parametrize("page", SOURCES, ids=names(SOURCES))
def test_commands_in_the_text_have_options_that_exist(page: Path) -> None:
    for span in re.findall(r"`((?:mecanum|make) [^`]*)`", prose(page)):
        words = span.split()
        where = f"{page.name}: {span}"
        if words[0] == "mecanum" and re.match(r"[a-z]", words[1]):
            command, arguments = command_of(words, where)
            known = {option for parameter in command.params for option in parameter.opts}
            assert {word for word in arguments if word.startswith("--")} <= known | {"--help"}, where
        elif words[0] == "make":
            assert is_target(words[1]), where


def is_target(name: str) -> bool:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    return re.search(rf"^{re.escape(name)}:", makefile, re.MULTILINE) is not None


def command_of(words: list[str], where: str) -> tuple[Any, list[str]]:
    """Return the command that words of ``mecanum …`` start, a study's own if it is one, and its arguments."""
    assert words[1] in cli().commands, where
    if words[1] == "study" and len(words) > 2 and re.match(r"[a-z]", words[2]):
        assert words[2] in STUDIES, where
        return a_study(words[2]), words[3:]
    return cli().commands[words[1]], words[2:]


@cache
def a_study(name: str) -> Any:
    if name == "learned-tour":
        pytest.importorskip("torch", reason="needs the extra `train`")
    return study_command(name)


# ---- what there is, is documented ------------------------------------------------------------------------------


@cache
def everything() -> str:
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def test_every_name_of_the_registries_is_documented() -> None:
    ids = [name for name in gymnasium.registry if name.startswith("mecanum_env/")]
    assert sorted(ids) == sorted(ENVIRONMENTS)
    for name in (*ids, *agents.names(), *slam.names(), *rooms.names()):
        assert f"`{name}`" in everything(), name


def test_every_study_is_documented() -> None:
    for name in STUDIES:
        assert f"mecanum study {name}" in everything(), name


def test_every_command_and_option_is_documented() -> None:
    for name, command in cli().commands.items():
        assert f"mecanum {name}" in everything(), name
        for parameter in command.params:
            for option in parameter.opts:
                assert not option.startswith("--") or option in everything(), f"mecanum {name} {option}"


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_environment_pages_have_the_spaces_of_the_code(name: str) -> None:
    page = (DOCS / ENVIRONMENTS[name]).read_text(encoding="utf-8")
    env = gymnasium.make(name)
    assert page.startswith(f"# `{name}`")
    assert f"| Action space | `{env.action_space}`" in page
    modes = ", ".join(f"`{mode}`" for mode in env.metadata["render_modes"])
    assert f"| Render modes | {modes} |" in page
    for heading in ("Action space", "Observation space", "Reward", "Starting state", "Episode end", "Arguments"):
        assert f"\n## {heading}\n" in page
    assert "\n## Version history\n" in page
    if env.spec is not None and env.spec.max_episode_steps is not None:
        assert f"| Step limit | {env.spec.max_episode_steps} (" in page
    if name == "mecanum_env/ExploreWheels-v0":
        return  # its observation is that of the first page
    assert isinstance(env.observation_space, gymnasium.spaces.Dict)
    for key, space in env.observation_space.items():
        row = re.search(rf"^\| `{key}` \| (\([^)]*\)) (\w+) \|", page, re.MULTILINE)
        assert row is not None, key
        shape = row[1].replace("beams", str(env.unwrapped.config.lidar.beams))  # type: ignore[attr-defined]
        assert (shape, row[2]) == (str(space.shape), str(space.dtype)), key
    env.close()


def test_the_reward_table_has_the_weights_of_the_code() -> None:
    page = (DOCS / "reference/environment.md").read_text(encoding="utf-8")
    for field in dataclasses.fields(RewardConfig):
        assert f"| `{field.name}` | {field.default} |" in page


def test_defaults_in_brackets_are_those_of_the_code() -> None:
    """A setting's name with a number in brackets behind it, ``name`` [0.5 m], states a default."""
    defaults = config_defaults()
    checked = 0
    for page in PAGES:
        for name, number in re.findall(r"`([a-z_]+)` \[(-?\d+(?:\.\d+)?)(?: ?(?:°|m|s|rad))?\]", prose(page)):
            assert float(number) in defaults.get(name, ()), f"{page.name}: `{name}` [{number}]"
            checked += 1
    assert checked > 50


def config_defaults() -> dict[str, set[float]]:
    """Return the numbers that fields of the project's dataclasses have as defaults, by the fields' names."""
    found: dict[str, set[float]] = {}
    for package in (slam, mecanum_env, agents):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(info.name)
            for cls in vars(module).values():
                if isinstance(cls, type) and dataclasses.is_dataclass(cls):
                    for field in dataclasses.fields(cls):
                        if isinstance(field.default, int | float):
                            found.setdefault(field.name, set()).add(float(field.default))
    return found


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 200


@pytest.mark.parametrize("page", PAGES, ids=names(PAGES))
def test_pages_say_first_what_they_are_for(page: Path) -> None:
    title, after = page.read_text(encoding="utf-8").split("\n\n", 2)[:2]
    assert re.fullmatch(r"# .+", title)
    assert re.match(r"[A-Z`\[]", after) and not after.startswith(("Code:", "```")), "prose follows the title"


# ---- links -----------------------------------------------------------------------------------------------------


def hooks() -> ModuleType:
    """Return docs/hooks.py, where its libraries are installed."""
    pytest.importorskip("mkdocs", reason="the site needs the extra `docs`: mkdocs is not installed")
    pytest.importorskip("math_core", reason="the site needs the extra `docs`: math_core is not installed")
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", SOURCES, ids=names(SOURCES))
def test_links_hold_in_the_repository(page: Path) -> None:
    links: list[str] = []
    module = hooks()
    module.rewrite_links(page.read_text(encoding="utf-8"), lambda image, text, target: links.append(target) or "")
    for target in links:
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        file = (page.parent / path).resolve() if path else page
        assert file.exists() and file.is_relative_to(ROOT), f"{page.name} links to {target}"
        if anchor and file.suffix == ".md":
            found = re.findall(r"^#+ +(.*?) *$", prose(file), re.MULTILINE)
            assert anchor in [module.slug(heading) for heading in found], f"{page.name} links to {target}"


def test_anchors_are_github_s() -> None:
    slug = hooks().slug
    assert slug("`mecanum_env/Explore-v0`") == "mecanum_envexplore-v0"
    assert slug("Paper B's claims") == "paper-bs-claims"
    assert slug("Two real building floors, 1739 and 4240 m²") == "two-real-building-floors-1739-and-4240-m"


def test_links_are_rewritten_outside_code_only() -> None:
    module = hooks()

    def shout(image: str, text: str, target: str) -> str:
        return f"{image}<{text}|{target}>"

    page = "a [`b`](c.md) `[d](e)` ![f](g.png)\n\n```python\nh[i](j)\n```\n[k\nl](m.md#n)\n"
    assert module.rewrite_links(page, shout) == (
        "a <`b`|c.md> `[d](e)` !<f|g.png>\n\n```python\nh[i](j)\n```\n<k\nl|m.md#n>\n"
    )


def test_equations_part_at_wide_spaces_outside_groups() -> None:
    split = hooks().split_equation
    assert split(r"a = \{b\}, \qquad c = \left(d \quad e\right) \quad {f \quad g}") == [
        r"a = \{b\},",
        r"c = \left(d \quad e\right)",
        r"{f \quad g}",
    ]
    matrix = r"\begin{pmatrix} 1 & 2 \\ 3 & 4 \end{pmatrix}"
    assert split(rf"{matrix} \qquad {matrix}") == [matrix, matrix]


class Site(HTMLParser):
    """The ids of a page of the site, and what it points to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attributes}
        self.ids |= {values[key] for key in ("id", "name") if key in values}
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        if tag in ("script", "img", "iframe") and "src" in values:
            self.loads.append(values["src"])
        if tag == "link" and values.get("rel") in ("stylesheet", "icon", "preload"):
            self.loads.append(values["href"])


def test_the_site_builds_whole_and_loads_nothing_from_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hooks()
    for needed in ("material", "mkdocstrings"):
        pytest.importorskip(needed, reason=f"the site needs the extra `docs`: {needed} is not installed")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    site = tmp_path / "site"
    config = load_config(str(ROOT / "mkdocs.yml"), site_dir=str(site), strict=True)
    build(config)  # raises where there is a warning: a link, an anchor, an equation, a page that nav leaves out
    pages = {path: Site(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    assert len(pages) >= len(PAGES) + 3, "README, BENCHMARK and CHANGELOG are pages, too"
    for path, page in pages.items():
        text = path.read_text(encoding="utf-8")
        assert "arithmatex" not in text, f"{path.name}: an equation was not set"
        for target in page.loads:
            parts = urlsplit(target)
            assert not parts.netloc, f"{path.name} loads {target}"
            # 404.html is made for the root of a server.
            folder = site if parts.path.startswith("/") else path.parent
            assert (folder / unquote(parts.path).lstrip("/")).is_file(), f"{path.name} loads {target}"
        for target in page.links if path.name != "404.html" else ():
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path not in ("", ".") else path
            assert file.is_file(), f"{path.name} links to {target}"
            if parts.fragment and file in pages:
                assert unquote(parts.fragment) in pages[file].ids, f"{path.name} links to {target}"
