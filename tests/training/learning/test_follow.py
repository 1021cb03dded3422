"""``--wandb``: Weights & Biases itself, offline; what it wrote is read back."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("sb3_contrib")

from slam.settings import from_mapping
from tests.training.learning.small_runs import SMALL, Killed, curve
from training.cli import main
from training.learning.config import TrainConfig
from training.learning.follow import Follow
from training.learning.ppo import Run
from training.runs.errors import BadInput


def test_without_the_library_it_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main(["train", "--wandb", "trial", "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == "mecanum train: --wandb needs wandb; install it with pip install 'mecanum-slam[wandb]'"
    assert not (tmp_path / "out").exists()


def test_nobody_is_told_nothing_and_imports_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with Follow().noting(tmp_path, config={}, identity="x") as note:
        note({"steps": 1})


def records(path: Path) -> list[Any]:
    """Return the records of a .wandb file: LevelDB's log format, blocks of 32 KiB, behind seven bytes."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, whole, found = path.read_bytes(), 7, b"", []
    while at + 7 <= len(data):
        if 32768 - at % 32768 < 7:
            at += 32768 - at % 32768
            continue
        size, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        whole += data[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # whole, or the last piece
            record = Record()
            record.ParseFromString(whole)
            found.append(record)
            whole = b""
    return found


def test_a_run_and_its_going_on_are_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    config, out = from_mapping(TrainConfig, SMALL), tmp_path / "frontier"

    def log(text: str) -> None:
        if kill and text.startswith("ppo, chunk 2 "):
            raise Killed

    for kill in (True, False):
        run = Run(config, out, workers=1, log=log, command="as typed", follow=Follow("trial"))
        if kill:
            with pytest.raises(Killed):
                run.train()
        else:
            run.train()
    files = sorted(out.glob("wandb/offline-run-*/run-*.wandb"))
    identity = json.loads((out / "progress.json").read_text())["identity"]
    assert files and {path.name for path in files} == {f"run-{identity}.wandb"}
    found = [record for path in files for record in records(path)]
    (begun, *_) = [record.run for record in found if record.HasField("run")]
    assert begun.project == "trial" and begun.display_name == f"{tmp_path.name}/frontier"
    told = {item.key: json.loads(item.value_json) for item in begun.config.update}
    assert told["command"] == "as typed" and told["ppo"]["steps"] == 48
    rows = [
        {"/".join(item.nested_key) or item.key: json.loads(item.value_json) for item in record.history.item}
        for record in found if record.HasField("history")
    ]  # fmt: skip
    trials = [(row["steps"], row["evaluation/time_to_95_s"]) for row in rows if "evaluation/time_to_95_s" in row]
    assert set(trials) == {(line["steps"], line["time_to_95_s"]) for line in curve(out)}
    updates = {row["steps"] for row in rows if "train/approx_kl" in row}
    assert updates and updates <= {16, 32, 48}


def test_what_wandb_says_against_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    with pytest.raises(BadInput, match=r"--wandb a/b: .*wandb login"), Follow("a/b").noting(
        tmp_path, config={}, identity="x"
    ):  # fmt: skip
        pass
