"""Films: of the right codec, size and length, with the frames that were given, whole or not there at all."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

import mecanum_env  # noqa: F401 - registers the environments
from mecanum_env.config import EnvConfig
from mecanum_env.env import ExploreEnv
from mecanum_env.views.render import FRAME_SHAPE, render_frame
from slam.geometry import compose, exp, inverse, log
from tests.training.recorded_episode import explore
from training.cli import main
from training.runs.errors import BadInput
from training.views.film import Camera, check_video, film, film_episode, filmed

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

ROOT = Path(__file__).resolve().parents[3]
Image = NDArray[np.uint8]


def frames_of(path: Path) -> tuple[dict[str, Any], list[Image]]:
    """Return what ffmpeg says of a film, and its frames."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]


def colours(n: int, shape: tuple[int, int] = (64, 96)) -> list[Image]:
    """Return frames of one colour each, none like the one before."""
    values = np.random.default_rng(0).integers(30, 220, (n, 3))
    return [np.broadcast_to(v, (*shape, 3)).astype(np.uint8) for v in values]


class Shots:
    """Keeps the frames it is given."""

    def __init__(self) -> None:
        self.frames: list[Image] = []

    def __call__(self, frame: Image) -> None:
        self.frames.append(frame)


def test_an_episode_becomes_a_film_that_browsers_play(tmp_path: Path) -> None:
    path = tmp_path / "episode.mp4"
    with film_episode(path, EnvConfig()) as camera:
        episode = explore(camera, steps=20)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 21
    assert seconds == pytest.approx(2.1, abs=0.02)  # a tenth of a second each, the start among them: true speed
    meta, pictures = frames_of(path)
    assert meta["codec"] == "h264" and meta["pix_fmt"].startswith("yuv420p(tv, bt709")
    assert meta["fps"] == 10.0 and meta["size"] == FRAME_SHAPE[::-1]
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # faststart: the index comes first
    plain = pictures[-1].astype(int) - render_frame(episode.env)
    assert np.median(np.abs(plain)) <= 2
    assert [p.name for p in tmp_path.iterdir()] == ["episode.mp4"]


def test_a_film_keeps_its_frames_colours_and_order(tmp_path: Path) -> None:
    given = colours(30)
    with film(tmp_path / "f.mp4", fps=25) as write:
        for frame in given:
            write(frame)
    meta, pictures = frames_of(tmp_path / "f.mp4")
    assert meta["fps"] == 25.0 and len(pictures) == 30
    for before, after in zip(given, pictures, strict=True):
        assert np.abs(before[32, 48].astype(int) - after[32, 48]).max() <= 6


def test_faster_films_leave_frames_out() -> None:
    every, third = Shots(), Shots()
    explore(Camera(every), steps=12)
    explore(Camera(third, speed=3), steps=12)
    assert len(every.frames) == 13 and len(third.frames) == 5
    for kept, frame in zip(third.frames, every.frames[::3], strict=True):
        np.testing.assert_array_equal(kept, frame)


def test_frames_between_steps_interpolate_the_world_and_keep_the_belief() -> None:
    whole, fine = Shots(), Shots()
    explore(Camera(whole), steps=12)
    explore(Camera(fine, substeps=5), steps=12)
    assert len(fine.frames) == 12 * 5 + 1
    for step, frame in enumerate(whole.frames):
        np.testing.assert_array_equal(fine.frames[5 * step], frame)
    middle = FRAME_SHAPE[1] // 2
    for step in range(12):
        before = fine.frames[5 * step]
        for frame in fine.frames[5 * step + 1 : 5 * step + 5]:
            np.testing.assert_array_equal(frame[:, middle:], before[:, middle:])
    moved = [
        not np.array_equal(a[44:660, :middle], b[44:660, :middle])
        for a, b in zip(fine.frames[30:], fine.frames[31:], strict=False)
    ]
    assert all(moved)


def test_interpolated_poses_are_close_to_the_physics() -> None:
    # A control step for each step of the physics: what is between every fifth is known.
    env: Any = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular", config={"step_s": 0.02}).unwrapped
    env.reset(seed=3)
    action, poses = np.array([0.6, 0.3, 0.5], np.float32), [env.truth.pose]
    for k in range(50):
        env.step(action if k < 25 else -action)
        poses.append(env.truth.pose)
    for k in range(0, 50, 5):
        twist = log(compose(inverse(poses[k]), poses[k + 5]))
        for j in range(1, 5):
            between = compose(poses[k], exp(j / 5 * twist))
            # From rest, and from 0.5 m/s to as much backwards; a pixel of the film is more than a centimetre.
            assert np.hypot(*(between - poses[k + j])[:2]) < 0.005


def test_a_film_of_nothing_or_of_wrong_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one frame"), film(tmp_path / "f.mp4", fps=10):
        pass
    wrong = [np.zeros((64, 97, 3), np.uint8), np.zeros((64, 96, 4), np.uint8), np.zeros((64, 96, 3))]
    for frame in wrong:
        with pytest.raises(ValueError, match="frame"), film(tmp_path / "f.mp4", fps=10) as write:
            write(frame)
    with pytest.raises(ValueError, match="one size"), film(tmp_path / "f.mp4", fps=10) as write:
        write(colours(1)[0])
        write(colours(1, (32, 32))[0])
    with pytest.raises(ValueError, match="more than 0"), film(tmp_path / "f.mp4", fps=0):
        pass
    with pytest.raises(ValueError, match="1 or more"):
        Camera(Shots(), speed=0)
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_the_film_of_before(tmp_path: Path) -> None:
    path = tmp_path / "f.mp4"
    path.write_bytes(b"an earlier one")
    with pytest.raises(ZeroDivisionError), film(path, fps=10) as write:
        write(colours(1)[0])
        raise ZeroDivisionError
    assert path.read_bytes() == b"an earlier one"
    assert [p.name for p in tmp_path.iterdir()] == ["f.mp4"]


def test_what_ffmpeg_cannot_write_is_said(tmp_path: Path) -> None:
    path = tmp_path / "film.nonsense"  # the suffix says the format
    with pytest.raises(OSError, match=r"cannot write the film: ffmpeg: .*"), film(path, fps=10) as write:
        for frame in colours(400, (320, 480)):
            write(frame)
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cannot_begin_ends_no_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise OSError(12, "Cannot allocate memory")

    env = ExploreEnv(rooms="rectangular", slam="odometry")
    env.reset(seed=0)
    monkeypatch.setattr("training.views.film.subprocess.Popen", refused)
    with filmed(tmp_path, env.config) as made:
        for _ in range(3):
            made.take(env, None)
        assert made.finish() is None and made.failure is not None


@pytest.mark.skipif(sys.platform == "win32", reason="sends the signal of Ctrl-C")
def test_ctrl_c_keeps_the_film_so_far(tmp_path: Path) -> None:
    # Sent to the whole group, as a terminal does: ffmpeg must not hear of it.
    script = (
        "import sys, time\nimport numpy as np\nfrom training.views.film import film\n"
        "with film('f.mp4', fps=10) as write:\n"
        "    for k in range(10**6):\n"
        "        write(np.full((64, 96, 3), 40 + k % 200, np.uint8))\n"
        "        if k == 50: print('running', flush=True)\n"
        "        time.sleep(0.005)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
        start_new_session=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "running\n"
    time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert "KeyboardInterrupt" in said
    assert [p.name for p in tmp_path.iterdir()] == ["f.mp4"]
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "f.mp4"))
    assert frames >= 51


def test_without_the_library_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(BadInput, match=r"pip install 'mecanum-slam\[video\]'"):
        check_video()


def test_gymnasiums_own_recorder_films_the_environment(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    made = gymnasium.make("mecanum_env/Explore-v0", rooms="rectangular", render_mode="rgb_array")
    env = gymnasium.wrappers.RecordVideo(made, str(tmp_path), episode_trigger=lambda _: True, disable_logger=True)
    env.reset(seed=3)
    for _ in range(10):
        env.step(np.array([0.5, 0.0, 0.2], np.float32))
    env.close()
    (path,) = tmp_path.glob("*.mp4")
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    # Eleven were recorded; moviepy counts them by a sum of tenths, which may fall short of 1.1 s.
    assert frames in (10, 11) and seconds == pytest.approx(frames / 10, abs=0.02)
    assert frames_of(path)[0]["size"] == FRAME_SHAPE[::-1]


def test_the_readme_s_picture_says_at_once_what_it_cannot_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("training.episodes.explore.run", None)  # nothing is explored before
    out = tmp_path / "explore.gif"
    out.mkdir()
    assert main(["study", "moving-picture", "--out", str(out)]) == 2
    assert "it is a folder" in capsys.readouterr().err
