"""What the maps of DP-SLAM's particles cost: the shared grid beside a grid copied for every particle.

``mecanum study dp-slam-cost --out DIR`` records one drive in a generated room, replays it to
``dp-slam`` with more and more particles, with either kind of map, and writes ``dp_slam_cost.json``, ``memory.png``
and ``time.png``. Both kinds are the same filter, bit for bit; the last poses are compared to show it.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import agents
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms import registry as room_registry
from mecanum_env.sensing.calibration import backend_settings
from slam.dp_slam import DpSlam, DpSlamConfig
from slam.formats import atomic_write
from slam.particles.shared_grid import SharedGrid
from slam.settings import from_mapping
from slam.types import Odometry, Scan
from training.figures.charts import INK, chart, label, png
from training.figures.tables import text_table
from training.runs.errors import bad_input, check_writable
from training.runs.options import Out, Seed
from training.runs.running import write_json
from training.runs.typed import whole_numbers

__all__ = ["cost", "record", "study"]

Drive = list[tuple[Odometry, Scan]]

_FILES = ("dp_slam_cost.json", "memory.png", "time.png")
_KINDS = ("shared", "copies")


def record(rooms: str, *, seed: int, steps: int) -> tuple[Drive, dict[str, Any]]:
    """Drive with the true pose given; return what the sensors said, and the settings of a backend for it."""
    env = ExploreEnv(rooms=rooms, slam="truth")
    observation, _ = env.reset(seed=seed)
    agent = agents.make("nearest-frontier")
    agent.reset(env.belief)
    drive: Drive = [(env.odometry, env.scan)]
    for _ in range(steps):
        observation, _, terminated, _, _ = env.step(agent.act(observation, env.belief))
        drive.append((env.odometry, env.scan))
        if terminated:
            break
    return drive, backend_settings(env.config)


def cost(
    drive: Drive, settings: dict[str, Any], particles: list[int], *, limit_mb: float, seed: int = 0
) -> list[dict[str, Any]]:
    """Replay a drive with every number of particles and both kinds of maps.

    Returns
    -------
    list
        Per number: ``particles``, ``updates`` and per kind ``mb`` (most that the maps took), ``ms_per_update`` and
        ``last_pose``; ``copies`` is ``None`` where it would take more than ``limit_mb``. ``shared`` also has
        ``nodes`` (most at once), and ``entries``.
    """
    # Compiled before anything is timed.
    for copies in (False, True):
        _replay(drive[: len(drive) // 4], settings, 2, copies=copies, seed=seed)
    out: list[dict[str, Any]] = []
    for n in particles:
        print(f"{n} particles", file=sys.stderr)
        shared = _replay(drive, settings, n, copies=False, seed=seed)
        needs = n * shared.pop("cells") * 16 / 2**20
        row: dict[str, Any] = {"particles": n, "updates": shared.pop("updates"), "shared": shared, "copies": None}
        if needs <= limit_mb:
            copied = _replay(drive, settings, n, copies=True, seed=seed)
            row["copies"] = {key: copied[key] for key in ("mb", "ms_per_update", "last_pose")}
        row["copies_mb"] = needs
        out.append(row)
    return out


def _replay(drive: Drive, settings: dict[str, Any], particles: int, *, copies: bool, seed: int) -> dict[str, Any]:
    config = from_mapping(DpSlamConfig, {**settings, "particles": particles, "copies": copies})
    backend = DpSlam(config)
    backend.reset(seed=seed)
    spent, updates, most, nodes = 0.0, 0, 0, 0
    for odometry, scan in drive:
        backend.predict(odometry)
        before = len(backend.path)
        began = time.perf_counter()
        backend.update(scan)
        took = time.perf_counter() - began
        if len(backend.path) > before:
            spent, updates = spent + took, updates + 1
        most = max(most, backend.grids.nbytes)
        if isinstance(backend.grids, SharedGrid):
            nodes = max(nodes, len(backend.grids.ancestry.nodes))
    rows, cols = backend.grids.lattice.shape
    found: dict[str, Any] = {
        "mb": most / 2**20, "ms_per_update": 1e3 * spent / max(updates, 1), "last_pose": backend.pose.tolist(),
        "updates": updates, "cells": rows * cols,
    }  # fmt: skip
    if isinstance(backend.grids, SharedGrid):
        found |= {"nodes": nodes, "entries": backend.grids.live}
    return found


def study(
    out: Out = Path("out/dp_slam_cost"),
    particles: Annotated[str, typer.Option(help="Numbers, separated by commas.")] = "50,100,200,500,1000",
    rooms: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    seed: Seed = 0,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Of the drive.")] = 120,
    limit_mb: Annotated[float, typer.Option(min=1, max=1e9, help="Copies that need more are left out.")] = 1000.0,
) -> None:
    """Measure what the maps of DP-SLAM's particles cost: one shared grid, or a copy each."""
    numbers = whole_numbers("--particles", particles, low=1, high=100_000)
    with bad_input():
        room_registry.check(rooms)
    check_writable(out, _FILES)
    drive, settings = record(rooms, seed=seed, steps=steps)
    rows = cost(drive, settings, numbers, limit_mb=limit_mb, seed=seed)
    _write(out, rows, {"rooms": rooms, "seed": seed, "steps": len(drive) - 1})
    print(table(rows))


def _write(out: Path, rows: list[dict[str, Any]], run: dict[str, Any]) -> None:
    x = [row["particles"] for row in rows]
    out.mkdir(parents=True, exist_ok=True)
    for name, key, title, unit in (
        ("memory", "mb", "memory", "MB"),
        ("time", "ms_per_update", "time per update", "ms"),
    ):
        figure, (axes,) = chart()
        for kind in _KINDS:
            axes.plot(x, [np.nan if row[kind] is None else row[kind][key] for row in rows], "o-", label=kind)
        if key == "mb":
            axes.plot(x, [row["copies_mb"] for row in rows], "--", color=INK, label="copies, computed")
        label(axes, f"Maps of the particles: {title}", "particles", unit, log="xy")
        atomic_write(out / f"{name}.png", png(figure))
    write_json(out / "dp_slam_cost.json", {"run": run, "rows": rows})


def table(rows: list[dict[str, Any]]) -> str:
    """Return the figures as a table."""
    lines = []
    for row in rows:
        shared, copied = row["shared"], row["copies"]
        lines.append([
            str(row["particles"]), str(shared["nodes"]), f"{shared['mb']:.1f}",
            f"{copied['mb']:.0f}" if copied else f"({row['copies_mb']:.0f})", f"{shared['ms_per_update']:.1f}",
            f"{copied['ms_per_update']:.1f}" if copied else "-",
        ])  # fmt: skip
    return text_table(["particles", "nodes", "shared MB", "copies MB", "shared ms", "copies ms"], lines)
