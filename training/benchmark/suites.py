"""Benchmark suites: which rooms, with which noise, under which seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from mecanum_env.rooms import load
from mecanum_env.rooms.files.image_files import IMAGE_SUFFIXES
from mecanum_env.rooms.files.importers import MAP_SUFFIXES, image_of
from mecanum_env.team.config import TeamConfig
from slam.settings import unknown_name
from training.episodes.team import read_team
from training.runs.errors import BadInput, bad_input
from training.runs.provenance import short_digest
from training.runs.typed import parts_of, whole_numbers

__all__ = [
    "FLOOR_PLANS", "NOMINAL", "SLIPPERY", "SPLITS", "Place", "Suite", "choose", "names", "read_floor_plans",
    "teams_of",
]  # fmt: skip

SPLITS: dict[str, range] = {
    "train": range(0, 1000),
    "validation": range(1000, 1050),
    "test": range(10000, 10050),
}
"""Seeds that are fixed and disjoint: what was tuned on one split is judged on another."""

FLOOR_PLANS = "floor-plans"
"""The suite of the plans in ``--floor-plans DIR``."""

NOMINAL = "nominal"
"""The noise of the suites that are not slippery, where neither a robot nor a configuration says another."""

SLIPPERY = "-slippery"
"""What the names of the suites with the slippery noise end in."""

_SEEDS_A_PLAN = 5  # a real plan is large, and the same in every episode: a few starts and noises do
_ROOMS = {
    "rooms": "rectangular",
    "apartments": "apartment",
    "corridors": "corridors",
    "caves": "cave",
    "mazes": "maze",
}


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where an episode happens: rooms that a generator draws by the seed, or a plan read from a file."""

    name: str  # the generator's, or the plan's file name: the stratum that statistics resample within
    rooms: str | None = None
    floor_plan: Path | None = None
    digest: str = ""  # of the plan that was read


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Places that are judged together, under one noise."""

    name: str
    noise: str  # of NOISE_PRESETS
    places: tuple[Place, ...]

    def seeds(self, split: str) -> Sequence[int]:
        """Return the seeds of a split: all of them for generated rooms, the first few for each real plan."""
        every = SPLITS[split]
        return every if self.places[0].rooms is not None else every[:_SEEDS_A_PLAN]


def names(*, floor_plans: bool = False) -> tuple[str, ...]:
    """Return the suites' names, each nominal before slippery; those of real plans only where there are some."""
    bases = (*_ROOMS, FLOOR_PLANS) if floor_plans else _ROOMS
    return tuple(base + noise for base in bases for noise in ("", SLIPPERY))


def choose(text: str, *, floor_plans: Path | None = None) -> tuple[Suite, ...]:
    """Return the suites of ``a,b`` or ``all``, each once, in that order; of real plans with their folder.

    Raises
    ------
    ValueError
        For an unknown name; the message lists the valid ones.
    BadInput
        For a folder that cannot be used.
    """
    valid = names(floor_plans=floor_plans is not None)
    wanted = list(valid) if text.strip() == "all" else parts_of(text)
    for name in wanted:
        if name not in valid and name in names(floor_plans=True):
            raise BadInput(f"--suite {name} needs the folder of the plans; give --floor-plans DIR")
        if name not in valid:
            if name == "all":
                raise BadInput("--suite all stands for every suite; give it alone")
            raise unknown_name("suite", name, (*valid, "all"))
    if floor_plans is not None and not set(wanted) - set(names()):
        raise BadInput(f"--floor-plans belongs to the suite {FLOOR_PLANS}; add it to --suite, or leave it out")
    plans = read_floor_plans(floor_plans) if floor_plans is not None else ()
    return tuple(_make(name, plans) for name in wanted)


def read_floor_plans(folder: Path) -> tuple[Place, ...]:
    """Return the plans in a folder, by name: every ROS map, and every image that is none's.

    Raises
    ------
    BadInput
        Where the folder is missing or holds no plan, or a plan is damaged.
    """
    if not folder.is_dir():
        raise BadInput(f"--floor-plans {folder} is no folder; give one that holds ROS maps (.yaml) or images")
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    maps = [path for path in files if path.suffix.lower() in MAP_SUFFIXES]
    with bad_input():
        drawn = {image_of(path).resolve() for path in maps}
    images = [p for p in files if p.suffix.lower() in IMAGE_SUFFIXES and p.resolve() not in drawn]
    if not maps and not images:
        raise BadInput(
            f"--floor-plans {folder} holds no plan; put ROS maps (.yaml) or images "
            f"({', '.join(IMAGE_SUFFIXES)}) there"
        )
    with bad_input():
        return tuple(_read(path.absolute()) for path in sorted([*maps, *images], key=lambda path: path.name))


def _read(path: Path) -> Place:
    plan = load(path)
    digest = short_digest(np.ascontiguousarray(a).tobytes() for a in (plan.segments, plan.circles))
    return Place(name=path.name, floor_plan=path, digest=digest)


def _make(name: str, plans: tuple[Place, ...]) -> Suite:
    base = name.removesuffix(SLIPPERY)
    noise = NOMINAL if base == name else "slippery"
    places = plans if base == FLOOR_PLANS else (Place(name=_ROOMS[base], rooms=_ROOMS[base]),)
    return Suite(name=name, noise=noise, places=places)


def teams_of(
    robots: str | None, *, config: Path | None = None, communication: str | None, range_m: float | None,
    starts: str | None, unknown_starts: bool,
) -> tuple[TeamConfig | None, ...]:  # fmt: skip
    """Return the teams of ``--robots 1,2,3`` and ``--communication range,none``; None is one robot alone.

    What no option says, a config file's [run.team] does.
    """
    read = partial(read_team, config, range_m=range_m, starts=starts, unknown_starts=unknown_starts)
    counts: list[int | None] = [None] if robots is None else [*whole_numbers("--robots", robots, low=1, high=64)]
    words = [None] if communication is None else parts_of(communication)
    several = [count for count in counts if count != 1] or counts  # one alone refuses what is for several
    teams = [read(robots=count, communication=word) for count in several for word in words]
    found = [None if team.robots == 1 else team for team in teams]
    return (None, *found) if 1 in counts and several != counts else tuple(found)
