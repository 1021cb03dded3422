"""An episode from Python, and how a notebook shows what came of it."""

from __future__ import annotations

import base64
import html
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from training.episodes import explore as task
from training.episodes.recording import Recorder
from training.runs.errors import BadInput
from training.views.episode_files import write_episode

__all__ = ["Explored", "explore"]

_SHOWN = {  # key of the metrics → what it is called, its factor and unit
    "coverage": ("coverage", 100.0, "%"),
    "time_s": ("time", 1.0, "s"),
    "time_to_95_s": ("95 % covered at", 1.0, "s"),
    "path_length_m": ("path", 1.0, "m"),
    "collisions": ("collisions", 1.0, ""),
    "map_iou": ("IoU of walls", 1.0, ""),
    "final_position_error_m": ("final position error", 100.0, "cm"),
}


@dataclass(frozen=True, kw_only=True)
class Explored:
    """An episode that is over; a notebook shows its figures, its map and the truth."""

    metrics: dict[str, Any]  # the contents of metrics.json
    out: Path  # where its files are, report.html among them

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{name}</th><td>{_text(self.metrics[key], factor, unit)}</td></tr>"
            for key, (name, factor, unit) in _SHOWN.items()
        )
        pictures = "".join(
            f"<figure style='display:inline-block;margin:0 1% 0 0;width:48%'>"
            f"<img src='{_data_uri(self.out / file)}' alt='{what}' style='width:100%'>"
            f"<figcaption>{what}</figcaption></figure>"
            for file, what in (("map.png", "what it believes"), ("truth.png", "what is so"))
        )
        report = html.escape(str(self.out / "report.html"))
        return f"<div>{pictures}<table>{rows}</table><p>Replayed in <code>{report}</code></p></div>"


def explore(
    *, out: str | Path = "out/explore", agent: str | None = None, rooms: str | None = None,
    slam: str | None = None, seed: int | None = None, floor_plan: str | Path | None = None,
    start: tuple[float, float, float] | None = None, robot: str | None = None, noise: str | None = None,
    config: str | Path | None = None, max_steps: int | None = None, coverage_target: float | None = None,
) -> Explored:  # fmt: skip
    """Let an agent explore for one episode, write its files into ``out``, and return what came of it.

    Parameters
    ----------
    out, agent, rooms, slam, seed, floor_plan, start, robot, noise, config, max_steps, coverage_target
        As the options of ``mecanum explore``; of what is None the config file or the default decides.

    Raises
    ------
    ValueError
        For a name, number or file that cannot be used; the message says which, and what is valid.
    """
    try:
        episode = task.prepare(
            out=Path(out), agent=agent, rooms=rooms, slam=slam, robot=robot, noise=noise, seed=seed,
            floor_plan=None if floor_plan is None else Path(floor_plan), start=start,
            config=None if config is None else Path(config), max_steps=max_steps, coverage_target=coverage_target,
        )  # fmt: skip
    except BadInput as error:
        raise ValueError(str(error)) from error
    recorder = Recorder()
    task.run(episode, lambda **_: None, [recorder])
    return Explored(metrics=write_episode(episode, recorder.recording()), out=Path(out))


def _text(value: Any, factor: float, unit: str) -> str:
    if value is None:
        return "–"
    return f"{value} {unit}" if isinstance(value, int) else f"{factor * value:.3g} {unit}"


def _data_uri(picture: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}"
