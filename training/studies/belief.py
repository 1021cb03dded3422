"""Where a belief stops being true: ``mecanum study belief --floor-plan FILE --out DIR``.

One episode with the truth beside it: NEES of the pose over time, its error by direction in units of what the
belief says, NIS by kind of landmark, the moments at which the NEES rises, and the largest innovations at those
moments with a picture of the scan. What was found with it: ``docs/studies/buildings.md``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.axes import Axes
from scipy.ndimage import median_filter

from agents.base import Goal
from mecanum_env.env import ExploreEnv
from slam.ekf import EkfSlam
from slam.formats import atomic_write
from slam.geometry import about_z, compose, inverse, transform_points, wrap_scalar
from slam.landmarks.innovations import Innovation
from slam.metrics.chi_square import chi2_quantile
from slam.types import Array, Scan
from training.episodes import explore
from training.figures.charts import COLOURS, INK, chart, label, png
from training.figures.tables import number, text_table
from training.runs.errors import Interrupted
from training.runs.options import ConfigFile, FloorPlanFile, MaxSteps, Noise, Out, Rooms, RoomSeed, Slam
from training.runs.progress import Progress
from training.runs.running import write_json

__all__ = ["BeliefWitness", "figures", "rises", "study"]

FILES = ("belief.json", "belief.png", "innovations.png")
DIRECTIONS = ("ahead", "left", "heading")

_SHOWN = 6  # innovations with a picture
_APART_STEPS = 10  # between two that are kept
_RISE, _WITHIN_STEPS = 2.5, 15  # of NEES / 3, and how soon, to be told as a moment
_SMOOTHED = 11  # steps: single beams let the NEES jump for one
_WINDOW_M = 8.0  # of a picture, from the robot


@dataclass(frozen=True)
class Moment:
    """An innovation, and what the robot saw and believed at it."""

    step: int
    innovation: Innovation
    scan: Scan
    sensor: Array  # (3,) where the sensor was believed to be, after the correction
    true_sensor: Array  # (3,)


@dataclass
class BeliefWitness:
    """Takes down the error, the covariance and the innovations of every step (a witness of an episode)."""

    errors: list[Array] = field(default_factory=list)  # (3,) truth less estimate, seen from the robot
    sigmas: list[Array] = field(default_factory=list)  # (3,) in the same directions
    nees: list[float] = field(default_factory=list)
    nis: dict[str, list[float]] = field(default_factory=dict)  # kind → squared Mahalanobis distances
    moments: list[Moment] = field(default_factory=list)  # the largest innovation of each second or so
    _seen: list[Innovation] = field(default_factory=list)

    def begin(self, env: ExploreEnv) -> None:
        """Have an environment's backend tell of its innovations, where it has any."""
        if isinstance(env.backend, EkfSlam):
            env.backend.witness = self._seen.extend

    def take(self, env: ExploreEnv, goal: Goal | None) -> None:
        """Take down the environment as it is now."""
        del goal
        true, pose, cov = env.truth.pose, env.backend.pose, env.backend.pose_cov
        turn = about_z(-pose[2])
        error = turn @ (true - pose)
        error[2] = wrap_scalar(float(true[2] - pose[2]))
        self.errors.append(error)
        self.sigmas.append(np.sqrt(np.diag(turn @ cov @ turn.T)))
        self.nees.append(env.backend.pose_nees(true))
        step = len(self.nees) - 1
        mount = np.array([env.config.lidar.offset_m, 0.0, 0.0])
        for innovation in self._seen:
            self.nis.setdefault(innovation.kind, []).append(innovation.nis)
            self._keep(Moment(step, innovation, env.scan, compose(pose, mount), compose(true, mount)))
        self._seen.clear()

    def _keep(self, moment: Moment) -> None:
        """Keep it if nothing within a second was larger."""
        if not self.moments or moment.step - self.moments[-1].step >= _APART_STEPS:
            self.moments.append(moment)
        elif self.moments[-1].innovation.nis < moment.innovation.nis:
            self.moments[-1] = moment

    def shown(self) -> list[Moment]:
        """Return the moments to look at: those at which the NEES rose, then those of the largest innovations."""
        steep = rises(self.nees)
        rise = [m for m in self.moments if any(0 <= k - m.step <= 2 * _WITHIN_STEPS for k in steep)]
        rest = [m for m in self.moments if m not in rise]
        return [*sorted(rise, key=_size, reverse=True), *sorted(rest, key=_size, reverse=True)][:_SHOWN]


def _size(moment: Moment) -> float:
    return moment.innovation.nis


def rises(nees: Sequence[float]) -> list[int]:
    """Return the steps up to which NEES / 3, as a median of 11 steps, rose by 2.5 within 15 steps, one a rise."""
    third = median_filter(np.asarray(nees, np.float64) / 3.0, _SMOOTHED)
    found: list[int] = []
    for k in range(_WITHIN_STEPS, len(third)):
        if third[k] - third[k - _WITHIN_STEPS] > _RISE and (not found or k - found[-1] > 4 * _WITHIN_STEPS):
            found.append(k)
    return found


def figures(witness: BeliefWitness, step_s: float) -> dict[str, Any]:
    """Return what ``belief.json`` holds: of a right belief all means are 1, and 1 % of the innovations rare."""
    nees, errors, sigmas = np.array(witness.nees[1:]), np.array(witness.errors[1:]), np.array(witness.sigmas[1:])
    rare = chi2_quantile(0.99, 2)
    return {
        "steps": len(nees),
        "nees_over_3": float(nees.mean()) / 3.0,
        "nees_over_3_max": float(nees.max()) / 3.0,
        "normalised_error": dict(zip(DIRECTIONS, ((errors / sigmas) ** 2).mean(axis=0).tolist(), strict=True)),
        # As explore has it: of all poses, the start's among them.
        "ate_rmse_m": float(np.sqrt((np.array(witness.errors)[:, :2] ** 2).sum(axis=1).mean())),
        "nis_over_2": {
            kind: {
                "mean": float(np.mean(values)) / 2.0,
                "rare": float(np.mean(np.array(values) > rare)),
                "count": len(values),
            }
            for kind, values in sorted(witness.nis.items())
        },
        "rises_s": [step_s * k for k in rises(witness.nees)],
        "shown": [
            {"time_s": step_s * m.step, "kind": m.innovation.kind, "landmark": m.innovation.landmark,
             "nis": m.innovation.nis}
            for m in witness.shown()
        ],
    }  # fmt: skip


# ---- pictures --------------------------------------------------------------------------------------------------


def _draw_course(witness: BeliefWitness, step_s: float) -> bytes:
    figure, (over_time, by_direction) = chart(2, size=(1400, 900))
    time = step_s * np.arange(len(witness.nees))
    over_time.plot(time, np.array(witness.nees) / 3.0, linewidth=1, label="NEES / 3")
    over_time.axhline(1.0, color=INK, linewidth=1, label="ideal")
    for k in rises(witness.nees):
        over_time.axvline(time[k], color=COLOURS[1], linewidth=0.8, alpha=0.6)
    label(over_time, "NEES of the pose; its rises marked", "time [s]", "NEES / 3")
    over_time.set_ylim(0.0, max(3.0, float(np.quantile(witness.nees, 0.995)) / 3.0))
    sizes = np.array(witness.errors) / np.array(witness.sigmas)
    for name, column in zip(DIRECTIONS, sizes.T, strict=True):
        by_direction.plot(time, column, linewidth=1, label=name)
    for limit in (-3.0, 3.0):
        by_direction.axhline(limit, color=INK, linewidth=1, linestyle="dashed")
    label(by_direction, "Error in units of what the belief says, as seen by the robot", "time [s]", "error / σ")
    return png(figure)


def _draw_innovations(moments: Sequence[Moment], env: ExploreEnv, step_s: float) -> bytes:
    figure, panels = chart(2, 3, size=(1800, 1200))
    ground = env.truth.ground
    walls = transform_points(inverse(ground.start), ground.plan.segments.reshape(-1, 2)).reshape(-1, 4)
    for axes in panels:
        axes.set_visible(False)
    for axes, moment in zip(panels, moments, strict=False):
        axes.set_visible(True)
        _draw_moment(axes, moment, walls, step_s)
        if axes is not panels[0] and (legend := axes.get_legend()):  # one will do
            legend.remove()
    return png(figure)


def _draw_moment(axes: Axes, moment: Moment, walls: Array, step_s: float) -> None:
    """Draw the true walls, the scan from where the robot was believed to be, and the innovation in it."""
    scan, seen, sensor = moment.scan, moment.innovation, moment.sensor
    x, y, _ = moment.true_sensor.tolist()
    for x0, y0, x1, y1 in walls.tolist():
        axes.plot([x0, x1], [y0, y1], color="#b8b4b0", linewidth=2.5)
    bearings = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    hit = np.isfinite(scan.ranges)
    ends = scan.ranges[hit, None] * np.column_stack([np.cos(bearings[hit]), np.sin(bearings[hit])])
    axes.plot(*transform_points(sensor, ends).T, ".", color=INK, markersize=3, label="scan, as believed")
    axes.plot([x], [y], "o", color=COLOURS[2], label="sensor in truth")
    axes.plot([sensor[0]], [sensor[1]], "x", color=COLOURS[1], label="… as believed")
    for (rho, phi), colour, what in ((seen.seen, COLOURS[0], "seen"), (seen.expected, COLOURS[4], "expected")):
        c, s = math.cos(phi), math.sin(phi)
        # A wall's piece; a point is a piece of no length.
        piece = np.array([[rho * c - t * s, rho * s + t * c] for t in seen.extent])
        axes.plot(
            *transform_points(sensor, piece).T, "s-", color=colour, markersize=6, fillstyle="none", label=what
        )
    axes.set_aspect("equal")
    axes.set_xlim(x - _WINDOW_M, x + _WINDOW_M)
    axes.set_ylim(y - _WINDOW_M, y + _WINDOW_M)
    title = f"{step_s * moment.step:.1f} s: {seen.kind} {seen.landmark}, NIS {seen.nis:.1f}"
    label(axes, title, "x [m]", "y [m]")


# ---- the command -----------------------------------------------------------------------------------------------


def study(
    floor_plan: FloorPlanFile = None,
    rooms: Rooms = None,
    agent: Annotated[str, typer.Option(help="Who explores.")] = "brisk-tour",
    slam: Slam = None,
    noise: Noise = None,
    seed: RoomSeed = 0,
    config: ConfigFile = None,
    max_steps: MaxSteps = None,
    out: Out = Path("out/belief"),
) -> None:
    """Ask where a belief stops being true: NEES, errors by direction, NIS by kind, largest innovations."""
    episode = explore.prepare(
        out=out, agent=agent, rooms=rooms, slam=slam, noise=noise, seed=seed, floor_plan=floor_plan,
        config=config, max_steps=max_steps,
    )  # fmt: skip
    witness = BeliefWitness()
    witness.begin(episode.env)
    with Progress("exploring", episode.run["max_steps"], eta=False) as bar:
        explore.run(episode, lambda *, coverage, steps, **_: bar.show(steps, f"{coverage:.0%} covered"), [witness])
    step_s = episode.config.step_s
    plan = episode.config.floor_plan
    found = {
        "floor_plan": plan and Path(plan).name, "rooms": None if plan else episode.config.rooms, "agent": agent,
        "slam": episode.config.slam, "slam_config": dict(episode.config.slam_config), "seed": seed,
        "end": episode.end, **figures(witness, step_s),
    }  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    atomic_write(out / "belief.png", _draw_course(witness, step_s))
    if witness.moments:
        atomic_write(out / "innovations.png", _draw_innovations(witness.shown(), episode.env, step_s))
    else:
        (out / "innovations.png").unlink(missing_ok=True)  # another run's
    write_json(out / "belief.json", found)
    print(_told(found))
    if episode.interrupted:
        raise Interrupted(f"interrupted after {step_s * found['steps']:.1f} s; what was seen so far is in {out}")


def _told(found: dict[str, Any]) -> str:
    errors = ", ".join(f"{name} {value:.2f}" for name, value in found["normalised_error"].items())
    lines = [
        f"NEES / 3 {found['nees_over_3']:.2f}, at most {found['nees_over_3_max']:.1f}",
        f"ATE {found['ate_rmse_m']:.3f} m",
        f"mean square of error / σ: {errors}",
    ]
    if found["nis_over_2"]:
        rows = [
            [kind, number(f["mean"], 2), f"{f['rare']:.1%}", str(f["count"])]
            for kind, f in found["nis_over_2"].items()
        ]
        lines.append(text_table(["innovations", "NIS / 2", "beyond 99 %", "count"], rows))
    if found["rises_s"]:
        lines.append("NEES / 3 rises by 2.5 up to: " + ", ".join(f"{t:.1f} s" for t in found["rises_s"]))
    return "\n".join(lines)
