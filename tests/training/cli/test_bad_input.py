"""Bad input on the command line: exit code 2, one line that says what and what to do, nothing written."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.training.plans import write_room
from training.cli import main


def refused(argv: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Run the command line, which must refuse; return the one line on standard error."""
    assert main(argv) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.endswith("\n") and printed.err.count("\n") == 1, printed.err
    assert printed.err.startswith("mecanum")
    return printed.err


def explore_refused(argv: list[str], capsys: pytest.CaptureFixture[str], out: Path) -> str:
    line = refused(["explore", "--out", str(out), *argv], capsys)
    assert not out.exists()
    assert line.startswith("mecanum explore: ")
    return line


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ["explor"],
            [
                "unknown command 'explor'",
                "did you mean explore?",
                "valid: benchmark, complexity, consistency, doctor, explore, play, policy, replay, rooms, ros, ",
            ],
        ),
        (["--sed", "3"], ["unknown option --sed", "--version"]),
        (["explore", "--agnt", "x"], ["unknown option --agnt", "did you mean --agent?", "--coverage-target"]),
        (["explore", "--seed", "x"], ["--seed", "integer"]),
        (["explore", "--seed", "-1"], ["--seed"]),
        (["explore", "--max-steps", "0"], ["--max-steps"]),
        (["explore", "--out"], ["--out"]),
        (["explore", "apartment"], ["apartment"]),
    ],
)
def test_bad_usage(argv: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(argv, capsys)
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (
            ["--agent", "nearest-frontir"],
            ["unknown agent", "did you mean 'nearest-frontier'?", "random"],
        ),
        (["--slam", "efk"], ["unknown SLAM backend", "did you mean 'ekf'?", "odometry"]),
        (["--rooms", "appartment"], ["unknown rooms", "did you mean 'apartment'?", "rectangular"]),
        (["--robot", "yuobot"], ["unknown robot", "did you mean 'youbot'?", "cavity"]),
        (["--noise", "nominall"], ["unknown noise preset", "did you mean 'nominal'?", "slippery"]),
        (["--start", "nan,0,0"], ["--start", "finite"]),
        (["--start", "1,2"], ["--start", "X,Y,THETA"]),
        (["--start", "a,b,c"], ["--start", "X,Y,THETA"]),
        (["--coverage-target", "0"], ["--coverage-target", "greater", "got '0'"]),
        (["--coverage-target", "nan"], ["--coverage-target", "got 'nan'"]),
        (["--rooms", "rectangular", "--start", "999,0,0"], ["start", "free"]),
    ],
)
def test_bad_names_and_numbers(
    argv: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = explore_refused(argv, capsys, tmp_path / "out")
    assert all(word in line for word in words), line


def huge_png() -> bytes:
    """Return a PNG that announces 20,000 × 20,000 pixels."""
    chunks = b"IHDR" + struct.pack(">IIBBBBB", 20_000, 20_000, 8, 0, 0, 0, 0), b"IDAT" + zlib.compress(bytes(100))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) for chunk in chunks
    )


def write_plan(kind: str, folder: Path) -> Path:
    path = folder / "plan.png"
    if kind == "damaged":
        path.write_bytes(b"\x89PNG\r\n\x1a\n and then nothing of the sort")
    elif kind == "too large":
        path.write_bytes(huge_png())
    elif kind == "all walls":
        assert cv2.imwrite(str(path), np.zeros((60, 60), np.uint8))
    return path


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("missing", ["does not exist", "check the path"]),
        ("damaged", ["damaged"]),
        ("too large", ["400000000 pixels", "too large", "scale it down"]),
        ("all walls", ["no free space"]),
    ],
)
def test_bad_floor_plans(kind: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_plan(kind, tmp_path)
    line = explore_refused(["--floor-plan", str(path)], capsys, tmp_path / "out")
    assert all(word in line for word in [*words, str(path)]), line


def test_rooms_beside_a_floor_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    places = ["--rooms", "cave", "--floor-plan", str(write_room(tmp_path / "room.png"))]
    for line in (
        explore_refused(places, capsys, tmp_path / "out"),
        explore_refused([*places, "--robots", "2"], capsys, tmp_path / "out"),
        refused(["play", *places], capsys),
    ):
        assert "instead of rooms; leave out the one or the other" in line


def test_a_start_inside_a_wall_or_too_near_to_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = write_room(tmp_path / "room.png")
    for start in ("0.1,0.1,0", "0.35,1.5,0", "-5,0,0", "1e300,0,0"):
        line = explore_refused(["--floor-plan", str(plan), "--start", start], capsys, tmp_path / "out")
        assert "start" in line and "choose" in line, line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, ["cannot read config", "No such file"]),
        ("slam = [unclosed", ["not TOML"]),
        ("slmm = 'ekf'", ["unknown key of EnvConfig 'slmm'", "did you mean 'slam'?"]),
        ("[robot]\nlength = 1.0", ["unknown key of RobotConfig 'length'", "length_m"]),
        ("[robot]\nmass_kg = -1.0", ["mass_kg must be"]),
        ("[lidar]\nbeams = 'many'", ["EnvConfig.lidar.beams", "got 'many'"]),
        ("slam = 'efk'", ["unknown SLAM backend 'efk'"]),
        ("[slam_config]\ngrid = 1", ["grid"]),
        ("slam_config = 3", ["slam_config must be a mapping, got 3"]),
        ("[rooms_config]\nwalls = 1", ["walls"]),
        *(
            (f"odometry_filter = 'differential-transform'\n[odometry_filter_config]\n{line}", [line.split()[0]])
            for line in ("start_sigmas = ['a', 1, 2]", "start_sigmas = 3.0", "rest_speed_m_s = inf")
        ),
        ("[run]\nagnet = 'ppo'", ["[run] has no agnet", "did you mean agent?"]),
        ("[run]\nagent = 'nobody'", ["unknown agent 'nobody'"]),
        ("[run]\nseed = 'x'", ["seed", "wrong type"]),
        ("[run]\nseed = -3", ["seed ≥ 0"]),
        ("[run]\nstart = [1.0, nan, 0.0]", ["start"]),
        ("run = 3", ["[run]", "wrong type"]),
    ],
)
def test_bad_configs(
    text: str | None, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "config.toml"
    if text is not None:
        path.write_text(text, "utf-8")
    line = explore_refused(["--config", str(path)], capsys, tmp_path / "out")
    assert all(word in line for word in words), line


@pytest.mark.parametrize("command", [["explore", "--rooms", "rectangular"], ["rooms", "--seeds", "0"]])
@pytest.mark.parametrize("below", ["", "below", "far/below"])
def test_an_out_that_cannot_be_written_to(
    command: list[str], below: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A file in the way: what not even the superuser can write to.
    in_the_way = tmp_path / "file"
    in_the_way.write_text("mine")
    line = refused([*command, "--out", str(in_the_way / below)], capsys)
    assert "cannot write to" in line and "is not a folder" in line and "choose another --out" in line
    assert in_the_way.read_text() == "mine"


@pytest.mark.parametrize(
    "argv",
    [
        ["explore", "--out", ""], ["explore", "--out="], ["rooms", "--out", ""], ["consistency", "--out="],
        ["explore", "--config", ""], ["study", "worlds", "--out", ""],
    ],
)  # fmt: skip
def test_no_name_at_all_is_not_the_current_folder(
    argv: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(argv, capsys)
    option = next(word for word in argv if word.startswith("--")).rstrip("=")
    assert f"'{option}': it is empty; give a name" in line
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="no /proc")
def test_a_place_that_takes_no_files_is_found_before_anything_is_done(capsys: pytest.CaptureFixture[str]) -> None:
    """Root may write anywhere by what permissions say."""
    assert main(["rooms", "--out", "/proc/there"]) == 2
    line = capsys.readouterr().err
    assert "cannot write to /proc/there: " in line and "choose another --out" in line


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--kind", "castle"], ["unknown rooms 'castle'", "apartment"]),
        (["--robot", "r2d2"], ["unknown robot 'r2d2'", "youbot"]),
        (["--seeds", "x"], ["--seeds 'x'", "0:9"]),
        (["--seeds", ""], ["--seeds ''", "0:9"]),
        (["--seeds", "1,,2"], ["--seeds", "0:9"]),
        (["--seeds", "-3"], ["--seeds '-3'", "0:9"]),
        (["--seeds", "9:1"], ["upwards"]),
        (["--seeds", "99999999999"], ["at most"]),
        (["--seeds", "0:1000000000"], ["more than 100"]),
        (["--seeds", "0:60,100:160"], ["more than 100"]),
    ],
)
def test_bad_rooms(argv: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["rooms", "--out", str(tmp_path / "out"), *argv], capsys)
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--rooms", "castle"], ["unknown rooms 'castle'", "apartment"]),
        (["--slam", "efk"], ["unknown SLAM backend 'efk'", "did you mean 'ekf'?"]),
        (["--beams", "2"], ["--beams"]),
        (["--steps", "nan"], ["--steps"]),
        (["--steps", "1"], ["--steps", "100"]),
    ],
)
def test_bad_speed(argv: list[str], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["speed", *argv], capsys)
    assert all(word in line for word in words), line
