"""Recorded logs as files: small ones, of a robot that drives a circle among landmarks without any noise."""

from __future__ import annotations

import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest

DATA = Path(os.environ.get("MECANUM_DATA", Path(__file__).parents[4] / "shared" / "data"))

UTIAS_FILES = (
    "Robot1_Odometry.dat", "Robot1_Measurement.dat", "Robot1_Groundtruth.dat", "Landmark_Groundtruth.dat",
    "Barcodes.dat",
)  # fmt: skip
PARK_FILES = (
    "time.txt", "speed.txt", "steering.txt", "lasersampling.txt", "ObservationDistance.txt",
    "ObservationAngle.txt", "gps.txt",
)  # fmt: skip
CLOCK = 1000.0  # [s] at the first odometry


def data_folder(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"real data absent: {path} (set MECANUM_DATA to the folder that holds it)")
    return path


def table(rows: object, *, comment: str = "") -> str:
    lines = [" \t ".join(format(v, ".10g") for v in np.atleast_1d(row)) for row in rows]  # type: ignore[attr-defined]
    return "".join(f"{line}\n" for line in ([comment] if comment else []) + lines)


def put(path: Path, text: str, *, packed: bool = False) -> None:
    if packed:
        path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(text.encode()))
    else:
        path.write_text(text)


def circle(times: np.ndarray, speed: float, omega: float) -> np.ndarray:
    """Return the poses ``(n, 3)`` of a circle from the origin."""
    radius, turned = speed / omega, omega * times
    return np.column_stack([radius * np.sin(turned), radius * (1.0 - np.cos(turned)), turned])


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return range and bearing ``(n, 2)`` of points ``(n, 2)``."""
    d = points - pose[:2]
    bearing = np.arctan2(d[:, 1], d[:, 0]) - pose[2]
    return np.column_stack([np.hypot(*d.T), np.arctan2(np.sin(bearing), np.cos(bearing))])


def write_utias(folder: Path, *, seconds: float = 20.0, packed: bool = False) -> np.ndarray:
    """Write a robot's log, one measurement set every 0.5 s; return its landmarks ``(4, 2)``, subjects 6 to 9."""
    folder.mkdir(parents=True, exist_ok=True)
    landmarks = np.array([[2.0, 0.0], [0.0, 3.0], [-2.0, 1.0], [1.0, -2.0]])
    codes = {1: 5, 2: 14, 6: 63, 7: 81, 8: 7, 9: 70}
    times = np.arange(round(seconds * 100) + 1) / 100.0
    poses = circle(times, 0.1, 0.2)
    measured = []
    for i in range(50, len(times), 50):
        measured.append((CLOCK + times[i], codes[2], 1.0, 0.1))  # another robot
        for k, (rho, bearing) in enumerate(seen_from(poses[i], landmarks)):
            measured.append((CLOCK + times[i], codes[6 + k], rho, bearing))
    odometry = [(CLOCK + t, 0.1, 0.2) for t in times]
    truth = [(CLOCK + t, *p) for t, p in zip(times[::3], poses[::3], strict=True)]
    survey = [(6 + k, x, y, 1e-4, 1e-4) for k, (x, y) in enumerate(landmarks)]
    texts = (odometry, measured, truth, survey, list(codes.items()))
    for name, rows in zip(UTIAS_FILES, texts, strict=True):
        put(folder / name, table(rows, comment="# a comment\n"), packed=packed)
    return landmarks


def write_park(folder: Path, *, seconds: float = 10.0, packed: bool = False) -> np.ndarray:
    """Write a car's log, straight ahead at 2 m/s from (5, -3) on 35.5°; return its trees ``(5, 2)``."""
    folder.mkdir(parents=True, exist_ok=True)
    heading = math.radians(35.5)
    along = np.array([math.cos(heading), math.sin(heading)])
    trees = np.array([[20.0, 0.0], [5.0, 15.0], [30.0, 10.0], [25.0, 20.0], [15.0, -8.0]])
    times = np.arange(round(seconds * 40) + 1) / 40.0
    frames = np.arange(0.1, seconds, 0.2)
    distances, angles = np.zeros((len(frames), 18)), np.full((len(frames), 18), 2.7e-8)
    for i, t in enumerate(frames):
        z = seen_from(np.array([*((5.0, -3.0) + 2.0 * t * along), heading]), trees)
        ahead = z[np.abs(z[:, 1]) < 0.5 * math.pi]
        distances[i, : len(ahead)], angles[i, : len(ahead)] = ahead[:, 0], ahead[:, 1] + 0.5 * math.pi
    fixes = np.arange(0.0, seconds, 0.25)
    gps = [(1e3 * (CLOCK + t), *((5.0, -3.0) + 2.0 * t * along)) for t in fixes]
    texts = (
        1e3 * (CLOCK + times), np.full(len(times), 2.0), np.zeros(len(times)), 1e3 * (CLOCK + frames), distances,
        angles, gps,
    )  # fmt: skip
    for name, rows in zip(PARK_FILES, texts, strict=True):
        put(folder / name, table(rows), packed=packed)
    return trees
