"""The campaign against the readers, in short: its parts, its bounds, and that it finds what is wrong."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.cli import main
from training.runs.errors import BadInput
from training.studies.reliability.command import PARTS
from training.studies.reliability.files import child, guard
from training.studies.reliability.files.forked import run_forked
from training.studies.reliability.files.mutations import MUTATIONS, mutated, mutated_cells
from training.studies.reliability.files.readers import READERS, Reader
from training.studies.reliability.files.samples import landmarks

QUICK = ("carmen", "configs", "landmarks", "policies", "ros-maps", "rows", "run-files", "victoria-park")
QUICK += ("ros-bags",) if "ros-bags" in READERS else ()
_SLOW = ("600 MB", "100 MB", "deep key", "deep table", "million", "noise", "10⁹", "end of header")


def judged(reader: Reader, index: int, folder: Path) -> dict[str, Any]:
    folder.mkdir()
    return child.one_file(reader, 0, index, folder)


@pytest.mark.parametrize("name", QUICK)
def test_a_sample_of_every_reader_is_read_or_refused_in_one_line(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    hostile = [k for k, case in enumerate(reader.hostile) if not any(word in case for word in _SLOW)]
    stride = max(len(hostile) // 12, 1)
    damaged = range(len(reader.hostile), len(reader.hostile) + 8)
    for index in (*hostile[::stride], *damaged):
        if not reader.by_command(index):
            row = judged(reader, index, tmp_path / str(index))
            assert row["end"] in ("read", "refused"), row


@pytest.mark.parametrize("name", QUICK)
def test_sound_files_are_read(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    entry, names = reader.variants[0]
    for file in names:
        (tmp_path / file).write_bytes(reader.sound()[file])  # type: ignore[arg-type]
    reader.use(tmp_path / entry)


def test_the_same_number_is_the_same_file(monkeypatch: pytest.MonkeyPatch) -> None:
    reader = READERS["carmen"]
    first = [reader.case(3, k) for k in range(200, 240)]
    monkeypatch.setattr(time, "time", lambda: 2e9)  # whenever it is made: packed files can hold the hour
    assert any(case.entry.endswith(".gz") for case in first)
    assert first == [reader.case(3, k) for k in range(200, 240)]
    assert first != [reader.case(4, k) for k in range(200, 240)]


def test_every_mutation_changes_something() -> None:
    rng, data = np.random.default_rng(0), b"a: 12\nb: 3.5\nc: [1, 2]\n" * 20
    for name, mutate in MUTATIONS.items():
        results = set()
        for _ in range(5):
            out = bytearray(data)
            mutate(out, rng)
            results.add(bytes(out))
        assert results - {data}, name
    assert mutated(b"", rng) == (b"", [])
    content = landmarks()["landmarks.db"]
    assert any(mutated_cells(content, rng)[0] != content for _ in range(5))


def test_the_command_is_run_on_a_file_and_says_so_in_a_line(tmp_path: Path) -> None:
    reader = READERS["configs"]
    sound = tmp_path / "sound.toml"
    sound.write_bytes(reader.sound()["config.toml"])
    reader.read(sound, reader.every - 1)
    assert (tmp_path / "out").is_dir()
    bad = tmp_path / "bad.toml"
    bad.write_text("rooms = 3\n", "utf-8")
    with pytest.raises(BadInput, match=r"^mecanum explore: .*rooms"):
        reader.read(bad, reader.every - 1)
    code, said = run_forked(["explore", "--floor-plan", str(tmp_path / "none.png")])
    assert code == 2 and said.startswith("mecanum explore: ") and said.count("\n") == 1
    assert run_forked(["--version"]) == (0, "")


@pytest.mark.parametrize(
    ("error", "end"),
    [
        (KeyError("x"), "traceback"), (MemoryError(), "memory"), (ValueError("file: two\nlines"), "no one line"),
        (ValueError("file.x: " + "long " * 500), "no one line"), (ValueError("something is wrong"), "no name"),
        (UnicodeDecodeError("utf-8", b"x", 0, 1, "file"), "traceback"), (ValueError("file is bad"), "refused"),
        (None, "read"),
    ],
)  # fmt: skip
def test_what_a_reader_does_wrong_is_found(error: Exception | None, end: str, tmp_path: Path) -> None:
    def use(path: Path) -> None:
        if error is not None:
            raise error

    reader = Reader(about="x", sound=lambda: {"file": b"1"}, variants=(("file", ("file",)),), use=use)
    assert child.one_file(reader, 0, 0, tmp_path)["end"] == end


def test_a_child_that_hangs_or_dies_is_noted_and_the_next_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "_MODULE", "tests.training.studies.reliability.bad_child")
    monkeypatch.setattr(guard, "BOUND_S", 0.5)
    monkeypatch.setattr(guard, "_PATIENCE_S", 2.0)
    monkeypatch.setattr(guard, "_LOOKS_S", 0.1)
    began = time.monotonic()
    ends = [(row["index"], row["end"]) for row in guard.results("any", 0, 0, 6)]
    guard._CHILD.end()
    assert ends == [(0, "read"), (1, "died of -9"), (2, "read"), (3, "time"), (4, "read"), (5, "read")]
    assert time.monotonic() - began < 60


def test_the_command_goes_on_and_writes_what_it_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = {name: READERS[name] for name in ("rows", "landmarks")}
    for module in ("part", "readers"):
        monkeypatch.setattr(f"training.studies.reliability.files.{module}.READERS", quick)
    argv = ["study", "reliability", "--parts", "files", "--files", "6", "--out", str(tmp_path)]
    assert main(argv) == 0
    found = json.loads((tmp_path / "files.json").read_text())
    assert found["tried"] == 12 and found["failures"] == [] and found["readers"]["rows"]["files"] == 6
    assert (
        "landmarks" in (tmp_path / "report.html").read_text() and "12 tried, 0 failed" in capsys.readouterr().out
    )
    began = time.monotonic()
    assert main(argv) == 0
    assert time.monotonic() - began < 5
    assert main(["study", "reliability", "--parts", "nothing", "--out", str(tmp_path)]) == 2
    monkeypatch.setattr("training.runs.campaign.project_digest", lambda: "of other code")
    capsys.readouterr()
    assert main(argv) == 2
    assert "choose another --out" in capsys.readouterr().err


def test_every_part_has_an_option_of_its_name() -> None:
    from training.cli.study import study_command

    options = {name for p in study_command("reliability").params for name in p.opts}
    assert {f"--{name}" for name in PARTS} <= options
