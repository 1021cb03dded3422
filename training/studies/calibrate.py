"""Odometry calibration: V as the simulated robot has it, beside V as its estimators are told.

``mecanum study calibration`` drives each preset's robot over an open floor and prints both
(:mod:`mecanum_env.sensing.odometry_calibration`, theory.md A).
"""

from __future__ import annotations

import json
import sys
from typing import Annotated, Any

import numpy as np
import typer

from mecanum_env.config import NOISE_PRESETS, ROBOT_PRESETS
from mecanum_env.sensing.calibration import odometry_noise
from mecanum_env.sensing.odometry_calibration import Drives, drift_ratios, drive, fit
from slam.motion import OdometryNoise
from slam.settings import check_name
from training.figures.tables import text_table
from training.runs.errors import bad_input
from training.runs.options import Json, Seed
from training.runs.typed import parts_of

__all__ = ["compare", "study", "table"]

_TERMS = ("speed_floor_m_s", "speed_share", "turn_floor_rad_s", "turn_share_rad_m")


def compare(preset: str, *, episodes: int, steps: int, seed: int) -> dict[str, Any]:
    """Drive a noise preset's robot; return V measured and declared, and by how much the declared one is off.

    ``drift_ratio_*`` is the squared drift over a second, over what V allows for it: ideal 1, below it V is too
    large. ``lasting_without_gain`` is what V would be if the wheels' mean overstatement, ``gain``, were taken out.
    """
    robot, noise = ROBOT_PRESETS.get(preset, ROBOT_PRESETS["youbot"]), NOISE_PRESETS[preset]
    drives = drive(robot, noise, episodes=episodes, steps=steps, seed=seed)
    found = fit(drives, robot.lever_m)
    # One gain for all three: that of the wheels.
    gain = float(np.mean(found.gain))
    corrected = Drives(drives.measured * (1.0 - gain), drives.true, drives.slips, drives.dt)
    declared = odometry_noise(robot, noise)
    return {
        "white": _terms(found.white),
        "lasting": _terms(found.lasting),
        "lasting_without_gain": _terms(fit(corrected, robot.lever_m).lasting),
        "declared": _terms(declared),
        "declared_white": _terms(declared.white()),
        "drift_ratio_declared": drift_ratios(drives, declared),
        "drift_ratio_lasting": drift_ratios(drives, found.lasting),
        "gain": found.gain.tolist(),
        "bins": found.bins.tolist(),
        "steps": found.steps,
    }


def _terms(noise: OdometryNoise) -> dict[str, float]:
    return {name: getattr(noise, name) for name in _TERMS}


def table(results: dict[str, dict[str, Any]]) -> str:
    """Return the comparison as a table; speeds in m/s, turn rates in rad/s."""
    head = ["", "v floor", "v share", "ω floor", "ω share", "drift² v", "drift² ω"]
    rows, lines = [], []
    for preset, result in results.items():
        for kind in ("white", "declared_white", "lasting", "lasting_without_gain", "declared"):
            ratios = result.get(f"drift_ratio_{kind}")
            drifts = ["", ""] if ratios is None else [f"{ratio:.2f}" for ratio in ratios]
            values = [f"{result[kind][name]:.4f}" for name in _TERMS]
            rows.append([f"{preset} {kind.replace('_', ' ')}", *values, *drifts])
        gains = ", ".join(f"{100 * share:+.1f} %" for share in result["gain"])
        lines.append(f"{preset}: the wheels claim more than was driven: vx, vy, ω {gains}")
    return "\n".join([text_table(head, rows), *lines])


def study(
    noise: Annotated[str, typer.Option(help="Noise presets, separated by commas.")] = "nominal,slippery,cavity",
    episodes: Annotated[int, typer.Option(min=1, max=1_000_000, help="Drives of a preset.")] = 60,
    steps: Annotated[int, typer.Option(min=10, max=1_000_000, help="Of a drive.")] = 400,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Calibrate odometry: V as the simulated robot has it, beside V as its estimators are told."""
    presets = parts_of(noise)
    with bad_input():
        for preset in presets:
            check_name("noise preset", preset, NOISE_PRESETS)
    results = {}
    for preset in presets:
        print(f"driving {preset} …", file=sys.stderr)
        results[preset] = compare(preset, episodes=episodes, steps=steps, seed=seed)
    print(json.dumps(results) if as_json else table(results))
