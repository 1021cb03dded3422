"""Policies over a hub: the library huggingface_hub itself, against a server on this machine."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import agents
from agents.learned.hub import HubPolicy, parse
from agents.ppo_frontier import SHIPPED
from tests.agents.learned.hub_server import Hub, running
from training.cli import main

Run = Callable[..., subprocess.CompletedProcess[str]]
FILES = {f"policy{suffix}": SHIPPED.with_suffix(suffix).read_bytes() for suffix in (".safetensors", ".json")}


def test_names() -> None:
    assert parse("hf://me/it") == HubPolicy("me/it")
    assert parse("hf://me/it/small@v1.0") == HubPolicy("me/it", "small", "v1.0")
    for text in ("hf://me", "hf://me/it/a/b", "hf://me/../x", "hf://me/it@", "hf:///it", "hf://me/it/a.safetensors",
                 "hf://me/it@a b", "hf://me/it\n", "hf://me/it/..", "hf://-/it?x=1"):  # fmt: skip
        with pytest.raises(ValueError, match="is not hf://USER/REPO"):
            parse(text)
    assert str(parse("hf://me/it/small@v1")) == "hf://me/it/small@v1" and str(HubPolicy("a/b")) == "hf://a/b"


def test_without_the_library_it_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(ValueError, match=r"pip install 'mecanum-slam\[hub\]'"):
        agents.make(f"hf://me/it@{'0' * 40}")


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[tuple[Hub, Run]]:
    pytest.importorskip("huggingface_hub")
    with running() as hub:
        environment = os.environ | {
            "HF_ENDPOINT": hub.address, "HF_HOME": str(tmp_path / "home"), "HF_TOKEN": "hf_secret",
            "HF_HUB_DISABLE_TELEMETRY": "1", "HF_HUB_DISABLE_PROGRESS_BARS": "1",
        }  # fmt: skip

        def run(*argv: object, **more: str) -> subprocess.CompletedProcess[str]:
            words = [sys.executable, "-m", "training.cli", *map(str, argv)]
            return subprocess.run(words, capture_output=True, text=True, env=environment | more, check=False)

        yield hub, run


def test_sent_fetched_and_explored_with(hub: tuple[Hub, Run], tmp_path: Path) -> None:
    server, run = hub
    for suffix in (".safetensors", ".json"):
        shutil.copy(SHIPPED.with_suffix(suffix), tmp_path / f"mine{suffix}")
    sent = run("policy", tmp_path / "mine.safetensors", "hf://me/explorer", "--private")
    assert sent.returncode == 0, sent.stderr
    commit = server.heads["me/explorer"]
    assert server.commits[f"me/explorer@{commit}"] == FILES and server.private == {"me/explorer": True}
    digest = hashlib.sha256(FILES["policy.safetensors"]).hexdigest()
    assert sent.stdout.splitlines()[0] == f"sent to hf://me/explorer@{commit}" and digest in sent.stdout
    fetched = run("policy", "hf://me/explorer", tmp_path / "theirs.safetensors")
    assert fetched.returncode == 0 and f"@{commit}" in fetched.stdout and digest in fetched.stdout, fetched.stderr
    assert (tmp_path / "theirs.safetensors").read_bytes() == FILES["policy.safetensors"]
    assert (tmp_path / "theirs.json").read_bytes() == FILES["policy.json"]
    # Pinned, it explores without the network: all is in the cache.
    server.asked.clear()
    argv = (
        "explore",
        "--agent",
        f"hf://me/explorer@{commit}",
        "--rooms",
        "rectangular",
        "--max-steps",
        3,
        "--json",
    )
    explored = run(*argv, "--out", tmp_path / "out")
    assert explored.returncode == 0 and json.loads(explored.stdout)["steps"] == 3, explored.stderr
    assert server.asked == []
    loose = run("explore", "--agent", "hf://me/explorer", "--out", tmp_path / "no")
    assert loose.returncode == 2 and f"name its commit, for instance hf://me/explorer@{commit}" in loose.stderr
    assert loose.stderr.count("\n") == 1 and not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("files", "lies", "words"),
    [
        ({"policy.json": FILES["policy.json"]}, {}, "policy.safetensors"),
        (FILES, {"ETag": f'"{"0" * 64}"'}, "by its checksum"),
        (FILES | {"policy.safetensors": b"\x80\x04cos\nsystem\n(S'true'\ntR."}, {}, "cannot be read"),
        (FILES | {"policy.json": b'{"format": "other"}'}, {}, "its format 'other' is none of"),
        (FILES, {"Content-Length": str(2**40)}, "a policy has at most"),
    ],
    ids=["a file is missing", "another checksum", "pickle", "another format", "too large"],
)  # fmt: skip
def test_what_is_not_taken(
    files: dict[str, bytes], lies: dict[str, str], words: str, hub: tuple[Hub, Run], tmp_path: Path
) -> None:
    server, run = hub
    commit, server.lies = server.add("me/it", files), lies
    argv = ["policy", f"hf://me/it@{commit}", tmp_path / "a.safetensors"]
    if "cannot be read" in words:
        argv = ["explore", "--agent", f"hf://me/it@{commit}", "--out", tmp_path / "out"]
    done = run(*argv)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and words in done.stderr, done.stderr
    assert not (tmp_path / "a.safetensors").exists() and not (tmp_path / "out").exists()


def test_what_the_hub_says_against_it(hub: tuple[Hub, Run], tmp_path: Path) -> None:
    server, run = hub
    refused = run("policy", SHIPPED, "hf://me/it", HF_TOKEN="hf_wrong")
    assert refused.returncode == 2 and "hf auth login" in refused.stderr and refused.stderr.count("\n") == 1
    nothing = run("policy", "hf://me/nothing", tmp_path / "a.safetensors")
    assert nothing.returncode == 2 and "hf://me/nothing" in nothing.stderr and nothing.stderr.count("\n") == 1
    gone = run("policy", "hf://me/it", tmp_path / "a.safetensors", HF_ENDPOINT="http://127.0.0.1:9")
    assert gone.returncode == 2 and "check the name, the network" in gone.stderr
    assert server.commits == {}


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["mine.safetensors", "hf://me/it"], "mine.safetensors"),
        (["mine.zip", "hf://me/it"], "give a .safetensors file"),
        (["hf://me/it", "mine.zip"], "give the name of a .safetensors file"),
        (["hf://me", "a.safetensors"], "is not hf://"),
        (["a.safetensors", "a.zip", "--private"], "--private is of a hub"),
        (["hf://me/it", "a.safetensors", "--member", "2"], "--like and --member are of a .zip"),
    ],
)  # fmt: skip
def test_bad_input(argv: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["policy", *argv]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
