"""Robots, lidars and noises drawn by lot: what holds where nothing was tuned.

``mecanum study worlds --seeds 10000:10099`` draws a world for each seed: a body of 0.3 to 0.8 m, one of five kinds
of rooms, a lidar of 120 to 720 beams, 180° to 360° of view and 4 to 20 m, encoders, wheels and floors from better
than the presets' to far worse. A planning agent explores each. Worlds in which something went wrong are listed,
and their configurations kept.
"""

from __future__ import annotations

import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mecanum_env.arguments import make_config
from mecanum_env.config import EnvConfig, to_toml
from slam.formats import atomic_write
from training.episodes.explore import run_whole
from training.episodes.room_pictures import parse_seeds
from training.figures.tables import csv_table, markdown_table
from training.runs.campaign import backend_names, keep_settings, made_by
from training.runs.errors import bad_input
from training.runs.options import Backends, Out, Ray, Seeds, Workers, workers_of
from training.runs.rows import resume
from training.runs.running import versions, write_json

__all__ = ["draw", "study", "table", "wrong"]

Job = tuple[int, str]  # seed, backend
Row = dict[str, Any]

_ROOMS = ("apartment", "rectangular", "corridors", "cave", "maze")
_AGENTS = ("nearest-frontier", "brisk-tour", "ppo-frontier", "active")
_LIMIT_S = 400.0
_KEPT = (
    "coverage", "time_to_95_s", "time_s", "end", "collisions", "ate_rmse_m", "anees", "map_iou", "lost_s",
    "relocalisations",
)  # fmt: skip
# From which on something went wrong.
_ATE_M, _NEES_OVER_3, _LOST_S = 0.1, 3.0, 0.5


def draw(seed: int, slam: str) -> tuple[EnvConfig, str]:
    """Return the world of a seed, and the agent that explores it."""
    rng = np.random.default_rng([seed, 0x776F726C])  # a stream of its own: the episode draws by the seed, too

    def between(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 4)

    def decades(low: float, high: float) -> float:
        return round(float(10.0 ** rng.uniform(np.log10(low), np.log10(high))), 5)

    length = between(0.3, 0.8)
    width = between(0.3, max(min(length, 0.6), 0.3))
    robot = {
        "length_m": length, "width_m": width, "mass_kg": between(5.0, 40.0), "wheel_radius_m": between(0.03, 0.08),
        "wheelbase_m": length * between(0.6, 0.85), "track_m": width * between(0.6, 0.85),
        "max_speed_m_s": between(0.4, 1.2), "max_turn_rate_rad_s": between(0.8, 2.5),
        "motor_lag_s": between(0.02, 0.15),
    }  # fmt: skip
    lidar = {
        "beams": int(rng.choice([120, 180, 270, 360, 540, 720])),
        "field_of_view_deg": float(rng.choice([360, 360, 360, 270, 240, 180])),
        "range_max_m": between(4.0, 20.0), "offset_m": between(-0.1, 0.35 * length),
    }  # fmt: skip
    noise = {
        "range_sigma_m": decades(0.002, 0.04), "dropout": float(rng.choice([0.0, 0.005, 0.05, 0.1])),
        "encoder": decades(0.002, 0.05), "radius_error": decades(0.002, 0.03), "base_error": decades(0.002, 0.03),
        "slip": float(rng.choice([0.0, 0.0, 0.05, 0.15])), "friction": between(0.4, 0.8),
        "patch_share": float(rng.choice([0.0, 0.0, 0.2])),
    }  # fmt: skip
    steps = {
        "step_s": float(rng.choice([0.06, 0.1, 0.1, 0.2])),
        "grid_resolution_m": float(rng.choice([0.04, 0.05, 0.05, 0.08])),
    }
    rooms, agent = str(rng.choice(_ROOMS)), str(rng.choice(_AGENTS))
    return make_config(config=steps, rooms=rooms, slam=slam, robot=robot, lidar=lidar, noise=noise), agent


def run_job(job: Job) -> Row:
    """Explore one world; return what came of it."""
    seed, backend = job
    world, agent = draw(seed, backend)
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "world.toml"
        config.write_text(to_toml(world), encoding="utf-8")
        episode = run_whole(
            out=Path(folder) / "out", config=config, agent=agent, seed=seed,
            max_steps=round(_LIMIT_S / world.step_s),
        )  # fmt: skip
    metrics = episode.metrics()
    return {"rooms": world.rooms, "agent": agent} | {key: metrics[key] for key in _KEPT}


def wrong(row: Row) -> list[str]:
    """Return what went wrong in a world, in words."""
    return [
        words for words, so in (
            (f"{100 * row['coverage']:.1f} % covered", row["time_to_95_s"] is None),
            (f"{row['collisions']} contacts", row["collisions"] > 0),
            (f"{100 * row['ate_rmse_m']:.0f} cm off", row["ate_rmse_m"] > _ATE_M),
            (f"NEES/3 {row['anees']:.1f}", row["anees"] > _NEES_OVER_3),
            (f"lost for {row['lost_s']:.0f} s", row["lost_s"] > _LOST_S),
        ) if so
    ]  # fmt: skip


def _line(name: str, rows: list[Row]) -> list[str]:
    ates, nees = [100 * row["ate_rmse_m"] for row in rows], [row["anees"] for row in rows]
    return [
        name, str(len(rows)), str(sum(row["time_to_95_s"] is not None for row in rows)),
        str(sum(row["collisions"] for row in rows)), f"{statistics.median(ates):.2f} ({max(ates):.1f})",
        f"{statistics.median(nees):.2f}, {sum(v > _NEES_OVER_3 for v in nees)}",
        f"{statistics.fmean(row['map_iou'] or 0.0 for row in rows):.3f}",
        f"{sum(row['lost_s'] > _LOST_S for row in rows)}",
    ]  # fmt: skip


def table(rows: list[Row]) -> str:
    """Return a line for each kind of rooms, and one for all."""
    head = [
        "rooms", "worlds", "reached 95 %", "contacts", "ATE [cm], median (worst)", "NEES/3, median, above 3",
        "wall IoU, mean", "lost",
    ]  # fmt: skip
    groups = [(kind, [row for row in rows if row["rooms"] == kind]) for kind in _ROOMS]
    lines = [_line(f"`{kind}`", group) for kind, group in groups if group]
    return markdown_table(head, [*lines, _line("all", rows)])


def study(
    slam: Backends = "invariant-ekf", seeds: Seeds = "10000:10099", workers: Workers = None, ray: Ray = None,
    out: Out = Path("out/worlds"),
) -> None:  # fmt: skip
    """Let agents explore worlds drawn by lot: robots, lidars, noises and rooms that nobody looked at."""
    with bad_input():
        asked = backend_names(slam, without={"truth": "knows where it is; there is nothing to ask"})
        jobs = [(seed, backend) for backend in asked for seed in parse_seeds(seeds)]
    who = workers_of(workers, ray)
    settings = {**made_by(backends=asked), **versions()}
    keep_settings(out, settings, ["worlds.jsonl", "worlds.csv", "summary.json"])
    rows = resume(out / "worlds.jsonl", jobs, run_job, workers=who, what="worlds")
    atomic_write(out / "worlds.csv", csv_table([{"seed": s, "slam": b} | row for (s, b), row in rows.items()]))
    failed = []
    for (seed, backend), row in rows.items():
        if what := wrong(row):
            file = out / f"{seed}_{backend}.toml"
            atomic_write(file, to_toml(draw(seed, backend)[0]))
            failed.append(f"{file.name}: {row['agent']}, --seed {seed}: {', '.join(what)}")
    tables = {name: table([row for (_, b), row in rows.items() if b == name]) for name in asked}
    write_json(out / "summary.json", {**settings, "tables": tables, "wrong": failed})
    for name, shown in tables.items():
        print(f"{name}\n\n{shown}\n")
    print(
        f"something went wrong in {len(failed)} of {len(rows)} worlds" + "".join(f"\n  {line}" for line in failed)
    )
