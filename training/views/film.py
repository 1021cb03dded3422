"""The film of an episode: truth beside belief, at true speed or a multiple of it, as an MP4 that browsers play."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mecanum_env.team.picture import render_team
from mecanum_env.views.render import render_frame
from slam.formats import replacing
from slam.geometry import compose, exp, inverse, log
from training.runs.errors import BadInput, needs_extra

if TYPE_CHECKING:
    from agents.base import Goal
    from mecanum_env.config import EnvConfig
    from mecanum_env.env import ExploreEnv
    from mecanum_env.team.team import Team

__all__ = ["Camera", "Film", "TeamCamera", "check_video", "film", "film_episode", "filmed"]

Image = NDArray[np.uint8]
Write = Callable[[Image], None]

_KEY_FRAME_S = 2.0  # how far apart the frames are that a player can jump to
# Players take a film of this size for BT.709; ffmpeg on its own would write BT.601 and not say so.
_H264 = (
    "-vf", "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709",
    "-c:v", "libx264", "-pix_fmt", "yuv420p", "-preset", "veryfast", "-crf", "23", "-movflags", "+faststart",
)  # fmt: skip


class Camera:
    """Makes an episode's frames, and hands each to ``write``: a witness of :func:`training.episodes.explore.run`.

    Parameters
    ----------
    write : callable
        Takes a frame ``(h, w, 3)``, RGB.
    speed : int
        Keep one frame in so many.
    substeps : int
        Frames a control step, of which the last shows it as it is. The others are *interpolated*: what the
        simulation does between control steps is not known out here. The true pose goes along the screw from one
        step's to the next, and the scan shown is what a lidar without noise would see from there; the belief,
        which changes only with a control step, stays the one before.
    """

    def __init__(self, write: Write, *, speed: int = 1, substeps: int = 1) -> None:
        if speed < 1 or substeps < 1:
            raise ValueError(f"a film's speed and substeps are 1 or more, got {speed} and {substeps}")
        self._write, self._speed, self._substeps = write, speed, substeps
        self._count = 0  # frames so far, with those left out
        self._last: Image | None = None

    def take(self, env: ExploreEnv, goal: Goal | None) -> None:
        """Film the environment as it is after ``reset`` or a step."""
        if self._last is not None:
            for k in range(1, self._substeps):
                if self._due():
                    self._write(_frame_between(env, k / self._substeps, self._last))
        due = self._due()
        if due or self._substeps > 1:  # the frames between the next two steps have this one's belief
            self._last = render_frame(env, planned_path=None if goal is None else goal.path)
        if due and self._last is not None:
            self._write(self._last)

    def _due(self) -> bool:
        count, self._count = self._count, self._count + 1
        return count % self._speed == 0


class TeamCamera:
    """Makes the frames of a team's episode: a witness of :func:`training.episodes.team.run`."""

    def __init__(self, write: Write) -> None:
        self._write = write

    def take(self, team: Team, goals: Sequence[Goal | None]) -> None:
        """Film the team as it is after ``reset`` or a step."""
        self._write(render_team(team))


@contextmanager
def film_episode(
    path: str | Path, config: EnvConfig, *, speed: int = 1, substeps: bool = False
) -> Iterator[Camera]:
    """Give a camera whose film is at ``path`` when the block ends; see :func:`film`.

    Parameters
    ----------
    path : path
        The file, ``.mp4``.
    config : EnvConfig
        The environment's: its steps make the film's frame rate.
    speed : int
        How many times as fast as true; frames are left out.
    substeps : bool
        A frame for every step of the physics instead of every control step; those between are interpolated,
        see :class:`Camera`.
    """
    per_step = round(config.step_s / config.physics_step_s) if substeps else 1
    with film(path, fps=per_step / config.step_s) as write:
        yield Camera(write, speed=speed, substeps=per_step)


class Film:
    """A camera whose film may fail: then it films no more, and what it was told of the episode goes on."""

    def __init__(self, path: Path, camera: Camera | TeamCamera, stack: ExitStack) -> None:
        self._path, self._camera, self._open = path, camera, stack
        self.failure: OSError | None = None

    def take(self, filmed: Any, goal: Any) -> None:
        """Film the environment, or the team, as it is after ``reset`` or a step."""
        if self.failure is None:
            try:
                self._camera.take(filmed, goal)
            except OSError as error:
                self.failure = error

    def finish(self) -> Path | None:
        """Return where the film is, or ``None`` where there is none: see ``failure``."""
        try:
            self._open.close()
        except OSError as error:
            self.failure = self.failure or error
        except ValueError:  # of a film that could not be begun, and has no frame
            if self.failure is None:
                raise
        return self._path if self.failure is None else None


@contextmanager
def filmed(out: Path, config: EnvConfig, *, substeps: bool = False, team: bool = False) -> Iterator[Film]:
    """Give a :class:`Film` that is made in a folder within ``out``, which goes when the block ends."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".filming-", dir=out) as folder, ExitStack() as stack:
        path = Path(folder) / "episode.mp4"
        if team:
            camera: Camera | TeamCamera = TeamCamera(stack.enter_context(film(path, fps=1.0 / config.step_s)))
        else:
            camera = stack.enter_context(film_episode(path, config, substeps=substeps))
        yield Film(path, camera, stack)


@contextmanager
def film(path: str | Path, *, fps: float, how: Sequence[str] = _H264) -> Iterator[Write]:
    """Give a function that takes a film's frames; the film is at ``path`` when the block ends.

    It is H.264 in 4:2:0, with its index in front, as browsers want it, or what ffmpeg's options ``how`` make of
    it. Frames are arrays ``(h, w, 3)`` of uint8, RGB, all of one size, either side even. The film is written
    beside its place and then renamed. Ctrl-C in the block keeps it as far as it came; any other exception leaves
    nothing.

    Raises
    ------
    BadInput
        Where ``imageio-ffmpeg`` is missing.
    ValueError
        Where a frame is not what a film takes, or there was none.
    OSError
        Where the film cannot be written: what ffmpeg said.
    """
    program = check_video()
    if not fps > 0:
        raise ValueError(f"a film has more than 0 frames a second, got {fps}")
    interrupted: KeyboardInterrupt | None = None
    with replacing(path) as temporary:
        encoder = _Encoder(program, temporary, fps, how)
        try:
            try:
                yield encoder.write
            except KeyboardInterrupt as error:
                if not encoder.started:
                    raise
                interrupted = error
            encoder.finish()
        except BaseException:  # a second Ctrl-C among them
            encoder.kill()
            raise
    if interrupted is not None:
        raise interrupted


def check_video() -> str:
    """Return the path of ffmpeg; raise :class:`BadInput` where it is missing, before an episode is run in vain."""
    with needs_extra("video", "a film"):
        import imageio_ffmpeg
    try:
        program = str(imageio_ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise BadInput(f"a film needs ffmpeg, and there is none for this machine: {error}") from error
    if shutil.which(program) is None:
        raise BadInput(f"a film needs ffmpeg, and {program} is none; see IMAGEIO_FFMPEG_EXE")
    return program


class _Encoder:
    """ffmpeg as a process of its own, fed frame by frame; started by the first, which sets the size."""

    def __init__(self, program: str, path: Path, fps: float, how: Sequence[str]) -> None:
        self._program, self._path, self._how = program, path, how
        self._rate = Fraction(fps).limit_denominator(1001)
        self._shape: tuple[int, ...] = ()

    @property
    def started(self) -> bool:
        return bool(self._shape)

    def write(self, frame: Image) -> None:
        if not self.started:
            self._start(frame)
        elif frame.shape != self._shape:
            raise ValueError(f"the frames of a film are of one size: {self._shape}, now {frame.shape}")
        try:
            self._pipe.write(np.ascontiguousarray(frame, np.uint8).data)
        except BrokenPipeError as error:
            raise self._failure() from error

    def _start(self, frame: Image) -> None:
        if frame.ndim != 3 or frame.dtype != np.uint8 or frame.shape[2] != 3:
            raise ValueError(f"a frame is RGB, (h, w, 3) of uint8; got {frame.shape} of {frame.dtype}")
        height, width, _ = frame.shape
        if height % 2 or width % 2:
            raise ValueError(
                f"colours are kept for blocks of four pixels: a frame's sides are even, not {frame.shape}"
            )
        command = [
            self._program, "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
            "-video_size", f"{width}x{height}", "-framerate", str(self._rate), "-i", "pipe:0",
            "-g", str(max(1, round(_KEY_FRAME_S * self._rate))), *self._how, f"file:{self._path}",
        ]  # fmt: skip
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process; a pipe could fill up
        # In a group of its own: Ctrl-C at the keyboard is for the episode, which then ends the film.
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._said, start_new_session=True
        )
        assert self._process.stdin is not None
        self._pipe = self._process.stdin
        self._shape = frame.shape

    def finish(self) -> None:
        """Wait for the film to be whole."""
        if not self.started:
            raise ValueError("a film has at least one frame")
        with suppress(BrokenPipeError):
            self._pipe.close()
        if self._process.wait() != 0:
            raise self._failure()
        self._said.close()

    def kill(self) -> None:
        if self.started:
            self._process.kill()
            self._process.wait()
            with suppress(BrokenPipeError):
                self._pipe.close()
            self._said.close()

    def _failure(self) -> OSError:
        self._process.wait()
        self._said.seek(0)
        lines = self._said.read().decode(errors="replace").strip().splitlines()
        return OSError(f"cannot write the film: ffmpeg: {lines[-1] if lines else 'ended without a word'}")


def _frame_between(env: ExploreEnv, share: float, before: Image) -> Image:
    """Return a frame a share of the way through the last step: the world's half of it interpolated."""
    truth, config = env.truth, env.config
    ground, record = truth.ground, truth.record
    last, now = record.true_poses[-2:]
    pose = compose(last, exp(share * log(compose(inverse(last), now))))
    ranges = env.lidar.true_ranges(ground.plan.segments, ground.plan.circles, compose(ground.start, pose))
    so_far = SimpleNamespace(
        true_poses=np.vstack([record.true_poses[:-1], pose]),
        estimates=record.estimates[:-1],
        coverage=record.coverage[:-1],
        times=np.append(record.times[:-1], record.times[-2] + share * config.step_s),
        path_length_m=record.path_length_m - (1.0 - share) * float(np.hypot(*(now - last)[:2])),
        collisions=record.collisions,
    )
    moment = SimpleNamespace(
        config=config, belief=env.belief,
        truth=SimpleNamespace(ground=ground, record=so_far, pose=pose, scan=truth.scan._replace(ranges=ranges)),
    )  # fmt: skip
    frame = render_frame(moment)
    middle = frame.shape[1] // 2  # the belief, on the right
    frame[:, middle:] = before[:, middle:]
    return frame
