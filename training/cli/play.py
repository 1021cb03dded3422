"""``mecanum play`` on the command line."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Timer
from typing import Annotated, Any

import typer

from training.runs import options as opt

__all__ = ["play"]

_PATIENCE_S = 4.0


def play(
    agent: Annotated[
        str, typer.Option(help="Who drives when Space is pressed, or a policy file.")
    ] = "nearest-frontier",
    rooms: opt.Rooms = None,
    slam: opt.Slam = None,
    seed: opt.RoomSeed = 0,
    floor_plan: opt.FloorPlanFile = None,
    robot: opt.Robot = None,
    noise: opt.Noise = None,
    speed: Annotated[
        float, typer.Option(min=0.01, max=100, help="Times true speed, which is 10 steps a second.")
    ] = 1.0,
    robots: Annotated[
        int, typer.Option(min=1, max=64, help="How many; the first one is yours, agents drive the others.")
    ] = 1,
    communication: opt.Communication = None,
    range_m: opt.Range = None,
    starts: opt.Starts = None,
    unknown_starts: opt.UnknownStarts = False,
    frames: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="End after so many steps.  [default: when you quit]")
    ] = None,
) -> None:
    """Drive the robot yourself in a window, and watch what it believes.

    W A S D drive and strafe, Q E turn, Space lets an agent drive, Tab takes the next SLAM backend, N the next
    room, F1 shows all keys, Esc quits. A gamepad drives, too. Needs the extra `human`. docs/how-to/play.md has the
    details.

    \b
    Examples:
      mecanum play
      mecanum play --rooms cave --slam fastslam2 --seed 3
      mecanum play --agent ppo-frontier --speed 2
      mecanum play --robots 2 --communication walls
      SDL_VIDEODRIVER=dummy mecanum play --frames 100
    """  # noqa: D301
    from training.episodes.team import read_team
    from training.play.game import Game, open_window
    from training.play.session import Session, checked_config
    from training.play.team_session import TeamSession

    team = read_team(
        robots=robots, communication=communication, range_m=range_m, starts=starts, unknown_starts=unknown_starts
    )
    where: dict[str, Any] = {"agent": agent, "rooms": rooms, "slam": slam, "robot": robot, "noise": noise}
    where["floor_plan"] = floor_plan
    checked_config(**where)  # a wrong name is told without a display, too
    window = open_window()
    try:
        with _said_where_it_takes_long():
            session = Session(seed=seed, **where) if robots == 1 else TeamSession(team=team, seed=seed, **where)
        Game(session, window, speed=speed).run(frames)
    finally:
        window.close()
    print(session.summary())


@contextmanager
def _said_where_it_takes_long() -> Iterator[None]:
    """Say on standard error what there is to wait for, while the window is empty, where that is some seconds."""
    text = "mecanum play: compiling; the first time on a computer that can take minutes"
    timer = Timer(_PATIENCE_S, print, [text], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
