"""Lessons for the learned tour: what it cost, in the end, to begin a tour otherwise.

On plans that the benchmark has not (:mod:`training.dungeons.plans`) an episode is driven, now and then by a hop
drawn at random. At some of its stops every opening is tried out: from there the first hop is made, and the driver
goes on to the end, on the true plan. How much longer one opening made the path than another is the lesson;
averaged over many plans it is what a robot that does not know the plan may expect. The driver is first the tour
over what is known, then what was learned from its lessons (policy iteration with rollouts: Bertsekas, "Rollout
algorithms", 1997).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.learned.station_network import SIDE, Picture, picture
from slam.formats import replacing
from slam.grids.occupancy import FREE, OCCUPIED
from training.dungeons.plans import dungeon_plan
from training.dungeons.walks import MOST, MOST_HOPS, LearnedDriver, Stop, TourDriver, Walk
from training.dungeons.world import CELL_M
from training.runs.campaign import Workers, run_all

__all__ = ["Lessons", "gather", "lessons_of", "read_lessons"]

_AT_RANDOM = 0.1  # share of the hops that are drawn at random


@dataclass(frozen=True, eq=False)
class Lessons:
    """Stops ``(n,)``, and what became of the openings at each; those beyond the last are NaN in ``path_m``."""

    planes: NDArray[np.uint8]  # (n, 13, SIDE, SIDE) the picture × 100, but its last plane, which follows
    outside: NDArray[np.uint8]  # (n, 4, SIDE, SIDE) share of each quarter of a pixel beyond the plan × 100
    free: NDArray[np.uint8]  # (n, 4, SIDE, SIDE) free cells of the true plan in each quarter of a pixel
    targets: NDArray[np.int64]  # (n, MOST, 2) pixels
    hops: NDArray[np.int64]  # (n, MOST, 2) pixels
    losses_m: NDArray[np.float32]  # (n, MOST) by what was known
    legs_m: NDArray[np.float32]  # (n, MOST)
    path_m: NDArray[np.float32]  # (n, MOST) to the end


def lessons_of(seed: int, driver: TourDriver) -> Lessons | None:
    """Drive one episode on the plan of a seed, and return the lessons drawn on the way, if any were."""
    walk, rng = Walk(dungeon_plan(seed)), np.random.default_rng([driver.stream, seed])
    drawn: list[tuple[NDArray[Any], ...]] = []
    tried: list[list[Walk]] = []
    for _ in range(MOST_HOPS):
        stop = walk.stop()
        if stop is None:
            break
        choice = driver.choose([stop])[0]
        count = len(stop.openings.targets)
        if count > 1 and rng.random() < driver.asked:
            drawn.append(_lesson(stop))
            tried.append([walk.after(stop.hop_cell(k)) for k in range(count)])
        if rng.random() < _AT_RANDOM:
            choice = int(rng.integers(count))
        walk.hop(stop.hop_cell(choice))
    if not drawn:
        return None
    paths = np.full((len(tried), MOST), np.nan, dtype=np.float32)
    ends = iter(driver.finish([other for walks in tried for other in walks]))
    for k, walks in enumerate(tried):
        paths[k, : len(walks)] = [next(ends) for _ in walks]
    columns = [np.stack(column) for column in zip(*drawn, strict=True)]
    return Lessons(*columns, paths)  # type: ignore[call-arg]  # seven columns


def _lesson(stop: Stop) -> tuple[NDArray[Any], ...]:
    """Return the columns of a lesson, but for the last."""
    absent = MOST - len(stop.openings.targets)
    shown = stop.drawn()
    targets, hops = stop.places(shown)
    return (
        np.rint(100.0 * shown.planes[:-1]).astype(np.uint8),
        np.rint(100.0 * stop.beyond(shown)).astype(np.uint8),
        _true_share(stop, shown),
        np.pad(targets, ((0, absent), (0, 0))),
        np.pad(hops, ((0, absent), (0, 0))),
        np.pad(stop.openings.losses, (0, absent)).astype(np.float32),
        np.pad(stop.openings.legs, (0, absent)).astype(np.float32),
    )


def _true_share(stop: Stop, shown: Picture) -> NDArray[np.uint8]:
    """Return how many free cells of the plan lie in each quarter of each pixel ``(4, SIDE, SIDE)``."""
    plan = stop.walk.plan
    truth = np.where(plan.free, FREE, OCCUPIED).astype(np.int8)
    whole = picture(truth, stop.walk.visited, plan.start, CELL_M, stop.found)
    shift = shown.corner - whole.corner
    out = np.zeros((4, SIDE, SIDE), dtype=np.uint8)
    own = [slice(max(-s, 0), SIDE - max(s, 0)) for s in shift]
    theirs = [slice(max(s, 0), SIDE - max(-s, 0)) for s in shift]
    out[:, own[0], own[1]] = np.rint(25.0 * whole.planes[:4, theirs[0], theirs[1]])
    return out


# ---- on disk ---------------------------------------------------------------------------------------------------


def gather(folder: Path, seeds: range, *, policy: Path | None = None, workers: Workers = 1) -> None:
    """Write the lessons of each seed that the folder does not hold yet, a file a plan.

    ``policy`` holds the weights of the network that drives; the tour does where there is none.

    Raises
    ------
    Interrupted
        On Ctrl-C.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = [seed for seed in seeds if not _file(folder, seed).exists()]
    if jobs:
        # A worker need not see the folder.
        of_seed = functools.partial(_arrays, None if policy is None else policy.read_bytes())
        run_all(jobs, of_seed, workers=workers, keep=functools.partial(_write, folder), what="plans")


def read_lessons(*parts: tuple[Path, range]) -> Lessons:
    """Return the lessons of all seeds, one after the other, that :func:`gather` has written to folders."""
    found = []
    for folder, seeds in parts:
        for seed in seeds:
            with np.load(_file(folder, seed), allow_pickle=False) as file:
                found.append(dict(file))
    names = [f.name for f in fields(Lessons)]
    return Lessons(*(np.concatenate([part[name] for part in found if part]) for name in names))


def _file(folder: Path, seed: int) -> Path:
    return folder / f"{seed:06d}.npz"


@functools.lru_cache(maxsize=1)
def _driver(policy: bytes | None) -> TourDriver:
    return TourDriver() if policy is None else LearnedDriver.read(policy)


def _arrays(policy: bytes | None, seed: int) -> dict[str, NDArray[Any]]:
    lessons = lessons_of(seed, _driver(policy))
    return {} if lessons is None else vars(lessons)


def _write(folder: Path, seed: int, arrays: dict[str, NDArray[Any]]) -> None:
    with replacing(_file(folder, seed)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
