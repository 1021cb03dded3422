"""Paper B's claims as plots (theory.md B, points 1, 2 and 6), in the circle world.

``mecanum study paper-b --out DIR`` follows one run of the EKFs, with the start uncertain by 10 cm,
and one of each FastSLAM, and writes ``paper_b.png`` and ``paper_b.json``. What the figures mean:
``docs/studies/paper-b.md``.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.axes import Axes

import slam
from slam.backend import Backend
from slam.formats import atomic_write
from slam.types import Array
from training.figures.charts import COLOURS, chart, label, png
from training.runs.errors import BadInput, check_writable
from training.runs.options import Out, Seed
from training.runs.running import write_json
from training.studies.circle_world import WORLDS, LandmarkWorld, drive

__all__ = ["floor_of", "follow_filter", "follow_particles", "paper_b", "study"]

_START_SIGMA_M = 0.1  # a start known exactly would leave landmarks no floor but zero
_UNCERTAIN_HEADING = math.radians(2.0)
_PARTICLE_BACKENDS = ("fastslam1", "fastslam2")
_SMOOTHED = 25  # steps that N_eff is averaged over in the chart
_FILES = ("paper_b.png", "paper_b.json")


# ---- claims 1 and 2: the joint Gaussian ------------------------------------------------------------------------


def follow_filter(backend: Backend, world: LandmarkWorld, *, seed: int, steps: int) -> dict[str, Array]:
    """Drive once; return how the map's covariance goes, from the step in which every landmark is in it.

    Returns
    -------
    dict
        ``step`` ``(k,)``; ``log_det`` of the map ``(k,)``; ``pair_log_det`` of every pair of landmarks
        ``(k, pairs)``; ``sigma`` of each landmark ``(k, n)`` [m], root of half the trace, by the landmarks' order
        in the world; ``correlation`` of the pairs, the mean over x and y ``(k, pairs)``; ``distance_sigma`` of
        the pairs' distances ``(k, pairs)`` [m].
    """
    n = len(world.landmarks)
    first, second = np.triu_indices(n, 1)
    rows: dict[str, list[Any]] = {name: [] for name in _ROWS}
    for k, _ in enumerate(drive(world, backend, seed, steps), start=1):
        if backend.landmark_count < n:
            continue
        belief = backend.belief
        order = np.argsort(belief.landmark_ids)
        index = (3 + 2 * order[:, None] + np.arange(2)).ravel()
        assert belief.joint_cov is not None
        cov = belief.joint_cov[np.ix_(index, index)]  # (2n, 2n)
        blocks = cov.reshape(n, 2, n, 2).transpose(0, 2, 1, 3)  # (n, n, 2, 2)
        cross = blocks[first, second]
        top = np.concatenate([blocks[first, first], cross], axis=2)
        bottom = np.concatenate([cross.transpose(0, 2, 1), blocks[second, second]], axis=2)
        variances = np.diagonal(blocks[np.arange(n), np.arange(n)], axis1=1, axis2=2)  # (n, 2)
        scale = np.sqrt(variances[first] * variances[second])
        points = belief.landmarks[order]
        along = points[first] - points[second]
        along /= np.hypot(along[:, 0], along[:, 1])[:, None]
        between = blocks[first, first] + blocks[second, second] - cross - cross.transpose(0, 2, 1)
        rows["step"].append(k)
        rows["log_det"].append(np.linalg.slogdet(cov)[1])
        rows["pair_log_det"].append(np.linalg.slogdet(np.concatenate([top, bottom], axis=1))[1])
        rows["sigma"].append(np.sqrt(0.5 * variances.sum(axis=1)))
        rows["correlation"].append((np.diagonal(cross, axis1=1, axis2=2) / scale).mean(axis=1))
        rows["distance_sigma"].append(np.sqrt(np.einsum("ni,nij,nj->n", along, between, along)))
    if not rows["step"]:
        raise BadInput(f"--steps {steps} are too few for the robot to see every landmark; give 200 or more")
    return {name: np.array(values, np.float64) for name, values in rows.items()}


_ROWS = ("step", "log_det", "pair_log_det", "sigma", "correlation", "distance_sigma")


def floor_of(world: LandmarkWorld) -> Array:
    """Return the σ ``(n,)`` [m] that no landmark can fall below: that of the frame in which it is mapped.

    A landmark seen without noise at the start would have the covariance G P₀ Gᵀ, G = [I, J (m − p₀)].
    """
    away = world.landmarks - world.path(0)[0][:2]
    heading = world.start_sigma_rad**2 * np.sum(away**2, axis=1)
    return np.asarray(np.sqrt(world.start_sigma_m**2 + 0.5 * heading))


def _figures(rows: dict[str, Array], world: LandmarkWorld) -> dict[str, float]:
    """Return what the claims come down to in numbers."""
    floor = floor_of(world)
    return {
        "steps_with_all_landmarks": len(rows["step"]),
        "log_det_first": float(rows["log_det"][0]),
        "log_det_last": float(rows["log_det"][-1]),
        "log_det_largest_increase": _largest_increase(rows["log_det"]),
        "pair_log_det_largest_increase": _largest_increase(rows["pair_log_det"]),
        "landmark_sigma_over_floor_first_max": float((rows["sigma"][0] / floor).max()),
        "landmark_sigma_over_floor_last_max": float((rows["sigma"][-1] / floor).max()),
        "landmark_sigma_over_floor_last_min": float((rows["sigma"][-1] / floor).min()),
        "correlation_first_min": float(rows["correlation"][0].min()),
        "correlation_last_min": float(rows["correlation"][-1].min()),
        "distance_sigma_last_median_m": float(np.median(rows["distance_sigma"][-1])),
        "landmark_sigma_last_median_m": float(np.median(rows["sigma"][-1])),
    }


def _largest_increase(values: Array) -> float:
    """Return the largest rise from one step to the next ``(k, …)``; negative: everything fell at every step."""
    return float(np.diff(values, axis=0).max()) if len(values) > 1 else 0.0


# ---- claim 6: particles ----------------------------------------------------------------------------------------


def follow_particles(backend: Backend, world: LandmarkWorld, *, seed: int, steps: int) -> dict[str, Array]:
    """Drive once; return N_eff and the number of surviving ancestors at each step ``(steps,)``."""
    rows = [
        (float(getattr(backend, "n_eff", math.nan)), float(getattr(backend, "ancestors", math.nan)))
        for _ in drive(world, backend, seed, steps)
    ]
    n_eff, ancestors = np.array(rows).T
    return {"n_eff": n_eff, "ancestors": ancestors}


def _particle_figures(rows: dict[str, Array]) -> dict[str, float | int | None]:
    one = np.flatnonzero(rows["ancestors"] <= 1)
    return {
        "n_eff_mean": float(rows["n_eff"].mean()),
        "n_eff_min": float(rows["n_eff"].min()),
        "ancestors_last": float(rows["ancestors"][-1]),
        "steps_until_one_ancestor": int(one[0]) + 1 if len(one) else None,
    }


# ---- all of it -------------------------------------------------------------------------------------------------


def paper_b(out: Path, *, seed: int = 0, steps: int | None = None) -> dict[str, Any]:
    """Follow every filter, write the chart and ``paper_b.json``, and return the latter's contents."""
    check_writable(out, _FILES)
    circle = WORLDS["circle"]
    steps = circle.steps if steps is None else steps
    world = dataclasses.replace(circle, start_sigma_m=_START_SIGMA_M)
    turned = dataclasses.replace(world, start_sigma_rad=_UNCERTAIN_HEADING)
    result: dict[str, Any] = {"steps": steps, "seed": seed, "start_sigma_m": _START_SIGMA_M}
    rows = follow_filter(_make("ekf", world), world, seed=seed, steps=steps)
    result["ekf"] = _figures(rows, world)
    for name in ("ekf", "invariant-ekf"):
        followed = follow_filter(_make(name, turned), turned, seed=seed, steps=steps)
        result[f"{name}, heading uncertain by 2°"] = _figures(followed, turned)
    particles = {}
    for name in _PARTICLE_BACKENDS:
        particles[name] = follow_particles(_make(name, circle), circle, seed=seed, steps=steps)
        result[name] = _particle_figures(particles[name])
    figure, panels = chart(2, 2, size=(1600, 900))
    _draw_filter(panels[:3], rows, world)
    _draw_particles(panels[3], particles)
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "paper_b.png", png(figure))
    write_json(out / "paper_b.json", result)
    return result


def _make(name: str, world: LandmarkWorld) -> Backend:
    return slam.make(name, config=world.backend_settings())


def _draw_filter(panels: Sequence[Axes], rows: dict[str, Array], world: LandmarkWorld) -> None:
    step, n = rows["step"], len(world.landmarks)
    # Pairs from the nearest neighbours on the ring to those across it.
    first, second = np.triu_indices(n, 1)
    chosen = [int(np.flatnonzero((first == 0) & (second == k))[0]) for k in (1, 2, 5, 10) if k < n]
    determinants, variances, correlations = panels
    determinants.plot(step, rows["log_det"] / (2 * n), label=f"map (per dimension, {2 * n})")
    for k in chosen:
        determinants.plot(step, rows["pair_log_det"][:, k] / 4, label=f"pair 0, {second[k]}")
        correlations.plot(step, 1.0 - rows["correlation"][:, k], label=f"pair 0, {second[k]}")
    variances.plot(step, rows["sigma"], color=COLOURS[0], linewidth=1)
    variances.axhline(floor_of(world).max(), color=COLOURS[1], label="floor: the start's 0.1 m")
    variances.set_ylim(bottom=0.0)
    label(determinants, "Determinants of the map and of pairs of landmarks fall", "step", "log det / dimension")
    label(variances, "Landmarks' σ falls to a floor", "step", "σ [m]")
    label(correlations, "Landmarks' correlation grows to 1", "step", "1 - correlation", log="y")


def _draw_particles(axes: Axes, particles: dict[str, dict[str, Array]]) -> None:
    for name, rows in particles.items():
        step = np.arange(1, len(rows["n_eff"]) + 1)
        few = min(_SMOOTHED, len(step))
        smooth = np.convolve(rows["n_eff"], np.full(few, 1.0 / few), mode="valid")
        axes.plot(step[few - 1 :], smooth, label=f"{name}: N_eff")
        axes.plot(step, rows["ancestors"], label=f"{name}: ancestors")
    label(axes, "Particles that count, and ancestors", "step", f"N_eff: mean of {_SMOOTHED} steps", log="y")


def study(
    out: Out = Path("out/paper_b"),
    seed: Seed = 0,
    steps: Annotated[int | None, typer.Option(min=1, max=1_000_000, help="Of the run.")] = None,
) -> None:
    """Repeat paper B's claims as plots, in the circle world."""
    print(json.dumps(paper_b(out, seed=seed, steps=steps), indent=1, ensure_ascii=False))
