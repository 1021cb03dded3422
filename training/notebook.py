"""An episode from Python, and how a notebook shows what came of it."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mecanum_env.config import Steps
from slam.files import quoted
from slam.settings import PositiveShare, Seed, checked, require
from training.episodes.team import read_team
from training.runs.errors import BadInput
from training.views.episode_files import spare_the_plan
from training.views.team_files import kind_of

__all__ = ["Explored", "explore"]

_SHOWN = {  # key of the metrics → what it is called, its factor and unit
    "coverage": ("coverage", 100.0, "%"),
    "time_s": ("time", 1.0, "s"),
    "time_to_95_s": ("95 % covered at", 1.0, "s"),
    "path_length_m": ("path", 1.0, "m"),
    "collisions": ("collisions", 1.0, ""),
    "map_iou": ("IoU of walls", 1.0, ""),
    "final_position_error_m": ("final position error", 100.0, "cm"),
    "robot_collisions": ("collisions of robots", 1.0, ""),
}
_PICTURES = {
    "map.png": "what it believes",
    "truth.png": "what is so",
    "team.png": "what is so, what they have mapped",
}


@dataclass(frozen=True, kw_only=True)
class Explored:
    """An episode that is over; a notebook shows its figures, its map and the truth."""

    metrics: dict[str, Any]  # the contents of metrics.json
    out: Path  # where its files are, report.html among them
    _pictures: dict[str, str] = field(init=False, repr=False)  # as they are now: the next episode has others there

    def __post_init__(self) -> None:
        found = {what: self.out / file for file, what in _PICTURES.items()}
        pictures = {what: _data_uri(path) for what, path in found.items() if path.exists()}
        object.__setattr__(self, "_pictures", pictures)

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{name}</th><td>{_text(self.metrics[key], factor, unit)}</td></tr>"
            for key, (name, factor, unit) in _SHOWN.items()
            if key in self.metrics
        )
        pictures = "".join(
            f"<figure style='display:inline-block;margin:0 1% 0 0;width:48%'>"
            f"<img src='{uri}' alt='{what}' style='width:100%'>"
            f"<figcaption>{what}</figcaption></figure>"
            for what, uri in self._pictures.items()
        )
        report = html.escape(str(self.out / "report.html"))
        return f"<div>{pictures}<table>{rows}</table><p>Replayed in <code>{report}</code></p></div>"


def explore(
    *, out: str | Path = "out/explore", agent: str | None = None, rooms: str | None = None,
    slam: str | None = None, seed: int | None = None, floor_plan: str | Path | None = None,
    start: tuple[float, float, float] | None = None, robot: str | None = None, noise: str | None = None,
    config: str | Path | None = None, max_steps: int | None = None, coverage_target: float | None = None,
    robots: int | None = None, communication: str | None = None, range_m: float | None = None,
    starts: str | None = None, unknown_starts: bool = False, joint_belief: bool = False,
) -> Explored:  # fmt: skip
    """Let an agent explore for one episode, write its files into ``out``, and return what came of it.

    Parameters
    ----------
    out, agent, rooms, slam, seed, floor_plan, start, robot, noise, config, max_steps, coverage_target
        As the options of ``mecanum explore``; of what is None the config file or the default decides.
    robots, communication, range_m, starts, unknown_starts, joint_belief
        The same, of several robots that explore together (``docs/how-to/teams.md``).

    Raises
    ------
    ValueError
        For a name, number or file that cannot be used; the message says which, and what is valid.
    """
    given: dict[str, Any] = {
        "out": _path("out", out), "agent": agent, "rooms": rooms, "slam": slam, "robot": robot, "noise": noise,
        "seed": checked("seed", Seed | None, seed), "floor_plan": _path("floor_plan", floor_plan),
        "start": checked("start", tuple[float, float, float] | None, start),
        "config": _path("config", config), "max_steps": checked("max_steps", Steps | None, max_steps),
        "coverage_target": checked("coverage_target", PositiveShare | None, coverage_target),
    }  # fmt: skip
    try:
        team = read_team(
            given["config"], robots=robots, communication=communication, range_m=range_m, starts=starts,
            unknown_starts=checked("unknown_starts", bool, unknown_starts),
            joint_belief=checked("joint_belief", bool, joint_belief),
        )  # fmt: skip
        kind = kind_of(team)
        episode = kind.prepare(**given)
        spare_the_plan(episode)
    except BadInput as error:
        raise ValueError(str(error)) from error
    recorder = kind.recorder()
    kind.run(episode, lambda **_: None, [recorder])
    return Explored(metrics=kind.write(episode, recorder.recording()), out=given["out"])


def _path(name: str, given: str | Path | None) -> Path | None:
    require(given is None or isinstance(given, str | Path), f"{name} must be a path, got {quoted(given)}")
    return None if given is None else Path(given)


def _text(value: Any, factor: float, unit: str) -> str:
    if value is None:
        return "–"
    if isinstance(value, int):
        return f"{value} {unit}"
    shown = factor * value
    return f"{shown:.0f} {unit}" if abs(shown) >= 999.5 else f"{shown:.3g} {unit}"


def _data_uri(picture: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}"
