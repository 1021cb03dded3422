"""The report of a team's episode: the page of one robot's, with all robots in it, each in its colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mecanum_env.team.picture import colour_of
from mecanum_env.views.canvas import View
from mecanum_env.views.paint import extent_of_truth, with_margin
from training.episodes.recording import Recording
from training.episodes.team import TeamEpisode
from training.figures.page import text_html
from training.figures.tables import number
from training.views.report_page import (
    TRUTH_PX,
    about_plan,
    assets,
    filled,
    first_asked,
    metrics_table,
    pack,
    tiles,
)

__all__ = ["colour", "team_page"]

_SCRIPTS = ("recording.js", "plan_canvas.js", "curves.js", "team.js", "player.js")

# Of each robot: the heading of its column, the metric's name, from its unit to the one shown, digits.
_COLUMNS = (
    ("own map covers [%]", "coverage", 100.0, 1), ("saw first [%]", "first_share", 100.0, 1),
    ("path [m]", "path_length_m", 1.0, 1), ("collisions", "collisions", 1.0, 0),
    ("with robots", "robot_collisions", 1.0, 0), ("ATE [cm]", "ate_rmse_m", 100.0, 2),
    ("final error [cm]", "final_position_error_m", 100.0, 2), ("NEES / 3", "anees", 1.0, 2),
    ("health", "health_mean", 1.0, 2), ("landmarks", "landmarks", 1.0, 0),
)  # fmt: skip


def team_page(
    episode: TeamEpisode, recordings: Sequence[Recording], *, title: str, metrics: Mapping[str, Any], ending: str,
    config: str,
) -> str:  # fmt: skip
    """Return the page; parameters as of :func:`training.views.report_page.episode_page`."""
    team, log = episode.team, episode.log
    n = len(recordings)
    arrays: dict[str, NDArray[Any]] = {
        "coverage": log.coverage.astype(np.float32),
        "collisions": np.minimum(log.collisions, 65535).astype(np.uint16),
        "group": log.groups.astype(np.uint8),
    }
    robots = []
    for k, (recording, frame) in enumerate(zip(recordings, team.frames, strict=True)):
        header, own = pack(recording, robots=n)
        header["arrays"] = [[f"{k}.{name}", kind, size] for name, kind, size in header["arrays"]]
        arrays |= {f"{k}.{name}": values for name, values in own.items()}
        robots.append(header | {"colour": colour(k), "frame": frame.tolist()})
    listed = [[name, array.dtype.name, array.size] for name, array in arrays.items()]
    view = View.around(with_margin(extent_of_truth(team.ground)), longest_px=TRUTH_PX)
    header = {
        "step_s": episode.config.step_s, "rows": len(log.times), "robots": robots, "arrays": listed,
        **about_plan(episode.config, team.ground, view),
    }  # fmt: skip
    return filled("team.html", header, arrays, {
        "TITLE": text_html(title),
        "ENDING": text_html(ending),
        "TILES": tiles([("robots", str(n), ""), *first_asked(metrics)]),
        "ROBOTS": _robots_table(metrics["per_robot"]),
        "MAPS": "".join(f'<option value="{k}">robot {k}</option>' for k in range(n)),
        "METRICS": metrics_table({key: v for key, v in metrics.items() if key != "per_robot"}),
        "CONFIG": text_html(config),
        "SCRIPT": assets(_SCRIPTS),
    }, style="".join(f".robot-{k} {{ --c: {colour(k)} }}\n" for k in range(n)))  # fmt: skip


def colour(robot: int) -> str:
    """Return a robot's colour as a page has it."""
    blue, green, red = colour_of(robot)
    return f"#{red:02x}{green:02x}{blue:02x}"


def _robots_table(robots: Sequence[Mapping[str, Any]]) -> str:
    """Return a row a robot, with its colour before its name."""
    head = "".join(f"<th>{escape(heading)}</th>" for heading in ("", *(heading for heading, *_ in _COLUMNS)))
    rows = "".join(
        f'<tr><th><span class="key robot-{k}"></span>robot&nbsp;{k}</th>'
        + "".join(f"<td>{number(robot[name], digits, factor=factor)}</td>" for _, name, factor, digits in _COLUMNS)
        + "</tr>"
        for k, robot in enumerate(robots)
    )
    return f"<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
