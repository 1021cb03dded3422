"""The README's moving picture: ``python -m training.views.moving_picture --out docs/images/explore.gif``.

An episode until it reaches a coverage, truth beside belief, several times as fast as true.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.formats import replacing
from training.episodes import explore
from training.runs.errors import BadInput, Interrupted
from training.views.film import Camera, check_video

__all__ = ["main", "moving_picture"]

_STOPS_S = 2.5  # shown at the end before it begins anew
# One palette for all frames; without dithering what does not move costs nothing.
_FILTER = (
    "split[a][b];[a]palettegen=max_colors=64:stats_mode=full[p];[b][p]paletteuse=dither=none:diff_mode=rectangle"
)


def moving_picture(options: explore.ExploreOptions, path: Path, *, speed: int, width: int, until: float) -> int:
    """Write an animated GIF of an episode until its coverage is ``until``; return the number of frames."""
    frames: list[NDArray[np.uint8]] = []
    episode = explore.prepare(options)

    def keep(frame: NDArray[np.uint8]) -> None:
        height = 2 * round(width * frame.shape[0] / frame.shape[1] / 2)
        frames.append(np.asarray(cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA), np.uint8))

    camera = Camera(keep, speed=speed)

    def stop_there(*, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
        if coverage >= until:
            raise _Enough

    with suppress(_Enough):
        explore.run(episode, stop_there, [camera])
    if episode.interrupted:
        raise Interrupted("interrupted; no picture was written")
    fps = 1.0 / episode.config.step_s
    frames += frames[-1:] * round(_STOPS_S * fps)
    with replacing(path) as temporary:
        command = [
            check_video(), "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-video_size", f"{width}x{frames[0].shape[0]}", "-framerate", f"{fps:g}", "-i", "pipe:0",
            "-vf", _FILTER, "-loop", "0", f"file:{temporary}",
        ]  # fmt: skip
        subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), check=True)
    return len(frames)


class _Enough(Exception):
    """The coverage is reached."""


def main(argv: list[str] | None = None) -> int:
    """Run the module's command line; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m training.views.moving_picture", description=__doc__)
    parser.add_argument("--agent", default="brisk-tour")
    parser.add_argument("--rooms", default="apartment")
    parser.add_argument("--seed", type=int, default=4)
    parser.add_argument("--speed", type=int, default=4)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--until", type=float, default=0.97, help="coverage")
    parser.add_argument("--out", type=Path, default=Path("out/explore.gif"))
    options = parser.parse_args(argv)
    try:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        given = explore.ExploreOptions(
            out=options.out.parent, agent=options.agent, rooms=options.rooms, seed=options.seed
        )
        count = moving_picture(given, options.out, speed=options.speed, width=options.width, until=options.until)
    except (BadInput, ValueError, OSError, subprocess.CalledProcessError) as error:
        print(f"moving_picture: {error}", file=sys.stderr)
        return 2
    except (Interrupted, KeyboardInterrupt) as error:
        print(f"moving_picture: {error or 'interrupted'}", file=sys.stderr)
        return 130
    print(f"{options.out}: {count} frames, {options.out.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
