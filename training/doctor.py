"""``mecanum doctor``: what works on this machine, what does not, and what to do about it."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import webbrowser
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from training.runs.errors import one_line

__all__ = ["Finding", "examine"]

_NAME = "mecanum-slam"
_SHOWN = ("gymnasium", "pymunk", "numpy", "numba", "opencv-python-headless")  # what results depend on most
_EXTRAS_NOT_FOR_USERS = {"docs", "release", "test"}
_WINDOW = "import pygame; pygame.display.init(); print(pygame.display.get_driver())"
_TORCH = "import torch; c = torch.cuda; print(c.get_device_name() if c.is_available() else '')"
_ASKED_S = 60.0


@dataclass(frozen=True, kw_only=True)
class Finding:
    """What was found of one thing."""

    name: str
    works: bool
    needed: bool  # whether `mecanum explore` needs it
    found: str
    remedy: str = ""  # what to do where it does not work

    @property
    def ok(self) -> bool:
        """Whether it works, or can be done without."""
        return self.works or not self.needed


def examine() -> list[Finding]:
    """Return what was found, the needed things first; nothing is raised, nothing is written but Numba's cache."""
    found: list[Finding] = []
    for name, needed, check in _CHECKS:
        try:
            for answer in check():
                remedy = "" if answer["works"] else answer["remedy"]
                found.append(Finding(name=name, needed=needed, **answer | {"remedy": remedy}))
        except Exception as error:  # whatever it is, the others are still to be looked at
            said = f"{type(error).__name__}: {one_line(error) or 'no message'}"
            found.append(Finding(name=name, works=False, needed=needed, found=said, remedy=_REINSTALL))
    return found


Answers = Iterator[dict[str, Any]]
_REINSTALL = f"install anew: pip install --force-reinstall {_NAME}"


# ---- what an episode needs -------------------------------------------------------------------------------------


def _python() -> Answers:
    on = f"{platform.python_implementation()} {platform.python_version()} on {platform.platform(terse=True)}"
    yield {"works": sys.version_info >= (3, 11), "found": on, "remedy": "use Python 3.11 or newer"}


def _packages() -> Answers:
    try:
        needed = [r for r in _requirements() if not _extra(r)]
    except PackageNotFoundError:
        yield {"works": False, "found": f"{_NAME} is not installed", "remedy": "pip install ."}
        return
    wrong = [text for r in needed if (text := _mismatch(r))]
    shown = ", ".join(f"{name} {version(name)}" for name in _SHOWN if not any(w.startswith(name) for w in wrong))
    yield {
        "works": not wrong,
        "found": "; ".join(wrong) or f"{_NAME} {version(_NAME)}; {shown}",
        "remedy": f"pip install --upgrade {_NAME}",
    }


def _numba() -> Answers:
    from numba import njit

    compiler: Any = njit
    yield {
        "works": compiler(lambda x: 2 * x)(21) == 42,
        "found": "compiles",
        "remedy": "pip install --force-reinstall numba llvmlite",
    }


def _numba_cache() -> Answers:
    from slam.geometry import wrap_scalar

    # Numba's own word on where this kernel is kept; next to it are those of its file's neighbours.
    folder = Path(str(wrap_scalar.stats.cache_path))
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    writable = os.access(nearest, os.W_OK)
    root = Path(importlib.util.find_spec("slam").origin).parent  # type: ignore[union-attr, arg-type]
    beside = folder.is_relative_to(root)
    places = [root.parent / p for p in ("slam", "mecanum_env", "agents")] if beside else [folder.parent]
    kept = sum(1 for place in places if place.is_dir() for _ in place.rglob("*.nbi"))
    state = f"{kept} kernels kept" if kept else "empty: the first episode compiles its kernels, for about a minute"
    yield {
        "works": writable,
        "found": f"{state}; in {'the packages, ' if beside else ''}{folder}",
        "remedy": f"{nearest} cannot be written, so every run compiles anew: set NUMBA_CACHE_DIR to a folder",
    }


def _policies() -> Answers:
    import agents

    names = ("learned-tour", "ppo", "ppo-frontier")
    for name in names:
        agents.make(name)
    yield {"works": True, "found": f"{', '.join(names)} can be read"}


def _own_agents() -> Answers:
    """Try every agent that another package adds."""
    import agents
    from slam.files import plain_name

    for name in agents.names():
        if agents.entry_point(name).startswith("agents."):
            continue
        what, remedy = "", ""
        try:
            agents.make(name)
        except (Exception, SystemExit) as error:  # whatever it is, the others are still to be looked at
            what, _, remedy = one_line(error).rpartition("; ")
            if not what.startswith("cannot load agent"):  # in its own words
                what = f"cannot load agent {name} ({type(error).__name__}: {one_line(error)})"
                remedy = "mend or uninstall the package that adds it"
        found = plain_name(what or f"{name} can be loaded", 1000)
        yield {"works": not what, "found": found, "remedy": remedy}


def _disk() -> Answers:
    here = Path.cwd()
    free_mb = shutil.disk_usage(here).free / 1e6
    writable = os.access(here, os.W_OK)
    yield {
        "works": writable and free_mb > 100,
        "found": f"{free_mb / 1e3:.1f} GB free in {here}" + ("" if writable else ", which cannot be written"),
        "remedy": "give --out a folder that can be written, on a disk with 100 MB",
    }


# ---- what it can do without -----------------------------------------------------------------------------------


def _threads() -> Answers:
    import numba

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    limits = [f"{name}={os.environ[name]}" for name in names if name in os.environ]
    said = f"{cores} cores, {numba.get_num_threads()} Numba threads" + "".join(f", {limit}" for limit in limits)
    yield {"works": True, "found": said}


def _extras() -> Answers:
    wanted: dict[str, list[Requirement]] = {}
    for requirement in _requirements():
        for extra in _extra(requirement):
            wanted.setdefault(extra, []).append(requirement)
    for extra, requirements in sorted(wanted.items()):
        if extra not in _EXTRAS_NOT_FOR_USERS:
            wrong = [text for r in requirements if (text := _mismatch(r))]
            yield {
                "works": not wrong,
                "found": f"{extra}: {'; '.join(wrong) or 'there'}",
                "remedy": f"pip install '{_NAME}[{extra}]'",
            }


def _window() -> Answers:
    if importlib.util.find_spec("pygame") is None:
        yield {"works": False, "found": "no pygame", "remedy": f"for windows: pip install '{_NAME}[human]'"}
        return
    driver = _ask(_WINDOW)
    yield {
        "works": driver not in ("", "dummy", "offscreen"),
        "found": f"pygame's driver: {driver or 'none'}",
        "remedy": "`mecanum play` needs a screen: set DISPLAY, or look at reports and films instead",
    }


def _browser() -> Answers:
    try:
        name = getattr(webbrowser.get(), "name", "") or "there"
        yield {"works": True, "found": name}
    except webbrowser.Error:
        remedy = "open report.html on another machine: it is one file and loads nothing"
        yield {"works": False, "found": "none", "remedy": remedy}


def _ros() -> Answers:
    there = importlib.util.find_spec("rclpy") is not None
    found = f"rclpy, {os.environ.get('ROS_DISTRO', 'of no named distribution')}" if there else "no rclpy"
    remedy = "for `mecanum ros` alone: source /opt/ros/DISTRO/setup.bash"
    yield {"works": there, "found": found, "remedy": remedy}


def _gpu() -> Answers:
    remedy = "nothing to do: only `mecanum train --device cuda` uses a GPU, and does without"
    if importlib.util.find_spec("torch") is None:
        yield {"works": False, "found": "no PyTorch", "remedy": remedy}
        return
    name = _ask(_TORCH)
    yield {"works": bool(name), "found": name or "PyTorch sees none", "remedy": remedy}


_CHECKS: tuple[tuple[str, bool, Callable[[], Answers]], ...] = (
    ("python", True, _python),
    ("packages", True, _packages),
    ("numba", True, _numba),
    ("policies", True, _policies),
    ("disk", True, _disk),
    ("agent", False, _own_agents),
    ("cache", False, _numba_cache),
    ("threads", False, _threads),
    ("browser", False, _browser),
    ("window", False, _window),
    ("gpu", False, _gpu),
    ("ros 2", False, _ros),
    ("extra", False, _extras),
)


def _requirements() -> list[Requirement]:
    return [Requirement(text) for text in requires(_NAME) or ()]


def _extra(requirement: Requirement) -> list[str]:
    """Return the extra that asks for it, if it is not the core."""
    text = str(requirement.marker or "")
    return [text.split('extra == "')[1].partition('"')[0]] if 'extra == "' in text else []


def _mismatch(requirement: Requirement) -> str:
    """Return what is wrong about an installed package, or about what its extras that are asked for need."""
    try:
        found = version(requirement.name)
    except PackageNotFoundError:
        return f"{requirement.name} is missing"
    if not requirement.specifier.contains(found, prereleases=True):
        return f"{requirement.name} {found}, wanted {requirement.specifier}"
    for extra in sorted(requirement.extras):
        needed = [r for r in map(Requirement, requires(requirement.name) or ()) if _of_extra(r, extra)]
        if wrong := [text for r in needed if (text := _mismatch(r))]:
            return f"{requirement.name}[{extra}]: {', '.join(wrong)}"
    return ""


def _of_extra(requirement: Requirement, extra: str) -> bool:
    """Whether a package needs something for an extra of its own alone, here."""
    marker = requirement.marker
    return marker is not None and marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""})


def _ask(program: str) -> str:
    """Return the last word of a Python program run apart: what it loads may crash, hang or open a window."""
    command = [sys.executable, "-c", program]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_ASKED_S, check=False)
    except subprocess.TimeoutExpired:
        return ""
    lines = done.stdout.strip().splitlines() if done.returncode == 0 else []
    return lines[-1] if lines else ""
