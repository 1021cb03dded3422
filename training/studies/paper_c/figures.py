"""Paper C's figures (theory.md C): a filter by differential transforms, its cost, its use on board.

``mecanum study paper-c --out DIR`` writes ``figure_2.png`` (the covariance against a stiff
solver), ``figure_3.png`` (the estimate's error with exact initial conditions, and 10 % off), ``work.png``
(steps and multiplications against RK45 and matrix exponentials), ``odometry.png`` (the odometry of an accelerating
robot, filtered) and ``paper_c.json``. What they mean: ``docs/studies/paper-c.md``.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam.formats import atomic_write
from slam.odometry.differential_transform import MODELS, make_model
from slam.odometry.filters import OdometryFilterConfig
from slam.odometry.riccati import RECOVERIES, Tolerances
from slam.odometry.transform_filter import KalmanBucyFilter
from slam.types import Array
from training.figures.charts import COLOURS, INK, chart, label, png
from training.runs.campaign import Workers
from training.runs.errors import check_writable
from training.runs.options import Out, Ray, Seed, workers_of
from training.runs.running import versions, write_json
from training.studies.paper_c import odometry
from training.studies.paper_c.work import METHODS, Run, cheapest, measure, reference, relative_deviation

__all__ = ["covariances", "estimates", "run_of", "study"]

_FILES = ("figure_2.png", "figure_3.png", "work.png", "odometry.png", "paper_c.json")
_T0, _T1 = 1.0, 11.0  # [s]
_SPEED_M_S, _ACCELERATION_M_S2 = 1.0, 0.5  # x = v t + a t²/2
_MEASUREMENT = 1e-4  # R [m² s]: samples of σ = 0.1 m every 10 ms
_PROCESS = 1e-2  # Q [m²/s³], of wiener_acceleration [m²/s⁵]
_OFF = 0.1  # share by which the start is wrong in Fig. 3, and its σ
_SAMPLES = 1000  # of the run, 10 ms each
_SHOWN = 2  # of which every so manieth is held against the stiff solver
_DOTS = np.unique(np.round(np.geomspace(1, 51, 24)).astype(np.int64) * 10 - 10)  # of those, evenly on a log axis
_GOAL = 1e-6
_WORK_MODELS = ("uniform_acceleration", "constant_velocity")
_TWO_PANELS, _THREE_PANELS = (1000, 660), (1000, 990)  # [pixels]

# ---- Fig. 2 ----------------------------------------------------------------------------------------------------


def run_of(name: str) -> Run:
    """Return the run of a named model: a robot that starts 10 % wrong of where it is and how fast."""
    model = make_model(name)
    state = _truth(np.array([_T0]))[0, : model.size]
    return Run(
        model=model, measurement=_MEASUREMENT, process=_PROCESS, cov=np.diag((_OFF * state) ** 2), t0=_T0, t1=_T1
    )


def _truth(t: Array) -> Array:
    """Return the true states ``(k, 3)``: position, velocity, acceleration."""
    x = _SPEED_M_S * t + 0.5 * _ACCELERATION_M_S2 * t**2
    return np.column_stack([x, _SPEED_M_S + _ACCELERATION_M_S2 * t, np.full(len(t), _ACCELERATION_M_S2)])


def covariances(run: Run, times: Array, recovery: str) -> tuple[Array, int]:
    """Return the filter's covariance ``(k, n, n)`` at ``times`` ``(k,)``, and the expansions that it took."""
    kalman = KalmanBucyFilter(
        run.model, measurement=run.measurement, process=run.process, tolerances=Tolerances(recovery=recovery)
    )
    kalman.reset(time=run.t0, cov=run.cov)
    out = [kalman.cov]
    for span in np.diff(times).tolist():
        kalman.advance(span)
        out.append(kalman.cov)
    return np.array(out), kalman.expansions


def _figure_2() -> tuple[dict[str, Any], Figure]:
    times = np.linspace(_T0, _T1, _SAMPLES // _SHOWN + 1)
    result: dict[str, Any] = {}
    figure, panels = chart(3, size=_THREE_PANELS)
    drawn = dict(zip(("uniform_acceleration", "as_printed"), panels, strict=False))
    for name in MODELS:
        run = run_of(name)
        true = reference(run, times)
        result[name] = {}
        for recovery in RECOVERIES:
            cov, expansions = covariances(run, times, recovery)
            deviation = relative_deviation(cov, true)
            result[name][recovery] = {
                "max_absolute": float(np.abs(cov - true).max()), "max_relative": float(deviation.max()),
                "expansions": expansions, "samples": len(times) - 1,
            }  # fmt: skip
            if recovery == "pade":
                panels[2].plot(times, deviation, label=name)
                if name in drawn:
                    _draw_covariance(drawn[name], name, times, cov, true)
    panels[2].axhline(_GOAL, color=INK, linewidth=1)
    panels[2].set_ylim(1e-13, 1e-5)
    label(panels[2], "Deviation from the stiff solver", "t [s]", "relative", log="xy")
    return result, figure


def _draw_covariance(axes: Axes, name: str, times: Array, cov: Array, true: Array) -> None:
    for k, (entry, i, j) in enumerate((("η11 [m²]", 0, 0), ("η21 [m²/s]", 1, 0), ("η22 [m²/s²]", 1, 1))):
        axes.plot(times, cov[:, i, j], color=COLOURS[k], label=entry)
        axes.plot(times[_DOTS], true[_DOTS, i, j], "o", color=COLOURS[k])
    label(axes, f"{name}: covariance (lines), stiff solver (dots)", "t [s]", "covariance", log="xy")
    axes.set_ylim(bottom=1e-4)


# ---- Fig. 3 ----------------------------------------------------------------------------------------------------


def estimates(off: float, *, seed: int) -> tuple[Array, Array, Array]:
    """Filter one uniformly accelerated run, started ``off`` (a share) from the true state.

    Returns
    -------
    tuple
        Times ``(k,)`` [s], errors ``(k, 2)`` [m, m/s], and the filter's σ ``(k, 2)``.
    """
    run = run_of("uniform_acceleration")
    times = np.linspace(_T0, _T1, _SAMPLES + 1)
    true = _truth(times)[:, :2]
    sigma = math.sqrt(run.measurement / (times[1] - times[0]))
    z = true[:, 0] + sigma * np.random.Generator(np.random.PCG64(seed)).standard_normal(len(times))
    kalman = KalmanBucyFilter(run.model, measurement=run.measurement, process=run.process)
    kalman.reset(time=_T0, state=(1.0 + off) * true[0], cov=run.cov, measurement=float(z[0]))
    states, sigmas = [kalman.state], [np.sqrt(np.diag(kalman.cov))]
    for span, value in zip(np.diff(times).tolist(), z[1:].tolist(), strict=True):
        kalman.advance(span, value)
        states.append(kalman.state)
        sigmas.append(np.sqrt(np.diag(kalman.cov)))
    return times, np.array(states) - true, np.array(sigmas)


def _figure_3(seed: int, runs: int) -> tuple[dict[str, Any], Figure]:
    result: dict[str, Any] = {"runs": runs, "sample_sigma_m": math.sqrt(_MEASUREMENT * _SAMPLES / (_T1 - _T0))}
    shown: dict[str, Array] = {}
    for start, off in (("exact", 0.0), ("10 % off", _OFF)):
        every = [estimates(off, seed=seed + k) for k in range(runs)]
        times, shown[start], sigmas = every[0]
        rms = np.sqrt(np.mean([e**2 for _, e, _ in every], axis=0))  # (k, 2)
        at = [int(np.searchsorted(times, t - 1e-9)) for t in (_T0, _T0 + 0.5, _T0 + 1, _T0 + 2, _T0 + 5, _T1)]
        result[start] = {
            "times_s": [float(times[k]) for k in at],
            "position_rms_m": [float(rms[k, 0]) for k in at],
            "velocity_rms_m_s": [float(rms[k, 1]) for k in at],
            "sigma_position_m": [float(sigmas[k, 0]) for k in at],
            "sigma_velocity_m_s": [float(sigmas[k, 1]) for k in at],
        }
    difference = np.abs(shown["10 % off"] - shown["exact"]) / np.abs(shown["10 % off"] - shown["exact"])[0]
    late = np.flatnonzero(difference[:, 0] > 0.01)
    result["start_forgotten_to_1_percent_s"] = float(times[late[-1]] - _T0) if len(late) else 0.0
    figure, panels = chart(2, size=_TWO_PANELS)
    for k, (axes, name) in enumerate(zip(panels, ("position [m]", "velocity [m/s]"), strict=True)):
        axes.plot(times, 2 * sigmas[:, k], color=INK, linewidth=1, label="2σ of the filter")
        axes.plot(times, -2 * sigmas[:, k], color=INK, linewidth=1)
        axes.plot(times, shown["exact"][:, k], color=COLOURS[0], label="exact initial conditions")
        axes.plot(times, shown["10 % off"][:, k], color=COLOURS[1], label="10 % off")
        label(axes, "Error of the estimate", "t [s]", name, log="x")
    return result, figure


# ---- what it costs ---------------------------------------------------------------------------------------------


def _work() -> tuple[dict[str, Any], Figure]:
    result: dict[str, Any] = {}
    for name in _WORK_MODELS:
        rows = measure(run_of(name))
        result[name] = {"runs": rows, "goal": _GOAL, "cheapest_within_goal": cheapest(rows, _GOAL)}
    figure, panels = chart(2, size=_TWO_PANELS)
    for axes, key in zip(panels, ("steps", "multiplications"), strict=True):
        for method in METHODS:
            rows = [row for row in result[_WORK_MODELS[0]]["runs"] if row["method"] == method]
            axes.plot([r["deviation"] for r in rows], [r[key] for r in rows], "o-", label=method)
        axes.set_xlim(1e-12, 1.0)
        label(axes, f"10 s of {_WORK_MODELS[0]}", "relative deviation of the covariance", key, log="xy")
    return result, figure


# ---- on board --------------------------------------------------------------------------------------------------


def _odometry(episodes: int, explorations: int, steps: int, workers: Workers) -> tuple[dict[str, Any], Figure]:
    training = {n: odometry.drives(n, seed=odometry.TRAINING_SEED, episodes=episodes) for n in odometry.NOISES}
    scanned = odometry.scan_process(training)
    config = OdometryFilterConfig()
    result: dict[str, Any] = {
        "training": {"first_seed": odometry.TRAINING_SEED, "episodes": episodes, "rows": scanned},
        "best_on_training": odometry.best(scanned),
        "config": {"model": config.model, "process": config.process_linear},
        "step_us": odometry.step_time_us(training["nominal"], config),
        "test": {"first_seed": odometry.TEST_SEED, "episodes": episodes},
    }
    for noise in odometry.NOISES:
        driven = odometry.drives(noise, seed=odometry.TEST_SEED, episodes=episodes)
        stretches = odometry.accelerating(driven)
        models = {row["model"]: row["process"] for row in result["best_on_training"]}
        rows = {"unfiltered": odometry.errors(driven, driven.measured, stretches)}
        for model, q in models.items():
            tried = OdometryFilterConfig(model=model, process_linear=q, process_turn=odometry.TURN_PROCESS * q)
            rows[f"{model}, Q = {q:.3g}"] = odometry.errors(driven, odometry.filtered(driven, tried), stretches)
        rows["default"] = odometry.errors(driven, odometry.filtered(driven, config), stretches)
        result["test"][noise] = {"stretches": len(stretches), **rows}
    if explorations:
        for name, seed in (("training", odometry.TRAINING_SEED), ("test", odometry.TEST_SEED)):
            result[f"explorations_{name}"] = odometry.explore(
                seed=seed, episodes=explorations, steps=steps, workers=workers
            )
    return result, _odometry_chart(scanned)


def _odometry_chart(rows: list[dict[str, Any]]) -> Figure:
    figure, panels = chart(len(odometry.NOISES), size=_TWO_PANELS)
    for axes, noise in zip(panels, odometry.NOISES, strict=True):
        own = [row for row in rows if row["noise"] == noise]
        raw = next(row for row in own if row["model"] is None)["velocity_rms_mm_s"]
        for model in odometry.PROCESS:
            curve = [(r["process"], r["velocity_rms_mm_s"] / raw) for r in own if r["model"] == model]
            axes.plot(*np.array(curve).T, "o-", label=model)
        axes.axhline(1.0, color=INK, linewidth=1)
        axes.set_ylim(0.95, 1.25)
        label(
            axes, f"{noise} noise", "Q [m²/s³, wiener_acceleration m²/s⁵]", "velocity error / unfiltered", log="x"
        )
    return figure


# ---- all of it -------------------------------------------------------------------------------------------------


def study(
    out: Out = Path("out/paper_c"),
    seed: Seed = 0,
    runs: Annotated[int, typer.Option(min=1, max=1_000_000, help="Of the filter, for its errors.")] = 200,
    episodes: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Drives of a noise preset and a set of seeds.")
    ] = 20,
    explorations: Annotated[
        int, typer.Option(min=0, max=1_000_000, help="Explored apartments, with and without.")
    ] = 20,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Of an exploration, at most.")] = 1000,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Processes.")] = 1,
    ray: Ray = None,
) -> None:
    """Repeat paper C's figures: a filter by differential transforms, its cost, its use on board."""
    check_writable(out, _FILES)
    who = workers_of(workers, ray)
    charts: dict[str, Figure] = {}
    result: dict[str, Any] = {
        "versions": versions(), "seed": seed, "R_m2_s": _MEASUREMENT, "Q": _PROCESS, "t_s": [_T0, _T1],
    }  # fmt: skip
    result["covariance"], charts["figure_2.png"] = _figure_2()
    result["estimate"], charts["figure_3.png"] = _figure_3(seed, runs)
    result["work"], charts["work.png"] = _work()
    result["odometry"], charts["odometry.png"] = _odometry(episodes, explorations, steps, who)
    out.mkdir(parents=True, exist_ok=True)
    for name, figure in charts.items():
        atomic_write(out / name, png(figure))
    write_json(out / "paper_c.json", result)
    # What fits on a screen.
    work = {name: result["work"][name]["cheapest_within_goal"] for name in _WORK_MODELS}
    told = {key: value for key, value in result["odometry"].items() if key != "training"}
    print(json.dumps(result | {"work": work, "odometry": told}, indent=1, ensure_ascii=False))
