"""A cluster of two nodes on this machine, by the commands that start one on real machines."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.training.benchmark.small import alive, children, contents, count
from training.cli import main

pytest.importorskip("ray", reason="needs the extra `ray`")

ROOT = Path(__file__).resolve().parents[3]
EPISODES = 96  # over two seconds of work, even on a fast machine: there is time to kill it


@dataclass
class Node:
    """What ``ray start --block`` started, and all that came of it."""

    process: subprocess.Popen[bytes]

    def family(self) -> list[int]:
        found, new = [], [self.process.pid]
        while new:
            found += new
            new = [child for pid in new for child in children(pid)]
        return found

    def kill(self) -> None:
        """As a power cut does: everything at once, with no word to anybody."""
        pids = self.family()
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)  # so that nobody tells, or is born
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
        self.process.wait()

    def works(self) -> bool:
        """Tell whether an item is being worked on."""
        return any("ray::_work" in command(pid) for pid in self.family())


def command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


def free_ports(number: int) -> list[int]:
    servers = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [server.getsockname()[1] for server in servers]
    for server in servers:
        server.close()
    return ports


class TwoNodes:
    """A head with one core, and a node with another."""

    def __init__(self, folder: Path) -> None:
        (folder / "token").write_text(os.urandom(16).hex())
        self.env = os.environ | {
            "PYTHONPATH": str(ROOT), "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(folder / "token"),
        }  # fmt: skip
        self._folder = folder
        port, clients = free_ports(2)
        self.address = f"127.0.0.1:{port}"
        self.head = self._start(
            "--head", f"--port={port}", f"--ray-client-server-port={clients}", f"--temp-dir={folder}",
            "--include-dashboard=false", "--disable-usage-stats",
        )  # fmt: skip
        self.until(lambda: self.ask().returncode == 0)
        self.node = self._start(f"--address={self.address}")
        self.until(lambda: "0.0/2.0 CPU" in self.ask().stdout)

    def _start(self, *words: str) -> Node:
        log = (self._folder / f"{words[0][2:6]}.log").open("wb")
        start = [sys.executable, "-m", "ray.scripts.scripts", "start", "--num-cpus=1", "--block", *words]
        return Node(subprocess.Popen(start, env=self.env, stdout=log, stderr=log, start_new_session=True))

    def ask(self) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-m", "ray.scripts.scripts", "status", "--address", self.address]
        return subprocess.run(words, env=self.env, capture_output=True, text=True, timeout=60, check=False)

    def until(self, there: Callable[[], bool]) -> None:
        began = time.monotonic()
        while not there():
            assert time.monotonic() - began < 60, [log.read_text() for log in self._folder.glob("*.log")]
            time.sleep(0.01)

    def mecanum(self, *words: str) -> subprocess.Popen[str]:
        call = [sys.executable, "-m", "training.cli", *words, "--ray", self.address]
        return subprocess.Popen(
            call, cwd=ROOT, env=self.env, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            # What a shell starts with & has SIGINT ignored, and its children have, too.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip


@contextmanager
def two_nodes() -> Iterator[TwoNodes]:
    folder = Path(tempfile.mkdtemp(prefix="ray-"))  # paths of sockets have to be short
    nodes = TwoNodes(folder)
    try:
        yield nodes
    finally:
        for node in (nodes.node, nodes.head):
            if node.process.poll() is None:
                node.kill()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def cluster() -> Iterator[TwoNodes]:
    with two_nodes() as nodes:
        yield nodes


def small(out: Path) -> list[str]:
    return [
        "benchmark", "--suite", "rooms", "--agents", "nearest-frontier", "--seeds", f"0:{EPISODES - 1}",
        "--max-steps", "60", "--out", str(out),
    ]  # fmt: skip


def test_members_are_trained_on_it_as_they_are_here(
    tmp_path: Path, cluster: TwoNodes, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("torch", reason="needs the extra `train`")
    from training.cli.train import _read
    from training.learning.folder import seed_of
    from training.learning.networks import read_zip
    from training.learning.ppo import Run

    config = tmp_path / "small.toml"
    config.write_text(
        "members = 2\n[world]\nrooms = ['rectangular']\n"
        "[rehearsal]\nsteps = 16\nenvironments = 2\nn_steps = 8\nchunk = 1\nbatch_size = 16\nevery = 2\n"
        "episodes = 1\n[ppo]\nsteps = 0\n[evaluation]\nepisodes = 1\nevery = 2\n"
    )
    there, here = tmp_path / "there", tmp_path / "here"
    run = cluster.mecanum("train", "--config", str(config), "--out", str(there))
    error = run.communicate(timeout=300)[1]
    assert run.returncode == 0, error
    assert "member-2: rehearsal, chunk 1" in error
    lines = (there / "curve.jsonl").read_text().splitlines()
    assert [json.loads(line)["stage"] for line in lines] == ["all members"]
    settings = _read(str(config), None)
    first = replace(settings, members=1, seed=seed_of(settings.seed, 0))  # type: ignore[call-arg]
    monkeypatch.setattr("training.learning.folder.worker_pool", lambda _: nullcontext(SimpleNamespace(map=map)))
    Run(first, here, workers=1, log=print).train()  # type: ignore[arg-type]
    one, other = (read_zip(folder / "best.zip") for folder in (there / "member-1", here))
    assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def test_a_node_killed_in_the_middle_loses_nothing_and_doubles_nothing(tmp_path: Path, cluster: TwoNodes) -> None:
    """And before that: what Ctrl-C and SIGTERM leave is kept, and gone on from."""
    there, here = tmp_path / "there", tmp_path / "here"
    for stop, code in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        before = count(there)
        run = cluster.mecanum(*small(there))
        wait_for(run, there, before + 1)  # else it might not heed signals yet
        run.send_signal(stop)
        error = run.communicate(timeout=60)[1]
        assert run.returncode == code and "run the same command again to go on" in error, error
        assert before < count(there) < EPISODES
    cluster.until(lambda: not (cluster.head.works() or cluster.node.works()))  # what was half done is stopped
    before = count(there)
    run = cluster.mecanum(*small(there))
    wait_for(run, there, before + 2)
    cluster.until(cluster.node.works)
    family = cluster.node.family()
    cluster.node.kill()
    assert run.poll() is None and count(there) < EPISODES
    assert run.wait(timeout=120) == 0, run.stderr
    assert main([*small(here), "--workers", "1"]) == 0
    assert len(contents(there)) == EPISODES == count(there)
    assert contents(there) == contents(here)
    cluster.until(lambda: not any(map(alive, family)))


def wait_for(run: subprocess.Popen[str], out: Path, rows: int) -> None:
    began = time.monotonic()
    while count(out) < rows and run.poll() is None and time.monotonic() - began < 120:
        time.sleep(0.005)
    assert run.poll() is None, run.communicate()
