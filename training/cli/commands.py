"""The ``mecanum`` command. What is heavy is imported inside the commands, so that ``--help`` is quick."""

from __future__ import annotations

import json
import math
import os
import sys
import time
import traceback
from collections.abc import Sequence
from contextlib import ExitStack
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from training.cli.benchmark import benchmark
from training.cli.play import play
from training.cli.policy import policy
from training.cli.study import study
from training.cli.train import train
from training.runs.errors import BadInput, Interrupted, bad_input, one_line, suggestion
from training.runs.options import Json

if TYPE_CHECKING:
    from training.episodes.explore import Progress

__all__ = ["app", "main"]

TRACEBACK_VARIABLE = "MECANUM_TRACEBACK"
_LOG_EVERY_S = 30.0  # between two lines of progress where standard error is no terminal

# typer brings its own copy of click, or uses click's, by version; either way this is the root of usage errors.
_ClickException: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help needs no rich, and shows the examples as they are typed
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        try:
            print(f"mecanum-slam {version('mecanum-slam')}")
        except PackageNotFoundError:
            print("mecanum-slam, not installed: run `pip install -e .`")
        raise typer.Exit


@app.callback()
def _root(
    show: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Let a mecanum-wheel robot explore rooms it has never seen, on its own SLAM belief.

    \b
    Examples:
      mecanum explore
      mecanum rooms --kind apartment --seeds 0:9 --out out/rooms
      mecanum speed

    \b
    Exit codes: 0 done, 2 bad usage or bad input, 1 anything else, 130 interrupted.
    `mecanum COMMAND --help` shows a command's options and examples.
    """  # noqa: D301


@app.command()
def explore(
    agent: Annotated[
        str | None, typer.Option(help="Who decides where to go, or a policy file.  [default: nearest-frontier]")
    ] = None,
    rooms: Annotated[str | None, typer.Option(help="Generator of the rooms.  [default: apartment]")] = None,
    slam: Annotated[str | None, typer.Option(help="SLAM backend.  [default: invariant-ekf]")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Of the room and the noise.  [default: 0]")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/explore"),
    floor_plan: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A real plan instead of --rooms: ROS map or image.")
    ] = None,
    start: Annotated[
        str | None, typer.Option(metavar="X,Y,THETA", help="Start pose in the plan's frame, m and rad.")
    ] = None,
    robot: Annotated[
        str | None, typer.Option(help="Robot preset, with its lidar and noise.  [default: youbot]")
    ] = None,
    noise: Annotated[str | None, typer.Option(help="Noise preset.  [default: nominal]")] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Configuration; the options above go before it.")
    ] = None,
    max_steps: Annotated[
        int | None, typer.Option(min=1, help="Step limit.  [default: 12 per m² of free space, at least 3000]")
    ] = None,
    coverage_target: Annotated[
        float | None, typer.Option(help="Coverage that counts as success, in (0, 1].  [default: 0.95]")
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="Also film it: episode.mp4, at true speed.")] = False,
    video_substeps: Annotated[
        bool, typer.Option("--video-substeps", help="The same, a frame for every substep of the physics.")
    ] = False,
    mcap: Annotated[
        bool, typer.Option("--mcap", help="Also write episode.mcap, ROS 2 messages for Foxglove and RViz.")
    ] = False,
    rerun: Annotated[bool, typer.Option("--rerun", help="Also write episode.rrd, for Rerun.")] = False,
    as_json: Json = False,
) -> None:
    """Explore rooms for one episode, until the agent has nothing left to explore.

    Writes into --out: map.png, truth.png, map.pgm + map.yaml (ROS map_server), trajectory_true.tum and
    trajectory_estimate.tum, landmarks.db (SQLite), config.toml, metrics.json and report.html, which replays the
    episode in a browser. Ctrl-C ends the episode and keeps it as far as it came.

    \b
    Examples:
      mecanum explore
      mecanum explore --agent nearest-frontier --rooms apartment --slam ekf --seed 3 --out out/seed3
      mecanum explore --floor-plan office.yaml --start 2.5,1.0,0 --out out/office
      mecanum explore --config out/seed3/config.toml --out out/again
      mecanum explore --rooms rectangular --noise slippery --json
      mecanum explore --agent brisk-tour --video --mcap
    """  # noqa: D301
    pose = _parse_start(start)
    if coverage_target is not None and not 0 < coverage_target <= 1:
        raise BadInput(f"--coverage-target must be above 0 and at most 1, got {coverage_target}")
    from training.episodes import explore as task
    from training.episodes.recording import Recorder
    from training.runs.running import interrupt_flag
    from training.views.episode_files import check_extras, write_episode
    from training.views.film import filmed

    options = task.ExploreOptions(
        out=out, agent=agent, rooms=rooms, slam=slam, robot=robot, noise=noise, seed=seed, floor_plan=floor_plan,
        start=pose, config=config, max_steps=max_steps, coverage_target=coverage_target,
    )  # fmt: skip
    asked = {"video": video or video_substeps, "mcap": mcap, "rerun": rerun}
    extras = [name for name, wanted in asked.items() if wanted]
    check_extras(extras)
    episode, recorder = task.prepare(options), Recorder()
    # Held until all is written: an episode that is over is not lost to a Ctrl-C. A second one ends it all.
    with interrupt_flag() as late, ExitStack() as stack:
        witnesses: list[task.Witness] = [recorder]
        film = stack.enter_context(filmed(out, episode.config, video_substeps)) if "video" in extras else None
        witnesses += [film] if film is not None else []
        with ExitStack() as progress:
            task.run(episode, _progress(progress), witnesses)
        path = film.finish() if film is not None else None
        if path is None and film is not None:
            extras.remove("video")
        metrics = write_episode(episode, recorder.recording(), extras=extras, film=path)
    if as_json:
        print(json.dumps(metrics, ensure_ascii=False))
    else:
        files = (*task.FILES, *(task.EXTRAS[name] for name in extras))
        print(_summary(metrics, out, files, task.ENDINGS[metrics["end"]]))
    if film is not None and film.failure is not None:
        raise OSError(f"{one_line(film.failure)}; all but the film is in {out}")
    if episode.interrupted or late.is_set():
        raise Interrupted(f"interrupted after {metrics['time_s']:.1f} s; the episode so far is in {out}")


@app.command()
def rooms(
    kind: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    seeds: Annotated[str, typer.Option(help="3, 0:9 (both included) or 1,4,7; at most 100.")] = "0:9",
    out: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("out/rooms"),
    robot: Annotated[str, typer.Option(help="Robot drawn at the start.")] = "youbot",
    as_json: Json = False,
) -> None:
    """Draw generated rooms: one PNG a seed, and a contact sheet of them all.

    \b
    Examples:
      mecanum rooms
      mecanum rooms --kind apartment --seeds 0:9 --out out/rooms
      mecanum rooms --kind rectangular --seeds 1,4,7 --json
    """  # noqa: D301
    from training.episodes.room_pictures import draw_rooms

    drawn = draw_rooms(kind=kind, seeds=seeds, out=out, robot=robot)
    if as_json:
        print(json.dumps(drawn))
    else:
        print(f"{len(drawn['files'])} plans in {out}, all together in {drawn['sheet']}")


@app.command()
def speed(
    steps: Annotated[int, typer.Option(min=100, max=10_000_000, help="Steps to measure.")] = 10_000,
    rooms: Annotated[str, typer.Option(help="Generator of the rooms.")] = "apartment",
    slam: Annotated[str, typer.Option(help="SLAM backend.")] = "ekf",
    beams: Annotated[int, typer.Option(min=8, help="Beams of the lidar.")] = 360,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the room and the noise.")] = 0,
    peer: Annotated[
        str | None, typer.Option(help="Another simulator to measure in turn, in the same rooms: navground.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Measure the steps per second of one environment, and where the time goes.

    \b
    Examples:
      mecanum speed
      mecanum speed --slam odometry --beams 180 --steps 3000 --json
      mecanum speed --peer navground
    """  # noqa: D301
    from mecanum_env.env import make_config
    from training.studies.peers import require
    from training.studies.speed import run

    with bad_input():
        make_config(rooms=rooms, slam=slam, lidar={"beams": beams})
        if peer is not None:
            require(peer)
    run(steps=steps, rooms=rooms, slam=slam, beams=beams, seed=seed, as_json=as_json, peer=peer)


@app.command()
def consistency(
    slam: Annotated[str, typer.Option(help="SLAM backends, separated by commas.")] = "ekf",
    rooms: Annotated[
        str, typer.Option(help="A world of landmarks (circle, room), or a generator of rooms.")
    ] = "circle",
    runs: Annotated[int, typer.Option(min=1, max=10_000, help="Monte-Carlo runs of each backend.")] = 50,
    steps: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="Of a run.  [default: the world's, or at most 3000]")
    ] = None,
    noise: Annotated[float, typer.Option(help="Times the noise, told to the backends.")] = 1.0,
    seed0: Annotated[int, typer.Option(min=0, max=2**30, help="Seed of the first run.")] = 0,
    workers: Annotated[int | None, typer.Option(min=1, max=1024, help="Processes.  [default: one a core]")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/consistency"),
    as_json: Json = False,
) -> None:
    """Ask whether errors are as large as the covariances say: NEES and NIS over Monte-Carlo runs.

    Writes into --out: consistency.json, consistency.png and each run as it comes, so that the same command goes
    on where it was broken off, and more runs or backends are added to those that are there.

    \b
    Examples:
      mecanum consistency
      mecanum consistency --slam ekf,odometry --rooms circle --runs 50 --out out/circle
      mecanum consistency --rooms rectangular --noise 3 --runs 20 --workers 2 --out out/rectangular --json
    """  # noqa: D301
    from training.studies.consistency import Plan, table
    from training.studies.consistency import consistency as measure

    plan = Plan.parse(slam=slam, rooms=rooms, runs=runs, steps=steps, noise=noise, seed0=seed0)
    result = measure(plan, out=out, workers=workers or os.cpu_count() or 1)
    print(json.dumps(result) if as_json else table(result))


@app.command()
def complexity(
    slam: Annotated[str, typer.Option(help="SLAM backends, separated by commas.")] = "ekf",
    landmarks: Annotated[
        str, typer.Option(help="Sizes of the map, separated by commas.")
    ] = "25,50,100,200,400,800",
    steps: Annotated[int, typer.Option(min=10, max=100_000, help="Steps that a median is taken of.")] = 100,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/complexity"),
    as_json: Json = False,
) -> None:
    """Measure the time per step against the number of landmarks in the map.

    A step is a prediction and ten observations of known landmarks. Writes into --out: complexity.json,
    complexity.png and each point as it comes, so that the same command goes on where it was broken off.

    \b
    Examples:
      mecanum complexity
      mecanum complexity --slam ekf,odometry --landmarks 25,50,100 --out out/complexity --json
    """  # noqa: D301
    from training.studies.complexity import Plan, table
    from training.studies.complexity import complexity as measure

    result = measure(Plan.parse(slam=slam, landmarks=landmarks, steps=steps), out=out)
    print(json.dumps(result) if as_json else table(result))


@app.command()
def replay(
    log: Annotated[
        Path,
        typer.Argument(
            metavar="LOG",
            help="CARMEN or DP-SLAM log; UTIAS: Robot1_Odometry.dat or folder; Victoria Park: folder.",
        ),
    ],
    slam: Annotated[str | None, typer.Option(help="SLAM backend.  [default: ekf]")] = None,
    association: Annotated[
        str | None, typer.Option(help="known or unknown landmark ids.  [default: known where the log has them]")
    ] = None,
    robot: Annotated[int | None, typer.Option(min=1, help="Which robot of a UTIAS folder.")] = None,
    reference: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Log of the same scans with corrected poses.  [default: none]"),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=2**31 - 1, help="Of backends that draw samples.  [default: 0]")
    ] = None,
    limit_s: Annotated[float | None, typer.Option(help="Stop after so many seconds of the log.")] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE.toml", help="Configuration; the options above go before it.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/replay"),
    as_json: Json = False,
) -> None:
    """Run a SLAM backend on the recorded log of a real robot, and compare it with the log's reference.

    Writes into --out: trajectory_estimate.tum, trajectory_true.tum, trajectory.png, landmarks.db (SQLite),
    landmarks.csv, config.toml and metrics.json; of a log with scans also map.png and map.pgm with map.yaml (ROS
    map_server). Ctrl-C ends the replay and keeps it as far as it came.

    \b
    Examples:
      mecanum replay utias6/Robot1_Odometry.dat.gz --slam ekf --out out/utias1
      mecanum replay utias6 --robot 3 --association unknown --json
      mecanum replay victoria_park --slam ekf --limit-s 300 --out out/park
      mecanum replay intel.gfs.log.gz --reference intel-corrected.log.gz --slam invariant-ekf
    """  # noqa: D301
    from training.replay import report as replay_report
    from training.replay import run as task

    options = task.ReplayOptions(
        log=log, out=out, robot=robot, reference=reference, slam=slam, association=association, seed=seed,
        limit_s=limit_s, config=config,
    )  # fmt: skip
    prepared = task.prepare(options)
    progress = task.Progress(prepared.log.duration_s)
    try:
        task.run(prepared, progress)
    finally:
        progress.close()
    metrics = replay_report.write(prepared)
    print(
        json.dumps(metrics, ensure_ascii=False) if as_json else replay_report.summary(metrics, out, prepared.files)
    )
    if prepared.interrupted:
        raise Interrupted(f"interrupted after {metrics['duration_s']:.1f} s of the log; what was done is in {out}")


app.command()(benchmark)
app.command()(train)
app.command()(play)
app.command()(policy)
app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})(
    study
)


# ---- running it ------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; what goes wrong is one line on standard error."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    command = typer.main.get_command(app)
    name = "mecanum"
    if arguments and arguments[0] in _commands():
        name = f"mecanum {arguments[0]}"
    try:
        code = command.main(args=arguments, prog_name="mecanum", standalone_mode=False)
        sys.stdout.flush()
        if code == 130:  # newer versions of typer hand KeyboardInterrupt back so
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except _ClickException as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error, file=sys.stderr)
            return 2
        return _fail(name, _usage_message(error), 2)
    except BadInput as error:
        return _fail(name, str(error), 2)
    except Interrupted as error:
        return _fail(name, str(error), 130)
    except (KeyboardInterrupt, typer.Abort):
        return _fail(name, "interrupted before the results were written", 130)
    except Exception as error:
        _drop_unwritable_output()
        if os.environ.get(TRACEBACK_VARIABLE) not in (None, "", "0"):
            traceback.print_exc()
        text = one_line(error) or "no message"
        return _fail(name, f"{type(error).__name__}: {text} (set {TRACEBACK_VARIABLE}=1 for a traceback)", 1)


def _fail(name: str, message: str, code: int) -> int:
    print(f"{name}: {message}", file=sys.stderr)
    return code


def _drop_unwritable_output() -> None:
    """Where standard output takes nothing any more, let nobody try again on exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _commands() -> list[str]:
    return sorted(getattr(typer.main.get_command(app), "commands", {}))


def _usage_message(error: Any) -> str:
    """Return a usage error on one line, with what is allowed."""
    context = getattr(error, "ctx", None)
    option = getattr(error, "option_name", None)
    if context is not None and type(error).__name__ == "NoSuchOption":
        valid = sorted(name for p in context.command.params for name in p.opts if name.startswith("--"))
        valid.append("--help")
        return f"unknown option {option}{suggestion(str(option), valid)}; valid: {', '.join(valid)}"
    message = one_line(error.format_message()).rstrip(".")
    if message.startswith("No such command"):
        given = [*message.split("'"), "", ""][1]
        return f"unknown command {given!r}{suggestion(given, _commands())}; valid: {', '.join(_commands())}"
    return f"{message[:1].lower()}{message[1:]}; see --help"


def _parse_start(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        x, y, theta = (float(word) for word in text.split(","))
    except ValueError:
        raise BadInput(f"--start {text!r} is not X,Y,THETA in m and rad; give for instance 2.5,1.0,0") from None
    if not all(map(math.isfinite, (x, y, theta))):
        raise BadInput(f"--start {text!r} must be finite; give for instance 2.5,1.0,0")
    return x, y, theta


# ---- what the user sees ----------------------------------------------------------------------------------------


def _progress(stack: ExitStack) -> Progress:
    """Return a progress bar on standard error, or a line now and then where that is no terminal."""
    if not sys.stderr.isatty():
        return _LogLines()
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    bar = stack.enter_context(
        Progress(
            TextColumn("exploring"), BarColumn(), TextColumn("{task.fields[status]}"), TimeElapsedColumn(),
            console=Console(stderr=True), transient=True,
        )
    )  # fmt: skip
    task = bar.add_task("exploring", total=1.0, status="")

    def show(*, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
        if steps % 10 == 0:
            bar.update(task, completed=coverage, status=f"{100 * coverage:.1f} % mapped at {time_s:.0f} s")

    return show


class _LogLines:
    """A line on standard error at the start, and every half a minute."""

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self, *, coverage: float, time_s: float, steps: int, max_steps: int) -> None:
        if steps % 10 == 1 and time.monotonic() >= self._next:
            self._next = time.monotonic() + _LOG_EVERY_S
            done = f"{100 * coverage:.1f} % mapped at {time_s:.0f} s"
            print(f"exploring: step {steps} of at most {max_steps}, {done}", file=sys.stderr, flush=True)


def _summary(metrics: dict[str, Any], out: Path, files: Sequence[str], ending: str) -> str:
    def shown(key: str, unit: str, digits: int, factor: float = 1.0) -> str:
        value = metrics[key]
        return "-" if value is None else f"{factor * value:.{digits}f} {unit}".rstrip()

    where = metrics["floor_plan"] or f"{metrics['rooms']}, seed {metrics['seed']}"
    verdict = "success" if metrics["success"] else "target not reached"
    corners = shown("corner_mean_m", "cm", 1, 100.0)
    heading = shown("final_heading_error_rad", "°", 2, 180.0 / math.pi)
    rows = (
        ("explored", f"{where} with {metrics['slam']} and {metrics['agent']}"),
        ("ended", f"{metrics['end']} ({ending}) after {metrics['time_s']:.1f} s, {metrics['steps']} steps"),
        ("coverage", f"{shown('coverage', '%', 1, 100.0)} ({verdict}); 95 % at {shown('time_to_95_s', 's', 1)}"),
        ("path", f"{shown('path_length_m', 'm', 1)}, {metrics['collisions']} collisions"),
        ("map", f"wall IoU {shown('map_iou', '', 3)}, corners {corners} off on average"),
        ("final error", f"{shown('final_position_error_m', 'cm', 1, 100.0)}, {heading}"),
        ("files", f"{out}/: {', '.join(files)}"),
    )
    return "\n".join(f"{name:<12} {text}" for name, text in rows)
