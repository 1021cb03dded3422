"""The ``mecanum`` command. What is heavy is imported inside the commands, so that ``--help`` is quick."""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Annotated, Any

import typer

from training.cli.benchmark import benchmark
from training.cli.doctor import doctor
from training.cli.explore import explore
from training.cli.measures import complexity, consistency, speed
from training.cli.play import play
from training.cli.policy import policy
from training.cli.replay import replay
from training.cli.rooms import rooms
from training.cli.ros import ros
from training.cli.study import STUDIES, study
from training.cli.train import train
from training.runs.errors import BadInput, Interrupted, one_line, suggestion
from training.runs.options import Command
from training.runs.signals import INTERRUPTED, TERMINATED, UNWRITTEN, Heard, forget_interrupt, heed_signals

__all__ = ["app", "main"]

TRACEBACK_VARIABLE = "MECANUM_TRACEBACK"

_LONGEST = 2000  # characters of an error, whatever a file has for a name or a value

# typer brings its own copy of click, or uses click's, by version; either way this is the root of usage errors.
_ClickException: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    no_args_is_help=True,
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
    Exit codes: 0 done, 2 bad usage or bad input, 1 anything else, 130 interrupted, 143 by SIGTERM.
    `mecanum COMMAND --help` shows a command's options and examples.
    """  # noqa: D301


for command in (
    explore, rooms, speed, consistency, complexity, replay, benchmark, train, play, policy, ros, doctor,
):  # fmt: skip
    app.command(cls=Command)(command)
# A study's options are its own: what follows the name is handed on as it was typed.
app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []})(
    study
)


# ---- running it ------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code; what goes wrong is one line on standard error."""
    with heed_signals() as heard:
        code = _run(list(sys.argv[1:] if argv is None else argv), heard)
    forget_interrupt()
    return TERMINATED if heard.sigterm and code in (1, INTERRUPTED) else code


def _run(arguments: list[str], heard: Heard) -> int:
    name = "mecanum"
    try:
        command = typer.main.get_command(app)
        if arguments and arguments[0] in _commands():
            name = f"mecanum {arguments[0]}"
        if arguments[:1] == ["study"] and arguments[1:] and arguments[1] in STUDIES:
            name = f"mecanum study {arguments[1]}"
        code = command.main(args=arguments, prog_name="mecanum", standalone_mode=False)
        sys.stdout.flush()
        if code == INTERRUPTED:  # newer versions of typer hand KeyboardInterrupt back so
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
        return _fail(name, str(error), INTERRUPTED)
    except (KeyboardInterrupt, typer.Abort):
        return _fail(name, UNWRITTEN, INTERRUPTED)
    except Exception as error:
        if heard.broken_off:  # amid an import it may come out as any error
            return _fail(name, UNWRITTEN, INTERRUPTED)
        _drop_unwritable_output()
        if os.environ.get(TRACEBACK_VARIABLE) not in (None, "", "0"):
            traceback.print_exc()
        text = one_line(error) or "no message"
        return _fail(name, f"{type(error).__name__}: {text} (set {TRACEBACK_VARIABLE}=1 for a traceback)", 1)


def _fail(name: str, message: str, code: int) -> int:
    with contextlib.suppress(Exception):  # what Ctrl-C breaks off while it is imported stays half there
        from slam.files import plain_name  # not before something is wrong: --help is quick

        message = plain_name(message, _LONGEST)
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
    message = one_line(error.format_message()).rstrip(".").replace(". ,", ",")
    if message.startswith("No such command"):
        given = [*message.split("'"), "", ""][1]
        return f"unknown command {given!r}{suggestion(given, _commands())}; valid: {', '.join(_commands())}"
    return f"{message[:1].lower()}{message[1:]}; see --help"
