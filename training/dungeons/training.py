"""Training of ``learned-tour``: lessons on plans like the benchmark's, and a network that foresees them.

``mecanum study learned-tour --out DIR`` gathers lessons (plans of seeds 0 …, validated on others from
1000 on) in ``DIR/round-1``, driven by the tour, and trains. In the next round what was learned drives, and the
network is trained anew on the lessons of both. It writes ``learned-tour.safetensors`` and ``.json``. A killed run
goes on where it stopped: with the next plan, or after the last whole epoch.
"""

from __future__ import annotations

import math
import shlex
import statistics
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor, nn

from agents.learned.choice_network import joined
from agents.learned.policy_files import write_policy
from agents.learned.station_network import PLANES, opening_numbers, with_walls
from agents.learned_tour import FORMAT, load_station_policy
from slam.formats import replacing
from slam.settings import Config, Few, NotNegative, Seed, Share, Within
from slam.types import Floats
from training.dungeons.episode import explore
from training.dungeons.lessons import Lessons, gather, read_lessons
from training.dungeons.networks import StationNetwork, read_network
from training.dungeons.plans import dungeon_plan
from training.runs import options as opt
from training.runs.campaign import Workers, keep_settings, made_by
from training.runs.errors import bad_input

__all__ = ["Batch", "TrainingConfig", "batch_of", "regret_m", "study", "train", "turned"]


_CHECKPOINT, _WEIGHTS = "checkpoint-{}.pt", "learned-tour.safetensors"
_SCORE_M = 20.0
_VALIDATION = 1000  # seed of the first plan that is validated on


@dataclass(frozen=True, kw_only=True)
class TrainingConfig(Config):
    """What a training depends on."""

    rounds: Few = 2  # of lessons, each driven by what was learned in the one before
    plans: Annotated[int, Within("[1, 1000000]")] = 1000  # seeds 0 … of the first round
    # Seeds 0 … of the others: a network takes more time to drive than the tour.
    later_plans: Annotated[int, Within("[1, 1000000]")] = 380
    validation_plans: Annotated[int, Within("[1, 9000]")] = 60  # seeds 1000 …
    epochs: Annotated[int, Within("[1, 1000000]")] = 12
    batch: Annotated[int, Within("[1, 1000000]")] = 64
    rate: Annotated[float, Within("[1e-9, 1]")] = 1.5e-3
    weight_decay: Share = 1e-2
    untold: Share = 0.125  # share of the lessons that do not tell how far the plan extends
    free_weight: NotNegative = 0.3  # of foreseeing what is free, besides what openings cost
    members: Few = 1  # networks that are trained apart on the same lessons, and asked together
    trust: NotNegative = 0.4  # more of what an opening loses by the tour's own count than was learned
    start: str = ""  # policy whose weights the first network begins with; none: drawn at random
    seed: Seed = 0


@dataclass(frozen=True, eq=False)
class Batch:
    """Lessons as the network takes them, and what it should say."""

    planes: Floats  # (b, PLANES, n, n)
    free: Floats  # (b, 4, n, n) share of each quarter that is free
    targets: NDArray[np.int64]  # (b, c, 2) pixels
    hops: NDArray[np.int64]  # (b, c, 2) pixels
    numbers: Floats  # (b, c, 3)
    paths: Floats  # (b, c) to the end, 20 m a unit, less the mean over the openings; 0 where there is none
    there: Floats  # (b, c) 1 where there is an opening


def batch_of(lessons: Lessons, rows: NDArray[np.int64], told: NDArray[np.bool_] | None = None) -> Batch:
    """Return some of the lessons as a batch, with walls beyond the plan where ``told`` (everywhere by default)."""
    planes = lessons.planes[rows].astype(np.float32) * np.float32(0.01)
    beyond = lessons.outside[rows].astype(np.float32) * np.float32(0.01)
    if told is not None:
        beyond *= told[:, None, None, None]
    paths = lessons.path_m[rows]
    there = np.isfinite(paths)
    mean = np.nanmean(paths, axis=1, keepdims=True)
    return Batch(
        with_walls(np.pad(planes, ((0, 0), (0, 1), (0, 0), (0, 0))), beyond),
        lessons.free[rows].astype(np.float32) / np.float32(25.0),
        lessons.targets[rows],
        lessons.hops[rows],
        opening_numbers(lessons.losses_m[rows], lessons.legs_m[rows]),
        np.where(there, (paths - mean) / _SCORE_M, 0.0).astype(np.float32),
        there.astype(np.float32),
    )


def turned(batch: Batch, quarters: int, mirrored: bool) -> Batch:
    """Return the batch with its pictures turned by quarters of a circle, and mirrored after that."""

    def change(x: NDArray[Any]) -> NDArray[Any]:
        x = np.rot90(x, quarters, axes=(-2, -1))
        return np.ascontiguousarray(x[..., ::-1] if mirrored else x)

    side = batch.planes.shape[-1]
    order = change(np.arange(4).reshape(2, 2)).ravel()  # of the quarters of a pixel
    planes = np.concatenate([order, order + 4, np.arange(8, PLANES)])
    place = np.argsort(change(np.arange(side * side).reshape(side, side)).ravel())  # where each pixel comes to lie
    targets, hops = (
        np.stack(np.divmod(place[at[..., 0] * side + at[..., 1]], side), axis=-1)
        for at in (batch.targets, batch.hops)
    )
    moved = {"planes": change(batch.planes[:, planes]), "free": change(batch.free[:, order])}
    return replace(batch, **moved, targets=targets, hops=hops)


# ---- training --------------------------------------------------------------------------------------------------


def _centred(scores: Tensor, there: Tensor) -> Tensor:
    return (scores - (scores * there).sum(1, keepdim=True) / there.sum(1, keepdim=True)) * there


def _asked(network: StationNetwork, planes: Tensor, batch: Batch) -> tuple[Tensor, Tensor]:
    said: tuple[Tensor, Tensor] = network(
        planes, torch.tensor(batch.targets), torch.tensor(batch.hops), torch.tensor(batch.numbers)
    )
    return said


def _losses(network: StationNetwork, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return how far off the costs of openings are, and what is free where nothing is known yet."""
    there, free = torch.tensor(batch.there), torch.tensor(batch.free)
    planes = torch.tensor(batch.planes).contiguous(memory_format=torch.channels_last)
    with torch.autocast("cpu", torch.bfloat16):
        scores, odds = _asked(network, planes, batch)
    scores, odds = scores.float(), odds.float()
    off = nn.functional.smooth_l1_loss(_centred(scores, there), torch.tensor(batch.paths), reduction="sum")
    unknown = (planes[:, -1:] > 0.5).float()
    dark = nn.functional.binary_cross_entropy_with_logits(odds, free, reduction="none")
    return off / there.sum(), (dark * unknown).sum() / (4.0 * unknown.sum()).clamp(min=1.0)


def regret_m(network: StationNetwork, lessons: Lessons) -> tuple[float, float]:
    """Return by how much the openings that it takes made paths longer than the tour's own [m], and the error."""
    picked = []
    with torch.no_grad():
        for begin in range(0, len(lessons.planes), 256):
            rows = np.arange(begin, min(begin + 256, len(lessons.planes)))
            batch = batch_of(lessons, rows)
            scores, _ = _asked(network, torch.tensor(batch.planes), batch)
            choice = np.where(batch.there > 0, scores.numpy(), np.inf).argmin(axis=1)
            picked.append(lessons.path_m[rows, choice] - lessons.path_m[rows, 0])
    longer = np.concatenate(picked)
    return float(longer.mean()), float(longer.std() / math.sqrt(len(longer)))


def train(
    out: Path, config: TrainingConfig, number: int = 1, member: int = 0
) -> tuple[StationNetwork, list[dict[str, float]]]:
    """Train a network on the lessons of all rounds up to one; return it and its curve.

    A run that was broken off goes on from its last whole epoch. What is validated on is the last round's.
    """
    rounds = range(1, number + 1)
    lessons = read_lessons(*((_round(out, k) / "lessons", _seeds(config, k)) for k in rounds))
    out = _round(out, number)
    unseen = read_lessons((out / "lessons", _unseen(config)))
    seed, checkpoint = config.seed + member, out / _CHECKPOINT.format(member)
    torch.manual_seed(seed)
    network = StationNetwork()
    if config.start and number == 1 and member == 0:
        network = read_network(Path(config.start).read_bytes())
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.rate, weight_decay=config.weight_decay)
    curve = _resume(checkpoint, network, optimiser)
    batches = max(1, len(lessons.planes) // config.batch)  # of few lessons one, of them all
    for epoch in range(len(curve), config.epochs):
        begun = time.monotonic()
        # Drawn anew from the epoch's number: a run that goes on draws what it would have drawn.
        rng = np.random.default_rng([seed, epoch])
        order = rng.permutation(len(lessons.planes))
        sums = np.zeros(2)
        for k in range(batches):
            rows = order[k * config.batch : (k + 1) * config.batch]
            told = rng.random(len(rows)) >= config.untold
            batch = turned(batch_of(lessons, rows, told), int(rng.integers(4)), bool(rng.integers(2)))
            share = (epoch * batches + k) / (config.epochs * batches)
            for group in optimiser.param_groups:
                group["lr"] = config.rate * _rate_at(share)
            cost, dark = _losses(network, batch)
            optimiser.zero_grad()
            (cost + config.free_weight * dark).backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            sums += cost.item(), dark.item()
        regret, error = regret_m(network, unseen)
        point = {
            "epoch": epoch + 1, "cost": float(sums[0]) / batches, "free": float(sums[1]) / batches,
            "validation_regret_m": regret, "validation_regret_se_m": error, "wall_s": time.monotonic() - begun,
        }  # fmt: skip
        curve.append({key: round(value, 5) for key, value in point.items()})
        _keep(checkpoint, network, optimiser, curve)
        print(", ".join(f"{key} {value}" for key, value in curve[-1].items()), file=sys.stderr, flush=True)
    return network, curve


def _round(out: Path, number: int) -> Path:
    return out / f"round-{number}"


def _seeds(config: TrainingConfig, number: int) -> range:
    return range(config.plans if number == 1 else config.later_plans)


def _unseen(config: TrainingConfig) -> range:
    return range(_VALIDATION, _VALIDATION + config.validation_plans)


def _rate_at(share: float) -> float:
    """Return the learning rate's share: up over the first seventh, then down along a cosine."""
    warm = 1.0 / 7.0
    if share < warm:
        return 0.04 + 0.96 * share / warm
    return 0.5 + 0.5 * math.cos(math.pi * (share - warm) / (1.0 - warm))


def _keep(path: Path, network: nn.Module, optimiser: torch.optim.Optimizer, curve: list[dict[str, float]]) -> None:
    with replacing(path) as temporary:
        torch.save([network.state_dict(), optimiser.state_dict(), curve], temporary)


def _resume(path: Path, network: nn.Module, optimiser: torch.optim.Optimizer) -> list[dict[str, float]]:
    if not path.exists():
        return []
    weights, state, curve = torch.load(path, weights_only=True)
    network.load_state_dict(weights)
    optimiser.load_state_dict(state)
    return list(curve)


# ---- the command -----------------------------------------------------------------------------------------------


def study(
    out: Annotated[Path, typer.Option(help="Folder of the run.")],
    rounds: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Of lessons, each driven by what was learned before.")
    ] = 2,
    plans: Annotated[int, typer.Option(min=1, max=_VALIDATION, help="Of the first round, seeds 0 ….")] = 1000,
    later_plans: Annotated[int, typer.Option(min=1, max=_VALIDATION, help="Of the others, seeds 0 ….")] = 380,
    validation_plans: Annotated[int, typer.Option(min=1, max=9_000, help=f"Seeds {_VALIDATION} ….")] = 60,
    epochs: Annotated[int, typer.Option(min=1, max=1_000_000)] = 12,
    batch: Annotated[int, typer.Option(min=1, max=1_000_000)] = 64,
    rate: Annotated[float, typer.Option(min=1e-9, max=1, help="Of learning.")] = 1.5e-3,
    weight_decay: Annotated[float, typer.Option(min=0, max=1)] = 1e-2,
    untold: Annotated[
        float, typer.Option(min=0, max=1, help="Share of lessons that do not tell how far the plan extends.")
    ] = 0.125,
    free_weight: Annotated[float, typer.Option(min=0, max=1e6, help="Of foreseeing what is free.")] = 0.3,
    members: Annotated[int, typer.Option(min=1, max=1000, help="Networks that are asked together.")] = 1,
    trust: Annotated[
        float, typer.Option(min=0, max=1e6, help="In the tour's own count, over what was learned of it.")
    ] = 0.4,
    start: Annotated[
        str, typer.Option(metavar="FILE", help="Policy (.safetensors) whose weights the network begins with.")
    ] = "",
    seed: opt.Seed = 0,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes that gather lessons.")] = 1,
    ray: opt.Ray = None,
) -> None:
    """Train learned-tour: lessons on plans like the benchmark's, and a network that foresees them."""
    if start:
        with bad_input():
            load_station_policy(Path(start))
    config = TrainingConfig(
        rounds=rounds, plans=plans, later_plans=later_plans, validation_plans=validation_plans, epochs=epochs,
        batch=batch, rate=rate, weight_decay=weight_decay, untold=untold, free_weight=free_weight, members=members,
        trust=trust, start=start, seed=seed,
    )  # fmt: skip
    run(out, config, workers=opt.workers_of(workers, ray))
    print(out / _WEIGHTS)


def run(out: Path, config: TrainingConfig, *, workers: Workers) -> None:
    """Gather lessons, train and write the policy."""
    settings = {"training": "learned-tour", **asdict(config), **made_by(config.start)}
    keep_settings(out, settings, [_WEIGHTS])
    policy: Path | None = None
    curves = []
    for number in range(1, config.rounds + 1):
        folder = _round(out, number)
        for seeds in (_seeds(config, number), _unseen(config)):
            gather(folder / "lessons", seeds, policy=policy, workers=workers)
        trained = [train(out, config, number, member) for member in range(config.members)]
        curves += [curve for _, curve in trained]
        weights = [_kept(network, config.trust) for network, _ in trained]
        policy, about = folder / _WEIGHTS, _about(config, curves)
        write_policy(policy, weights[0], about)  # drives the next round
    write_policy(out / _WEIGHTS, joined(weights), about)
    # What counts is whole episodes: what a single choice gains, as lessons have it, says little of them.
    plans = [dungeon_plan(seed) for seed in _unseen(config)]
    about["validation_path_m"] = {
        name: round(statistics.fmean(float(explore(plan, agent)["path_m"]) for plan in plans), 2)
        for name, agent in (("tour", "tour"), ("learned-tour", str(out / _WEIGHTS)))
    }
    write_policy(out / _WEIGHTS, joined(weights), about)


def _kept(network: StationNetwork, trust: float) -> dict[str, NDArray[Any]]:
    """Return the weights that are needed to choose, more of the tour's own count in them."""
    weights = {name: v.numpy() for name, v in network.state_dict().items() if not name.startswith("free.")}
    return weights | {"loss_share": weights["loss_share"] + trust}


def _about(config: TrainingConfig, curves: list[list[dict[str, float]]]) -> dict[str, Any]:
    arguments = [f"--{name.replace('_', '-')}={value}" for name, value in asdict(config).items()]
    return {
        "format": FORMAT,
        "command": shlex.join(["mecanum", "study", "learned-tour", "--out", "OUT", *arguments]),
        "config": asdict(config),
        "seeds": f"plans 0-{config.plans - 1}; validation {_VALIDATION}-{_unseen(config)[-1]}",
        "curves": curves,
    }
