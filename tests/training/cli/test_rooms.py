from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import cv2
import pytest

from training.cli import main
from training.episodes import room_pictures
from training.episodes.room_pictures import parse_seeds


@pytest.mark.parametrize(
    ("text", "seeds"),
    [
        ("3", [3]),
        ("0:3", [0, 1, 2, 3]),
        ("4:4", [4]),
        ("1,4,7", [1, 4, 7]),
        ("7, 1:2,1", [7, 1, 2]),
        ("0:99", list(range(100))),
    ],
)
def test_seeds(text: str, seeds: list[int]) -> None:
    assert parse_seeds(text) == seeds


def test_rooms_are_drawn_one_by_one_and_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "deep" / "out"
    assert main(["rooms", "--kind", "rectangular", "--seeds", "0:1,5", "--out", str(out), "--json"]) == 0
    drawn = json.loads(capsys.readouterr().out)
    assert drawn["seeds"] == [0, 1, 5]
    assert sorted(p.name for p in out.iterdir()) == [
        "rectangular-0.png", "rectangular-1.png", "rectangular-5.png", "rectangular-sheet.png",
    ]  # fmt: skip
    first, second = (cv2.imread(drawn["files"][i]) for i in (0, 1))
    assert first is not None and second is not None
    assert first.shape != second.shape or (first != second).any()
    sheet = cv2.imread(drawn["sheet"])
    assert sheet is not None and sheet.size > 0
    # Drawn again, the same files come out.
    before = Path(drawn["files"][2]).read_bytes()
    assert main(["rooms", "--kind", "rectangular", "--seeds", "5", "--out", str(out)]) == 0
    assert Path(drawn["files"][2]).read_bytes() == before
    assert "1 plans" in capsys.readouterr().out


def test_ctrl_c_keeps_the_plans_that_are_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make = room_pictures.room_registry.make

    def pressed(kind: str, *, seed: int) -> Any:
        if seed == 1:
            signal.raise_signal(signal.SIGINT)
        return make(kind, seed=seed)

    monkeypatch.setattr(room_pictures.room_registry, "make", pressed)
    assert main(["rooms", "--kind", "rectangular", "--seeds", "0:9", "--out", str(tmp_path)]) == 130
    assert f"interrupted after 2 of 10 plans, which are in {tmp_path}" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rectangular-0.png", "rectangular-1.png"]
