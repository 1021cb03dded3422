"""Paper C's figures (theory.md C): a filter by differential transforms, its cost, its use on board.

``mecanum study paper-c --out DIR`` writes ``figure_2.png`` (the covariance against a stiff
solver), ``figure_3.png`` (the estimate's error with exact initial conditions, and 10 % off), ``work.png``
(operations and time against RK45 and matrix exponentials), ``odometry.png`` (the odometry of an accelerating
robot, filtered) and ``paper_c.json``. What they mean: ``docs/studies/paper-c.md``.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from slam.formats import atomic_write
from slam.odometry.differential_transform import MODELS, make_model
from slam.odometry.filters import OdometryFilterConfig
from slam.odometry.riccati import RECOVERIES, Tolerances
from slam.odometry.transform_filter import KalmanBucyFilter
from training.figures.charts import Axis, Line, draw_chart, png
from training.runs.errors import check_writable
from training.runs.running import versions
from training.studies.paper_c import odometry
from training.studies.paper_c.work import METHODS, Run, cheapest, measure, reference, relative_deviation

__all__ = ["covariances", "estimates", "paper_c", "run_of", "study"]

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

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
_PANEL = (1000, 330)

ODOMETRY_MODELS = tuple(MODELS)
"""Those tried on board."""


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


def _figure_2() -> tuple[dict[str, Any], Image]:
    times = np.linspace(_T0, _T1, _SAMPLES // _SHOWN + 1)
    result: dict[str, Any] = {}
    panels, deviations = [], []
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
                deviations.append(Line(name, times, np.maximum(deviation, 1e-17)))
                if name in ("uniform_acceleration", "as_printed"):
                    panels.append(_covariance_panel(name, times, cov, true))
    deviations.append(Line("", times[[0, -1]], np.full(2, _GOAL), colour=6, px=1))
    axis = Axis("relative", log=True, low=1e-13, high=1e-5)
    panels.append(draw_chart(deviations, title="Deviation from the stiff solver", x=_time(), y=axis, size=_PANEL))
    return result, np.vstack(panels)


def _covariance_panel(name: str, times: Array, cov: Array, true: Array) -> Image:
    lines = []
    for k, (label, i, j) in enumerate((("η11 [m²]", 0, 0), ("η21 [m²/s]", 1, 0), ("η22 [m²/s²]", 1, 1))):
        lines.append(Line(label, times, cov[:, i, j], colour=k))
        dots = np.full(len(times), np.nan)  # a point between gaps is drawn as a dot
        dots[_DOTS] = true[_DOTS, i, j]
        lines.append(Line("", times, dots, colour=k))
    title = f"{name}: covariance (lines), stiff solver (dots)"
    return draw_chart(lines, title=title, x=_time(), y=Axis("covariance", log=True, low=1e-4), size=_PANEL)


def _time() -> Axis:
    return Axis("t [s]", log=True, low=_T0, high=_T1)


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


def _figure_3(seed: int, runs: int) -> tuple[dict[str, Any], Image]:
    result: dict[str, Any] = {"runs": runs, "sample_sigma_m": math.sqrt(_MEASUREMENT * _SAMPLES / (_T1 - _T0))}
    shown: dict[str, Array] = {}
    for label, off in (("exact", 0.0), ("10 % off", _OFF)):
        every = [estimates(off, seed=seed + k) for k in range(runs)]
        times, shown[label], sigmas = every[0]
        rms = np.sqrt(np.mean([e**2 for _, e, _ in every], axis=0))  # (k, 2)
        at = [int(np.searchsorted(times, t - 1e-9)) for t in (_T0, _T0 + 0.5, _T0 + 1, _T0 + 2, _T0 + 5, _T1)]
        result[label] = {
            "times_s": [float(times[k]) for k in at],
            "position_rms_m": [float(rms[k, 0]) for k in at],
            "velocity_rms_m_s": [float(rms[k, 1]) for k in at],
            "sigma_position_m": [float(sigmas[k, 0]) for k in at],
            "sigma_velocity_m_s": [float(sigmas[k, 1]) for k in at],
        }
    difference = np.abs(shown["10 % off"] - shown["exact"]) / np.abs(shown["10 % off"] - shown["exact"])[0]
    late = np.flatnonzero(difference[:, 0] > 0.01)
    result["start_forgotten_to_1_percent_s"] = float(times[late[-1]] - _T0) if len(late) else 0.0
    panels = []
    for k, label in enumerate(("position [m]", "velocity [m/s]")):
        lines = [
            Line("2σ of the filter", times, 2 * sigmas[:, k], colour=6, px=1),
            Line("", times, -2 * sigmas[:, k], colour=6, px=1),
            Line("exact initial conditions", times, shown["exact"][:, k], colour=0),
            Line("10 % off", times, shown["10 % off"][:, k], colour=1),
        ]
        panels.append(draw_chart(lines, title="Error of the estimate", x=_time(), y=Axis(label), size=_PANEL))
    return result, np.vstack(panels)


# ---- what it costs ---------------------------------------------------------------------------------------------


def _work(repeats: int) -> tuple[dict[str, Any], Image]:
    result: dict[str, Any] = {"repeats": repeats}
    for name in _WORK_MODELS:
        rows = measure(run_of(name), repeats=repeats)
        result[name] = {"runs": rows, "goal": _GOAL, "cheapest_within_goal": cheapest(rows, _GOAL)}
    panels = []
    for key, label in (("operations", "operations"), ("time_us", "median time [µs]")):
        lines = []
        for method in METHODS:
            rows = [row for row in result[_WORK_MODELS[0]]["runs"] if row["method"] == method]
            lines.append(Line(method, [r["deviation"] for r in rows], [r[key] for r in rows], dots=True))
        x = Axis("relative deviation of the covariance", log=True, low=1e-12, high=1.0)
        panels.append(
            draw_chart(lines, title="10 s of uniform_acceleration", x=x, y=Axis(label, log=True), size=_PANEL)
        )
    return result, np.vstack(panels)


# ---- on board --------------------------------------------------------------------------------------------------


def _odometry(episodes: int, explorations: int, steps: int, workers: int) -> tuple[dict[str, Any], Image]:
    training = {n: odometry.drives(n, seed=odometry.TRAINING_SEED, episodes=episodes) for n in odometry.NOISES}
    scanned = odometry.scan_process(training, models=ODOMETRY_MODELS)
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


def _odometry_chart(rows: list[dict[str, Any]]) -> Image:
    panels = []
    for noise in odometry.NOISES:
        own = [row for row in rows if row["noise"] == noise]
        raw = next(row for row in own if row["model"] is None)["velocity_rms_mm_s"]
        lines = []
        for model in ODOMETRY_MODELS:
            curve = [(r["process"], r["velocity_rms_mm_s"] / raw) for r in own if r["model"] == model]
            x, y = np.array(curve).T
            lines.append(Line(model, x, y, dots=True))
        lines.append(Line("", [1e-3, 1e5], [1.0, 1.0], colour=6, px=1))
        panels.append(draw_chart(
            lines, title=f"{noise} noise", x=Axis("Q [m²/s³, wiener_acceleration m²/s⁵]", log=True),
            y=Axis("velocity error / unfiltered", low=0.95, high=1.25), size=_PANEL,
        ))  # fmt: skip
    return np.vstack(panels)


# ---- all of it -------------------------------------------------------------------------------------------------


def paper_c(
    out: Path, *, seed: int = 0, runs: int = 200, repeats: int = 31, episodes: int = 20, explorations: int = 20,
    steps: int = 1000, workers: int = 1,
) -> dict[str, Any]:  # fmt: skip
    """Make every figure, write the charts and ``paper_c.json``, and return the latter's contents.

    Parameters
    ----------
    seed, runs
        Of the measurement noise in Fig. 3, whose first run is drawn.
    repeats
        Of which times are the median.
    episodes
        Drives per noise preset and set of seeds.
    explorations, steps, workers
        Explored apartments per noise preset, filter and set of seeds (0: none), the steps of each at most, and the
        processes for them.
    """
    check_writable(out, _FILES)
    charts: dict[str, Image] = {}
    result: dict[str, Any] = {
        "versions": versions(), "seed": seed, "R_m2_s": _MEASUREMENT, "Q": _PROCESS, "t_s": [_T0, _T1],
    }  # fmt: skip
    result["covariance"], charts["figure_2.png"] = _figure_2()
    result["estimate"], charts["figure_3.png"] = _figure_3(seed, runs)
    result["work"], charts["work.png"] = _work(repeats)
    result["odometry"], charts["odometry.png"] = _odometry(episodes, explorations, steps, workers)
    out.mkdir(parents=True, exist_ok=True)
    for name, image in charts.items():
        atomic_write(out / name, png(image))
    atomic_write(out / "paper_c.json", json.dumps(result, indent=1, ensure_ascii=False) + "\n")
    return result


def _summary(result: dict[str, Any]) -> dict[str, Any]:
    """Return what fits on a screen."""
    work = {name: result["work"][name]["cheapest_within_goal"] for name in _WORK_MODELS}
    told = {key: value for key, value in result["odometry"].items() if key != "training"}
    return {"covariance": result["covariance"], "estimate": result["estimate"], "work": work, "odometry": told}


def study(
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/paper_c"),
    seed: Annotated[int, typer.Option(min=0)] = 0,
    runs: Annotated[int, typer.Option(min=1, help="Of the filter, for its errors.")] = 200,
    repeats: Annotated[int, typer.Option(min=1, help="Of each timing.")] = 31,
    episodes: Annotated[int, typer.Option(min=1, help="Drives of the accelerating robot.")] = 20,
    explorations: Annotated[int, typer.Option(min=0, help="Episodes with filtered odometry.")] = 20,
    steps: Annotated[int, typer.Option(min=1, help="Of a drive.")] = 1000,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Repeat paper C's figures: a filter by differential transforms, its cost, its use on board."""
    result = paper_c(
        out, seed=seed, runs=runs, repeats=repeats, episodes=episodes, explorations=explorations, steps=steps,
        workers=workers,
    )  # fmt: skip
    print(json.dumps(_summary(result), indent=1, ensure_ascii=False))
