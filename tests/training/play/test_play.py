"""``mecanum play``: the session, its pictures, and the window; SDL's dummy driver is the screen."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import slam
from mecanum_env import rooms
from mecanum_env.views.render import render_frame
from tests.training.plans import write_room
from training.cli import main
from training.play.controls import Command
from training.play.picture import PICTURE_SHAPE, _shortened, play_picture
from training.play.session import Session
from training.runs.errors import BadInput, Interrupted

FAST = 1000.0  # times true speed
REST = np.zeros(3, np.float32)


def session(**options: Any) -> Session:
    return Session(**({"rooms": "rectangular"} | options))


# ---- the session: no window is needed ---------------------------------------------------------------------------


def test_commands_change_what_they_say_and_nothing_else(tmp_path: Path) -> None:
    played = session(slam="truth", seed=4)
    plan = played.env.truth.plan
    played.step(np.array([1, 0, 0], np.float32))
    played.obey(Command.NEXT_BACKEND)
    backends = slam.names()
    assert played.config.slam == backends[backends.index("truth") + 1] == played.env.config.slam
    assert played.env.truth.plan.name == plan.name and played.info["time_s"] == 0.0
    played.obey(Command.NEXT_ROOM)
    assert played.env.truth.plan.name == "rectangular-5" and played.place == "rectangular, seed 5"
    played.obey(Command.PREVIOUS_ROOM)
    assert played.env.truth.plan.name == "rectangular-4"
    played.step(np.array([1, 0, 0], np.float32))
    played.obey(Command.RESTART)
    assert played.info["time_s"] == 0.0 and played.env.truth.plan.name == "rectangular-4"
    assert np.array_equal(played.env.truth.plan.walls, plan.walls)


def test_the_first_room_has_none_before_it() -> None:
    played = session()
    played.obey(Command.PREVIOUS_ROOM)
    assert played.seed == 0
    last = session(seed=2**31 - 1)
    last.obey(Command.NEXT_ROOM)
    assert last.seed == 2**31 - 1


def test_kinds_of_rooms_go_round_a_plan_from_a_file_among_them(tmp_path: Path) -> None:
    played = session(rooms=None, floor_plan=write_room(tmp_path / "room.png"), slam="odometry")
    seen = [played.place]
    for _ in range(len(rooms.names()) + 1):
        played.obey(Command.NEXT_KIND)
        seen.append(played.place)
    assert seen == [f"{kind}, seed 0" for kind in ("room.png", *rooms.names(), "room.png")]


def test_what_cannot_be_started_leaves_the_episode_as_it_is(tmp_path: Path) -> None:
    file = write_room(tmp_path / "room.png")
    played = session(rooms=None, floor_plan=file)
    played.step(np.array([1, 0, 0], np.float32))
    file.unlink()
    env = played.env
    played.obey(Command.NEXT_ROOM)
    assert played.env is env and played.seed == 0 and "room.png" in played.driver_note
    played.step(REST)
    played.obey(Command.HAND_OVER)
    assert "room.png" not in played.driver_note


def test_an_agent_drives_and_hands_back() -> None:
    played = session()
    assert (played.driver, played.driver_note) == ("You drive", "Space: let nearest-frontier drive")
    assert played.planned_path is None
    played.obey(Command.HAND_OVER)
    for _ in range(15):
        played.step(REST)
    assert played.info["path_length_m"] > 0.2 and played.driver == "Agent nearest-frontier"
    assert played.planned_path is not None and played.planned_path.shape[1] == 2
    played.obey(Command.NEXT_ROOM)  # it goes on driving there
    assert played.agent is not None and played.seed == 1
    for _ in range(5):
        played.step(REST)
    played.obey(Command.HAND_OVER)
    before = played.info["path_length_m"]
    for _ in range(15):
        played.step(REST)
    assert played.agent is None and played.info["path_length_m"] - before < 0.3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rooms": "rectangle"}, ["unknown rooms", "rectangular"]),
        ({"slam": "efk"}, ["unknown SLAM backend", "ekf"]),
        ({"agent": "nearest"}, ["unknown agent", "nearest-frontier"]),
        ({"robot": "yubot"}, ["unknown robot", "youbot"]),
        ({"noise": "none"}, ["unknown noise preset", "nominal"]),
        ({"rooms": None, "floor_plan": Path("no/such.png")}, ["no/such.png"]),
        ({"agent": "no-such.safetensors"}, ["no-such"]),
    ],
)
def test_bad_input_is_refused_in_one_line(options: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(BadInput) as refused:
        session(**options)
    line = str(refused.value)
    assert "\n" not in line and all(word in line for word in words), line


# ---- what is shown -------------------------------------------------------------------------------------------


def test_the_frame_stands_below_the_strip() -> None:
    played = session()
    picture = play_picture(played, steps_per_s=9.96)
    assert picture.shape == (*PICTURE_SHAPE, 3) and picture.dtype == np.uint8
    assert np.array_equal(picture[-720:], render_frame(played.env))
    helped = play_picture(played, steps_per_s=None, show_help=True)
    changed = np.argwhere(np.any(helped[-720:] != picture[-720:], axis=2))
    assert len(changed) > 50_000 and changed.min(axis=0)[0] > 100
    noticed = play_picture(played, steps_per_s=None, notice="cave, seed 3, ekf …")
    assert not np.array_equal(noticed, helped)


def test_a_long_notice_stays_in_the_middle() -> None:
    played = session()
    before = play_picture(played, steps_per_s=None)
    noticed = play_picture(played, steps_per_s=None, notice="a plan of a long name " * 12)
    columns = np.flatnonzero(np.any(noticed != before, axis=(0, 2)))
    assert 0 < columns[0] < 100 and abs(columns[0] + columns[-1] - 1279) <= 2


def test_what_does_not_fit_is_shortened() -> None:
    assert _shortened("a room", 400) == "a room"
    short = _shortened("a room " * 40, 200)
    assert short.endswith("…") and short.startswith("a room a") and len(short) < 60


# ---- in a window ---------------------------------------------------------------------------------------------


class Player:
    """Presses keys."""

    def __init__(self, pygame: Any, played: Session) -> None:
        from training.play.game import Game, open_window

        self.pygame, self.session = pygame, played
        self.window = open_window()
        self.game = Game(played, self.window, speed=FAST)

    def down(self, key: str, **more: Any) -> None:
        event = self.pygame.event.Event(self.pygame.KEYDOWN, key=self.pygame.key.key_code(key), **more)
        self.pygame.event.post(event)

    def up(self, key: str) -> None:
        self.pygame.event.post(self.pygame.event.Event(self.pygame.KEYUP, key=self.pygame.key.key_code(key)))

    def play(self, steps: int) -> None:
        self.game.run(self.game.steps + steps)

    def moved(self) -> np.ndarray:
        return np.asarray(self.session.env.truth.pose)


def test_keys_drive_strafe_and_turn(pygame: Any) -> None:
    player = Player(pygame, session())
    poses = []
    for key in ("s", "d", "q"):
        before = player.moved()
        player.down(key)
        player.play(6)
        player.up(key)
        player.play(4)
        poses.append(player.moved() - before)
        player.down("r")  # back at the start, heading 0
        player.play(1)
    assert poses[0][0] < -0.1 and abs(poses[0][1]) < 0.05
    assert poses[1][1] < -0.1 and abs(poses[1][0]) < 0.05
    assert poses[2][2] > 0.2 and np.hypot(*poses[2][:2]) < 0.05


def test_keys_change_backend_room_and_driver(pygame: Any) -> None:
    player = Player(pygame, session(slam="odometry"))
    played = player.session
    player.down("tab")
    player.down("n")
    player.play(1)
    assert (played.config.slam, played.seed) == ("truth", 1)
    player.down("tab", mod=pygame.KMOD_LALT)  # meant for the desktop
    player.down("p")
    player.play(1)
    assert (played.config.slam, played.seed) == ("truth", 0)
    player.down("k")
    player.play(1)
    assert played.config.rooms == rooms.names()[0]  # rectangular is the last
    player.down("space")
    player.play(1)
    assert played.agent is not None
    player.down("space")
    player.play(1)
    assert played.agent is None


def test_the_window_shows_the_picture_and_help_over_it(pygame: Any) -> None:
    player = Player(pygame, session())
    player.play(2)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown[-720:], render_frame(player.session.env))
    player.down("f1")
    player.play(1)
    helped = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert not np.array_equal(helped[-720:], render_frame(player.session.env))
    player.down("h")
    player.play(1)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    assert np.array_equal(shown[-720:], render_frame(player.session.env))


@pytest.mark.parametrize("how", ["escape", "closed"])
def test_it_ends_when_it_is_quit_or_closed(how: str, pygame: Any) -> None:
    player = Player(pygame, session())
    player.play(1)
    if how == "escape":
        player.down("escape")
    else:
        pygame.event.post(pygame.event.Event(pygame.QUIT))
    player.game.run()
    assert player.game.steps == 1
    assert player.window.closed is (how == "closed")
    player.window.close()


def test_ctrl_c_ends_it_in_one_line(pygame: Any) -> None:
    player = Player(pygame, session())
    before = signal.getsignal(signal.SIGINT)
    threading.Timer(0.3, signal.raise_signal, [signal.SIGINT]).start()
    with pytest.raises(Interrupted, match="rectangular, seed 0"):
        player.game.run()
    assert signal.getsignal(signal.SIGINT) is before


def test_the_pace_is_true_and_what_is_missed_is_not_caught_up_with(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame", reason="needs the extra `human`")
    from training.play import game as play_game

    now = [100.0]
    monkeypatch.setattr(play_game.time, "perf_counter", lambda: now[0])
    pace = play_game._Pace(10.0)
    assert pace.measured is None and pace.due() and not pace.due()
    assert pace.wait_s(1.0) == pytest.approx(0.1) and pace.wait_s(0.03) == 0.03
    steps = 0
    for _ in range(1000):  # ten seconds in hundredths
        now[0] += 0.01
        steps += pace.due()
    assert steps in (99, 100) and pace.measured == pytest.approx(10.0, abs=0.6)
    now[0] += 5.0  # an agent that thinks
    assert [pace.due() for _ in range(4)].count(True) <= 3


def test_a_gamepad_drives(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    player = Player(pygame, session())

    class Pad:
        def get_axis(self, axis: int) -> int:
            return 32767 if axis == pygame.CONTROLLER_AXIS_LEFTX else 0

    player.game._gamepad._pad = Pad()
    player.play(6)
    assert player.moved()[1] < -0.1 and abs(player.moved()[0]) < 0.05


# ---- the command ---------------------------------------------------------------------------------------------


def test_the_command_plays_so_many_steps(pygame: Any, capsys: pytest.CaptureFixture[str]) -> None:
    from training.cli.play import play

    play(rooms="rectangular", slam="odometry", speed=FAST, frames=5)
    assert capsys.readouterr().out.startswith("rectangular, seed 0, odometry: 0.5 s, coverage ")
    assert not pygame.display.get_init()


def test_the_command_refuses_a_speed_that_is_none(capsys: pytest.CaptureFixture[str]) -> None:
    for speed in ("0", "-1", "nan", "inf", "101"):
        assert main(["play", "--speed", speed]) == 2
        error = capsys.readouterr().err
        assert "--speed" in error and error.count("\n") == 1


@pytest.mark.parametrize("robots", ["1", "2"])
@pytest.mark.parametrize(
    ("option", "name"), [("--rooms", "nope"), ("--slam", "efk"), ("--robot", "yuobot"), ("--agent", "nobody")]
)  # fmt: skip
def test_a_wrong_name_is_told_without_a_display(
    robots: str, option: str, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "none-such")
    assert main(["play", "--robots", robots, option, name]) == 2
    error = capsys.readouterr().err
    assert f"'{name}'" in error and error.count("\n") == 1


def test_without_a_display_or_pygame_the_remedy_is_said(pygame: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from training.play.game import open_window

    monkeypatch.setenv("SDL_VIDEODRIVER", "none-such")
    with pytest.raises(BadInput, match="SDL_VIDEODRIVER=dummy"):
        open_window()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame.display.init()
    monkeypatch.delenv("SDL_VIDEODRIVER")  # now it is SDL's own choice, as where there is no desktop
    with pytest.raises(BadInput, match=r"no display to open a window on; .*SDL_VIDEODRIVER=dummy"):
        open_window()
    assert not pygame.display.get_init()
    monkeypatch.setitem(__import__("sys").modules, "pygame", None)
    with pytest.raises(BadInput, match=r"mecanum-slam\[human\]"):
        open_window()
