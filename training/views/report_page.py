"""The report of an episode: one page that needs nothing else and replays the run in the browser.

The page is put together from ``assets/``: a frame, a style sheet and scripts, one a concern. What it replays
travels in it as arrays, one after the other, deflated and in base64; :func:`pack` says which. The browser has to
have ``DecompressionStream`` (all major ones since spring 2023).
"""

from __future__ import annotations

import base64
import json
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.physics.robot import wheel_positions
from mecanum_env.views.canvas import Canvas, View
from mecanum_env.views.paint import paint_plan
from mecanum_env.views.pictures import episode_view
from slam.geometry import inverse
from training.episodes.playback import ellipses
from training.episodes.recording import Recorded, Recording
from training.figures.page import HEAD, name_html, security_policy, text_html
from training.figures.page_style import STYLE
from training.figures.tables import number

if TYPE_CHECKING:
    from mecanum_env.config import EnvConfig
    from mecanum_env.env import ExploreEnv
    from mecanum_env.ground_truth import GroundTruth

__all__ = [
    "LOST", "NO_RETURN", "TRUTH_PX", "about_plan", "assets", "episode_page", "filled", "first_asked",
    "metrics_table", "pack", "tiles",
]  # fmt: skip

_ASSETS = Path(__file__).parent / "assets"
# The last puts the others to work.
_SCRIPTS = ("recording.js", "plan_canvas.js", "curves.js", "episode.js", "player.js")
TRUTH_PX = 1400  # of the true plan's longer side
_MOST_SCANS, _MOST_LANDMARKS = 3000, 240  # notes that are shown: longer episodes show every second, third, …
_RANGE_STEPS = 252  # a range is told in so many parts of the lidar's reach …
NO_RETURN, LOST = 253, 254  # … or is one of these

_WALL_CLOCK = {"decision_ms_median", "wall_time_s"}  # in metrics.json alone: one seed makes one page, bit for bit

Arrays = dict[str, NDArray[Any]]


def episode_page(
    env: ExploreEnv, recording: Recording, *, title: str, metrics: Mapping[str, Any], ending: str, config: str,
    target: float,
) -> str:  # fmt: skip
    """Return the page.

    The environment, at the episode's end, is for the true plan and what the robot is like. The title says what was
    explored by whom, ``ending`` why it ended, ``target`` which coverage counts as success; metrics are those of
    ``metrics.json``, ``config`` is TOML.
    """
    header, arrays = pack(recording)
    view = episode_view(env.truth.ground, env.belief, longest_px=TRUTH_PX)
    header |= about_plan(env.config, env.truth.ground, view) | {"target": target}
    return filled("episode.html", header, arrays, {
        "TITLE": text_html(title),
        "ENDING": text_html(ending),
        "TILES": tiles(first_asked(metrics)),
        "METRICS": metrics_table(metrics),
        "CONFIG": text_html(config),
        "SCRIPT": assets(_SCRIPTS),
    })  # fmt: skip


def about_plan(config: EnvConfig, ground: GroundTruth, view: View) -> dict[str, Any]:
    """Return what a header says of the robot and of the true plan, drawn in a view."""
    robot = config.robot
    return {
        "robot": {
            "length": robot.length_m, "width": robot.width_m, "wheel": robot.wheel_radius_m,
            "wheels": wheel_positions(robot).tolist(),
        },
        "lidar": {"offset": config.lidar.offset_m},
        "truth": {"left": view.left, "top": view.top, "scale": view.scale, "png": _truth_png(ground, view)},
        "target": config.coverage_target,
    }  # fmt: skip


def filled(
    template: str, header: Mapping[str, Any], arrays: Arrays, parts: Mapping[str, str], *, style: str = ""
) -> str:
    """Return ``assets/page.html`` with what the template has of its own, and all parts, in their places.

    ``style`` is what a page has besides the style of all; of scripts it runs ``parts["SCRIPT"]`` and no other.
    """
    style = STYLE + assets(["episode.css"]) + style
    parts = dict(parts) | {
        "HEAD": security_policy(styles=[style], scripts=[parts["SCRIPT"]]) + "\n" + HEAD,
        "STYLE": style,
        "HEADER": json.dumps(header).replace("<", "\\u003c"),
        "DATA": _deflated(header["arrays"], arrays),
    }
    frame = assets(["page.html"])
    for name, own in zip(("VIEWS", "LAYERS", "MORE"), re.split("<!-- .* -->\n", assets([template])), strict=True):
        frame = frame.replace("{{" + name + "}}", own)
    before, *pieces = frame.split("{{")
    return before + "".join(parts[name] + rest for name, _, rest in (piece.partition("}}") for piece in pieces))


# ---- the data --------------------------------------------------------------------------------------------------


def pack(recording: Recording, *, robots: int = 1) -> tuple[dict[str, Any], Arrays]:
    """Return what a page of so many robots replays of one: a header that JSON can hold, and arrays of numbers.

    ``header["arrays"]`` lists name, type and length of the arrays in their order. What was noted now and then has
    its steps in ``*_step`` and how many values belong to each in ``*_count``.

    - Each row: ``true`` and ``estimate`` (x, y, θ), ``cov`` (xx, xy, yy, θθ), ``coverage``, ``nees``, ``health``,
      ``collisions``; the time is the row's number times ``step_s``.
    - ``scan``: ranges in 252nds of the lidar's reach, each less the one before it, modulo 256.
    - ``landmark``: x, y [mm], semi-axes of the covariance (1σ) [0.1 mm], the longer's direction [°]; a table of
      five rows, not columns: like stands beside like.
    - ``map_gap``: how far each changed cell lies behind the one before it, row by row over the rectangle
      ``map``; ``map_class`` what it is now.
    """
    landmarks = _thinned(recording.landmarks, _MOST_LANDMARKS // robots)
    scans = _thinned(recording.scans, _MOST_SCANS // robots)
    row0, col0, row1, col1 = recording.bounds()
    gaps, classes, counts = _map_changes(recording.map_changes, (row0, col0), col1 - col0)
    covs = recording.pose_covs
    arrays: Arrays = {
        "true": recording.true_poses.astype(np.float32),
        "estimate": recording.estimates.astype(np.float32),
        "cov": covs[:, (0, 0, 1, 2), (0, 1, 1, 2)].astype(np.float32),
        "coverage": recording.coverage.astype(np.float32),
        "nees": recording.nees.astype(np.float32),
        "health": recording.health.astype(np.float32),
        "collisions": np.minimum(recording.collisions, 65535).astype(np.uint16),
        "scan_step": scans.steps.astype(np.uint32),
        "scan": _ranges(scans, recording.scan.range_max),
        "goal_step": recording.goals.steps.astype(np.uint32),
        "goal_count": _counts(recording.goals),
        "goal": _joined(recording.goals, (0, 2)).astype(np.float32),
        "landmark_step": landmarks.steps.astype(np.uint32),
        "landmark_count": _counts(landmarks),
        "landmark": _ellipses(_joined(landmarks, (0, 5))),
        "map_step": recording.map_changes.steps.astype(np.uint32),
        "map_count": counts,
        "map_gap": gaps,
        "map_class": classes,
    }
    header = {
        "step_s": recording.step_s,
        "rows": len(recording.times),
        "beams": len(recording.scan.ranges),
        "angle_min": recording.scan.angle_min,
        "angle_increment": recording.scan.angle_increment,
        "range_max": recording.scan.range_max,
        "map": {
            "row0": row0, "col0": col0, "rows": row1 - row0, "cols": col1 - col0,
            "resolution": recording.resolution,
        },
        "arrays": [[name, array.dtype.name, array.size] for name, array in arrays.items()],
    }  # fmt: skip
    return header, arrays


def _deflated(listed: list[list[Any]], arrays: Arrays) -> str:
    """Return the arrays in base64, each beginning at a multiple of four bytes, as typed arrays have to."""
    parts = []
    for name, kind, _ in listed:
        data = np.ascontiguousarray(arrays[name]).astype(np.dtype(kind).newbyteorder("<")).tobytes()
        parts.append(data + bytes(-len(data) % 4))
    return base64.b64encode(zlib.compress(b"".join(parts), 7)).decode()


def _thinned(recorded: Recorded, most: int) -> Recorded:
    """Return every second, third, … note, so that there are not more than so many; both ends stay."""
    stride = max(math.ceil(len(recorded.steps) / (most - 1)), 1)
    kept = sorted({0, *range(len(recorded.steps) - 1, -1, -stride)}) if len(recorded.steps) else []
    return Recorded(recorded.steps[kept], tuple(recorded.values[k] for k in kept))


def _counts(recorded: Recorded) -> NDArray[np.uint32]:
    return np.array([len(value) for value in recorded.values], np.uint32)


def _joined(recorded: Recorded, empty: tuple[int, ...]) -> NDArray[Any]:
    return np.concatenate([np.zeros(empty, np.float32), *recorded.values])


def _ranges(scans: Recorded, range_max: float) -> NDArray[np.uint8]:
    ranges = np.array(scans.values, np.float64)
    codes = np.full(ranges.shape, LOST, np.int64)
    codes[np.isinf(ranges)] = NO_RETURN
    known = np.isfinite(ranges)
    codes[known] = np.rint(np.clip(ranges[known] / range_max, 0.0, 1.0) * _RANGE_STEPS)
    return np.diff(codes, axis=1, prepend=0).astype(np.uint8)


def _ellipses(landmarks: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return ``(5, n)``: x, y [mm], semi-axes [0.1 mm], direction of the longer one [°]."""
    axes, directions = ellipses(landmarks, sigmas=1.0)
    rows = [*(1e3 * landmarks[:, :2].T), *(1e4 * axes.T), np.degrees(directions)]
    return np.clip(np.rint(rows), -(2**31), 2**31 - 1).astype(np.int32)


def _map_changes(
    changes: Recorded, origin: tuple[int, int], cols: int
) -> tuple[NDArray[np.uint32], NDArray[np.uint8], NDArray[np.uint32]]:
    """Return the gaps between changed cells, their classes, and how many cells belong to each note.

    Within a note the cells come by row, then column.
    """
    gaps, classes = [np.zeros(0, np.uint32)], [np.zeros(0, np.uint8)]
    for change in changes.values:
        row, col, now = np.asarray(change, np.int64).T
        index = (row - origin[0]) * cols + (col - origin[1])
        order = np.argsort(index)
        gaps.append(np.diff(index[order], prepend=0).astype(np.uint32))
        classes.append((now[order] + 1).astype(np.uint8))
    return np.concatenate(gaps), np.concatenate(classes), _counts(changes)


# ---- the page --------------------------------------------------------------------------------------------------


def _truth_png(ground: GroundTruth, view: View) -> str:
    image = np.empty((view.height, view.width, 3), np.uint8)
    paint_plan(Canvas(image, view), ground.plan, inverse(ground.start))
    return base64.b64encode(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()).decode()


def assets(names: Sequence[str]) -> str:
    """Return files of ``assets/``, one after the other."""
    return "".join((_ASSETS / name).read_text("utf-8") for name in names)


Tile = tuple[str, str, str]  # what it is, its figure, its unit


def first_asked(metrics: Mapping[str, Any]) -> list[Tile]:
    """Return the tiles of what one asks first."""
    return [
        ("coverage", number(metrics["coverage"], 1, factor=100.0), "%"),
        ("time", number(metrics["time_s"], 1), "s"),
        ("to 95 %", number(metrics["time_to_95_s"], 1), "s"),
        ("path", number(metrics["path_length_m"], 1), "m"),
        ("collisions", str(metrics["collisions"]), ""),
        ("ATE", number(metrics["ate_rmse_m"], 1, factor=100.0), "cm"),
        ("NEES / 3", number(metrics["anees"], 2), ""),
        ("walls, IoU", number(metrics["map_iou"], 3), ""),
    ]


def tiles(shown: Sequence[Tile]) -> str:
    """Return tiles as HTML."""
    return "".join(
        f"<div><dt>{name}</dt><dd>{value}<small>{'' if value == '–' else unit}</small></dd></div>"
        for name, value, unit in shown
    )


def metrics_table(metrics: Mapping[str, Any]) -> str:
    """Return every metric that is a number or a word, as rows of a table."""
    rows = []
    for name, value in metrics.items():
        if name in _WALL_CLOCK:
            continue
        text = "–" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
        rows.append(f"<tr><th>{escape(name)}</th><td>{name_html(text, 400)}</td></tr>")
    return "".join(rows)
