"""The README's moving picture: ``mecanum study moving-picture --out docs/images/explore.gif``.

An episode until it reaches a coverage, truth beside belief, several times as fast as true.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

from training.episodes import explore
from training.runs.errors import Interrupted, check_writable
from training.runs.options import Seed
from training.views.film import Camera, check_video, film

__all__ = ["moving_picture", "study"]

_SPEED = 4  # times as fast as true
_WIDTH = 800  # pixels, even: colours are kept for two
_UNTIL = 0.97  # coverage
_STOPS_S = 2.5  # shown at the end before it begins anew
# One palette for all frames; without dithering what does not move costs nothing.
_FILTER = (
    "split[a][b];[a]palettegen=max_colors=64:stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
)


def moving_picture(episode: explore.Episode, path: Path) -> int:
    """Write an animated GIF of an episode until it has explored nearly all; return the number of frames."""
    frames: list[NDArray[np.uint8]] = []

    def keep(frame: NDArray[np.uint8]) -> None:
        height = 2 * round(_WIDTH * frame.shape[0] / frame.shape[1] / 2)
        frames.append(np.asarray(cv2.resize(frame, (_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8))

    camera = Camera(keep, speed=_SPEED)

    def stop_there(*, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
        if coverage >= _UNTIL:
            raise _Enough

    with suppress(_Enough):
        explore.run(episode, stop_there, [camera])
    if episode.interrupted:
        raise Interrupted("interrupted; no picture was written")
    fps = 1.0 / episode.config.step_s
    frames += frames[-1:] * round(_STOPS_S * fps)
    with film(path, fps=fps, how=("-vf", _FILTER, "-loop", "0")) as write:
        for frame in frames:
            write(frame)
    return len(frames)


class _Enough(Exception):
    """The coverage is reached."""


def study(
    agent: Annotated[str, typer.Option(help="Who explores.")] = "brisk-tour",
    rooms: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    seed: Seed = 4,
    out: Annotated[Path, typer.Option(metavar="FILE.gif")] = Path("out/explore.gif"),
) -> None:
    """Make the README's moving picture of one episode."""
    check_video()
    check_writable(out.parent, [out.name])
    episode = explore.prepare(out=out.parent, agent=agent, rooms=rooms, seed=seed)
    out.parent.mkdir(parents=True, exist_ok=True)
    count = moving_picture(episode, out)
    print(f"{out}: {count} frames, {out.stat().st_size / 1e6:.1f} MB")
