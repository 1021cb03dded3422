"""Work on Ray: what ``--ray`` means and refuses, and items on a Ray of this machine."""

from __future__ import annotations

import os
import signal
import socket
import sys
import time
from concurrent.futures import Future
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer

from tests.training.cli.test_bad_input import refused
from training.cli import app, main
from training.cli.study import STUDIES, study_command
from training.runs import cluster
from training.runs.campaign import run_all
from training.runs.errors import BadInput
from training.runs.signals import heed_signals

ROOT = Path(__file__).resolve().parents[3]
SETTINGS = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}


# ---- the option ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "address"),
    [
        ([], None),
        (["--ray"], "local"),
        (["--ray", "--out", "x"], "local"),
        (["--ray", "auto", "--out", "x"], "auto"),
        (["--ray=10.0.0.5:6379"], "10.0.0.5:6379"),
    ],
)
def test_an_address_may_be_left_out(
    words: list[str], address: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    command: Any = typer.main.get_command(app)
    for name in ("benchmark", "train", "consistency"):
        assert command.commands[name].make_context(name, list(words)).params["ray"] == address
    if "--ray" in words:
        monkeypatch.setenv("RAY_ADDRESS", "10.0.0.9:6379")
        meant = address if address == "auto" else "10.0.0.9:6379"
        assert study_command("paper-d").make_context("paper-d", list(words)).params["ray"] == meant


def test_every_study_with_workers_takes_it() -> None:
    pytest.importorskip("torch", reason="needs the extra `train`")
    for name in STUDIES:
        options = {parameter.name for parameter in study_command(name).params}
        assert ("workers" in options) == ("ray" in options), name


def test_without_it_nothing_of_ray_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)  # an import fails
    argv = ["benchmark", "--suite", "rooms", "--seeds", "0", "--max-steps", "3", "--workers", "1"]
    assert main([*argv, "--out", str(tmp_path)]) == 0


# ---- what is refused -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [["benchmark"], ["train"], ["consistency"], ["study", "paper-d"]])
def test_the_extra_is_asked_for(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    line = refused([*command, "--out", str(tmp_path / "out"), "--ray"], capsys)
    assert "--ray needs ray; install it with pip install 'mecanum-slam[ray]'" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("somewhere", ["is no address", "HOST:PORT"]),
        ("ray://10.0.0.5:10001", ["is no address", "HOST:PORT"]),
        ("127.0.0.1:1", ["nothing answers there", "ray start --head"]),
        ("127.0.0.1:99999", ["nothing answers there", "ray start --head"]),
        ("mute", ["no Ray answers there", "silent", "ray start --head"]),
    ],
)
def test_an_address_where_no_ray_answers(
    address: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    pytest.importorskip("ray", reason="needs the extra `ray`")
    monkeypatch.setattr(cluster, "_WITHIN_S", 2.0)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        if address == "mute":
            address = f"127.0.0.1:{mute.getsockname()[1]}"
        line = refused(["benchmark", "--out", str(tmp_path / "out"), "--ray", address], capsys)
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("change", "word"), [({"code": "x"}, "other code"), ({"versions": (("numpy", "1"),)}, "numpy")]
)
def test_a_node_with_other_code_or_libraries_does_no_work(change: dict[str, Any], word: str) -> None:
    here = cluster._Origin.here()
    with pytest.raises(BadInput, match=f"{socket.gethostname()} has .*{word}.* every node"):
        cluster._work(replace(here, **change), b"")


# ---- items on a Ray of this machine ----------------------------------------------------------------------------


def behaves(how: str) -> Any:
    kind, _, rest = how.partition(" ")
    if kind == "raise":
        raise ZeroDivisionError("of all things")
    if kind == "die" and not Path(rest).exists():
        Path(rest).touch()
        os._exit(1)
    if kind == "sleep":
        begun = time.monotonic()
        time.sleep(0.3)
        return begun, time.monotonic()
    return {name: os.environ.get(name) for name in SETTINGS}


def test_items_on_a_ray_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One thread each; never more at a time than asked for; errors come as they are; who dies is replaced."""
    pytest.importorskip("ray", reason="needs the extra `ray`")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("RAY_AUTH_TOKEN", os.urandom(16).hex())
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with cluster.ray_pool(cluster.Cluster("local", 2)) as pool:
        said: list[Future[Any]] = [pool.submit(behaves, "tell"), pool.submit(behaves, "raise")]
        said += [pool.submit(behaves, f"die {tmp_path / 'once'}")]
        assert said[0].result() == SETTINGS
        with pytest.raises(ZeroDivisionError, match="of all things"):
            said[1].result()
        assert said[2].result() == said[0].result() and (tmp_path / "once").exists()
        narrow = cluster.RayPool(1)
        spans = sorted(narrow.map(behaves, ["sleep"] * 3))
        assert all(end <= begun for (_, end), (begun, _) in pairwise(spans))
        narrow.shutdown()
        with pool.channel() as channel:
            pool.submit(channel.put, "a word").result()
            assert channel.get(timeout=10.0) == "a word"


def test_one_item_that_fails_ends_the_run_as_it_does_without_ray() -> None:
    with pytest.raises(ZeroDivisionError):
        run_all(["raise"], behaves, workers=1, keep=lambda _job, _result: None, apart=True)


def test_sigterm_while_ray_connects_is_sigterm(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = pytest.importorskip("ray", reason="needs the extra `ray`")

    def init(*_: Any, **__: Any) -> None:  # as Ray does: it takes the signal for itself, and quits on it
        signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(number))
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(ray, "init", init)
    with heed_signals() as heard, pytest.raises(KeyboardInterrupt), cluster.ray_pool(cluster.Cluster("local", 1)):
        pass
    assert heard.sigterm
