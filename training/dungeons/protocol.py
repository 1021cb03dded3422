"""The dungeons protocol: path length of exploration on generated indoor maps, beside the published table.

``mecanum benchmark --protocol dungeons --maps DIR --agents nearest-frontier,tour --out DIR`` runs what is missing
in ``OUT/rows.jsonl`` (a killed run goes on where it stopped), then writes ``rows.csv`` and ``summary.json`` and
prints the table. What an episode is stands in :mod:`training.dungeons.episode`.
"""

from __future__ import annotations

import hashlib
import math
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import agents
from slam.formats import atomic_write
from slam.settings import check_name
from training.dungeons.bound import BOUNDS
from training.dungeons.episode import NEAREST, NEAREST_VIEW, SCANS, explore
from training.dungeons.world import SENSORS, Dungeon, layout, load
from training.figures.tables import csv_table, markdown_table, number
from training.runs.campaign import Workers, keep_settings, made_by
from training.runs.errors import BadInput, bad_input
from training.runs.rows import resume
from training.runs.running import write_json

__all__ = ["PUBLISHED", "run_dungeons", "summarise", "table"]

Row = dict[str, Any]
_Job = tuple[str, str, str, str]  # agent; digest of the map's file (its name says nothing); scan; sensor

BASELINE = "nearest-frontier"
"""The agent that the others' ratios are taken to: the published rule, as far as it is known."""

REFERENCES = (NEAREST_VIEW, "known-walls")
"""What ratios are taken to besides, where it was run: a nearest frontier that needs less way, and the bound that
is defined as the published one."""

PUBLISHED: dict[str, tuple[float, float]] = {
    "nearest frontier": (652.0, 76.0),
    "NBVP": (645.0, 109.0),
    "utility": (585.0, 79.0),
    "ARiADNE": (579.0, 82.0),
    "DARE": (563.0, 71.0),
    "TARE local": (558.0, 67.0),
    "known map": (499.0, 61.0),
}
"""Path length [m], mean and standard deviation, on that benchmark's 100 test maps (DARE, ICRA 2025)."""

_STORE, _CSV, _SUMMARY = "rows.jsonl", "rows.csv", "summary.json"
_COLUMNS = (
    "agent", "map", "layout", "path_m", "hops", "coverage", "unseen_cells", "end", "path_to_250_m",
    "decision_ms_median",
)  # fmt: skip
_RESAMPLES = 10_000


def run_dungeons(
    maps: Path, agent_names: Sequence[str], *, out: Path, workers: Workers = 1, scan: str = SCANS[0],
    sensor: str = SENSORS[0],
) -> dict[str, Any]:  # fmt: skip
    """Run every agent on every map that ``out`` does not hold yet, and return the summary of all asked for.

    Raises
    ------
    BadInput
        In one line: which option, file or name is wrong, and what to do.
    """
    with bad_input():
        for name in agent_names:
            agents.check(name, NEAREST, NEAREST_VIEW, *BOUNDS)
        check_name("--scan", scan, SCANS)
        check_name("--sensor", sensor, SENSORS)
    paths = _maps(maps)
    digests = {path: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in paths}
    # A map that cannot be used is found before any work is lost.
    layouts = {path: hashlib.sha256(layout(load(path))).hexdigest()[:8] for path in paths}
    registered = [name for name in agent_names if name not in (NEAREST, NEAREST_VIEW, *BOUNDS)]
    settings = {"protocol": "dungeons", "sensor": sensor, "scan": scan, **made_by(agents=registered)}
    if (out / _STORE).is_file() and (out / _STORE).read_bytes()[:1] == b"{":
        raise BadInput(f"{out / _STORE} is of an earlier version; remove it, or choose another --out")
    keep_settings(out, settings, [_STORE, _CSV, _SUMMARY])
    files = {digests[path]: path for path in paths}
    asked = [(path, (name, digests[path], scan, sensor)) for path in paths for name in dict.fromkeys(agent_names)]
    done = resume(out / _STORE, [job for _, job in asked], partial(_run, files), workers=workers, what="episodes")
    stems = Counter(path.stem for path in paths)
    rows = [
        # 1.png and 1.PNG are two maps.
        done[job] | {"map": path.stem if stems[path.stem] == 1 else path.name, "layout": layouts[path]}
        for path, job in asked
    ]
    summary = {"settings": settings, "published": PUBLISHED, "agents": summarise(rows)}
    shown = [{name: row[name] for name in _COLUMNS} for row in rows]
    atomic_write(out / _CSV, csv_table(shown, _COLUMNS, digits=6))
    write_json(out / _SUMMARY, summary)
    return summary


def summarise(rows: Sequence[Row]) -> dict[str, Row]:
    """Return one summary per agent: paths and hops of the maps that it covered, of the others how many there are.

    Who gave a map up has a short path. Ratios are of the mean paths over the maps that both have covered; their
    intervals resample layouts: a map turned or mirrored, or moved by less than a tile, is no new one.
    """
    by_agent: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_agent.setdefault(row["agent"], {})[row["map"]] = row
    out: dict[str, Row] = {}
    for agent, own in by_agent.items():
        covered = [row for row in own.values() if row["end"] == "covered"]
        paths = [row["path_m"] for row in covered]
        decisions = [row["decision_ms_median"] for row in own.values() if row["decision_ms_median"] is not None]
        out[agent] = {
            "maps": len(own),
            "layouts": len({row["layout"] for row in own.values()}),
            "covered": len(covered),
            "path_m_mean": _mean(paths),
            "path_m_std": statistics.stdev(paths) if len(paths) > 1 else None,
            "coverage_mean": statistics.fmean(row["coverage"] for row in own.values()),
            "coverage_least": min(row["coverage"] for row in own.values()),
            "hops_mean": _mean([row["hops"] for row in covered]),
            "path_to_250_m_mean": _mean([row["path_to_250_m"] for row in own.values()]),
            "decision_ms_median": statistics.median(decisions) if decisions else None,
        }
        if BASELINE in by_agent:
            out[agent] |= _ratio(own, by_agent[BASELINE])
        out[agent]["to"] = {name: _ratio(own, by_agent[name]) for name in REFERENCES if name in by_agent}
    return out


def _mean(values: list[float | None]) -> float | None:
    reached = [value for value in values if value is not None]
    return statistics.fmean(reached) if reached and len(reached) == len(values) else None


def _ratio(own: dict[str, Row], other: dict[str, Row]) -> Row:
    """Return the ratio of the means and its 95 % interval, resampling layouts, both agents' paths together.

    Of a single layout there is no interval.
    """
    sums: dict[str, list[float]] = {}  # layout → both agents' paths, over its maps
    for name in sorted(own.keys() & other.keys()):
        if any(row["end"] != "covered" for row in (own[name], other[name])):
            continue
        both = sums.setdefault(own[name]["layout"], [0.0, 0.0])
        both[0] += own[name]["path_m"]
        both[1] += other[name]["path_m"]
    ours, base = np.array(list(sums.values())).reshape(-1, 2).T
    if base.sum() == 0:
        return {"ratio": None, "ratio_low": None, "ratio_high": None}
    if len(base) < 2:
        return {"ratio": float(ours.sum() / base.sum()), "ratio_low": None, "ratio_high": None}
    picks = np.random.default_rng(0).integers(0, len(ours), (_RESAMPLES, len(ours)))
    below = base[picks].sum(axis=1)
    ratios = ours[picks].sum(axis=1) / np.where(below > 0, below, math.nan)
    low, high = np.nanquantile(ratios, (0.025, 0.975))
    return {"ratio": float(ours.sum() / base.sum()), "ratio_low": float(low), "ratio_high": float(high)}


def table(summary: dict[str, Any]) -> str:
    """Return our agents and the published ones as one Markdown table."""
    references = [name for name in REFERENCES if name in summary["agents"]]
    head = [
        "agent", "maps (layouts)", "covered", "path of these, mean ± std [m]", f"to {BASELINE} (95 %)",
        *(f"to {name} (95 %)" for name in references), "decision [ms]",
    ]  # fmt: skip
    rows = []
    for name, own in summary["agents"].items():
        rows.append([
            f"`{name}`", f"{own['maps']} ({own['layouts']})", str(own["covered"]),
            _path_text(own),
            _ratio_text(own), *(_ratio_text(own["to"][name]) for name in references),
            number(own["decision_ms_median"], 1, ""),
        ])  # fmt: skip
    base, bound = PUBLISHED["nearest frontier"][0], PUBLISHED["known map"][0]
    for name, (mean, std) in PUBLISHED.items():
        ratios = [f"{mean / base:.3f}", *(f"{mean / bound:.3f}" if r in BOUNDS else "" for r in references)]
        rows.append([f"published: {name}", "100 others", "", f"{mean:.0f} ± {std:.0f}", *ratios, ""])
    return markdown_table(head, rows)


def _path_text(own: Row) -> str:
    std = "" if own["path_m_std"] is None else f" ± {own['path_m_std']:.0f}"
    return number(own["path_m_mean"], 0) + std


def _ratio_text(ratio: Row) -> str:
    if ratio.get("ratio") is None:
        return ""
    if ratio["ratio_low"] is None:
        return f"{ratio['ratio']:.3f}"
    return f"{ratio['ratio']:.3f} ({ratio['ratio_low']:.3f}–{ratio['ratio_high']:.3f})"


def _maps(folder: Path) -> list[Path]:
    """Return the maps of a folder, by number where their names are numbers."""
    if not folder.is_dir():
        raise BadInput(f"--maps {folder} is no folder; give the one that holds the PNG maps")
    paths = [path for path in folder.iterdir() if path.suffix.lower() == ".png" and path.is_file()]
    if not paths:
        raise BadInput(f"--maps {folder} holds no PNG maps; give the folder that does")
    # Decimal digits alone: to isdigit() a superscript is one, too, of which int() makes nothing.
    return sorted(paths, key=lambda p: (not p.stem.isdecimal(), int(p.stem) if p.stem.isdecimal() else 0, p.name))


def _run(files: Mapping[str, Path], job: _Job) -> Row:
    agent, digest, scan, sensor = job
    dungeon = load(files[digest])
    return _bound(dungeon, agent, sensor) if agent in BOUNDS else explore(dungeon, agent, scan=scan, sensor=sensor)


def _bound(dungeon: Dungeon, name: str, sensor: str) -> Row:
    return dict.fromkeys(_COLUMNS) | {
        "agent": name,
        "map": dungeon.name,
        "path_m": BOUNDS[name](dungeon, sensor),
        "coverage": 1.0,
        "unseen_cells": 0,
        "end": "covered",
    }
