"""Names from outside are data: in pages, pictures, tables, databases and exports, whatever they say."""

from __future__ import annotations

import json
import os
import sqlite3
import tomllib
from contextlib import closing
from pathlib import Path

import pytest

from mecanum_env.config import from_toml
from slam.landmarks.database import read_landmark_map
from tests.training.pages import assert_strict
from tests.training.plans import write_room
from training.cli import main
from training.episodes import explore
from training.episodes.recording import Recorder
from training.figures.tables import markdown_name, markdown_table, text_table
from training.replay.picture import draw_replay
from training.views.episode_files import write_episode

ODD = "\"'`<script>alert(1)<!--|$a^$_{}\n\x1b[31m\u202egnp.{{DATA}}"
LONG = ODD + "x" * (240 - len(ODD.encode())) + ".png"

SHOWN = "\"'`<script>alert(1)<!--|$a^$_{}\\n\\x1b[31m\\u202egnp.{{DATA}}"


def test_an_episode_in_a_plan_with_an_odd_name(tmp_path: Path) -> None:
    plan = write_room(tmp_path / LONG)
    episode, recorder = explore.prepare(out=tmp_path / "out", floor_plan=plan, max_steps=5), Recorder()
    explore.run(episode, lambda **_: None, [recorder])
    extras = ["mcap", "rerun"]
    for name in ("mcap", "rerun"):
        pytest.importorskip(name)
    write_episode(episode, recorder.recording(), extras=extras)
    out = tmp_path / "out"
    html = (out / "report.html").read_text("utf-8")
    page = assert_strict(html)
    assert SHOWN in page.text and html.count("<script") == 3 and "\u202e" not in html and "\x1b" not in html
    # As data it is what it is, to the letter.
    assert json.loads((out / "metrics.json").read_text("utf-8"))["floor_plan"] == str(plan)
    assert from_toml(out / "config.toml").floor_plan == str(plan)
    assert read_landmark_map(out / "landmarks.db").meta["backend"] == "invariant-ekf"
    assert SHOWN.encode() in (out / "episode.mcap").read_bytes() and (out / "episode.rrd").stat().st_size > 0
    again = explore.prepare(out=tmp_path / "again", config=out / "config.toml")
    assert again.config.floor_plan == str(plan)


def test_a_name_that_is_no_text_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = write_room(tmp_path / "plan.png")
    odd = Path(os.fsdecode(bytes(tmp_path) + b"/\xff.png"))
    plan.rename(odd)
    assert main(["explore", "--floor-plan", str(odd), "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no UTF-8; rename it" in said and "\\udcff" in said


def test_the_terminal_is_told_odd_names_as_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plan = write_room(tmp_path / LONG)
    assert main(["explore", "--floor-plan", str(plan), "--max-steps", "1", "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "\x1b" not in said and "\u202e" not in said and "\\x1b[31m" in said
    assert main(["explore", "--floor-plan", str(plan) + ".gone", "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "\x1b" not in said and "\u202e" not in said


def test_odd_names_in_tables() -> None:
    text = text_table(["name", "n"], [[ODD, "1"]])
    assert text.count("\n") == 1 and "\x1b" not in text and "\u202e" not in text
    cell = markdown_name(ODD)
    assert cell.startswith("`` ") and cell.endswith(" ``") and "|" not in cell.replace("\\|", "")
    assert markdown_table(["a", "b"], [[cell, "1"]]).count("\n") == 2
    assert markdown_name("brisk-tour") == "`brisk-tour`"


def test_a_formula_in_a_logs_name_is_drawn_as_it_is_typed() -> None:
    import numpy as np

    from training.figures.charts import png

    nothing = np.zeros((0, 2))
    path = np.zeros((2, 3))
    figure = draw_replay(
        reference=path, reckoned=path, estimate=path, landmarks=nothing, surveyed=nothing, title="a $x^$ \\frac{ b"
    )
    assert png(figure).startswith(b"\x89PNG")


def test_a_database_says_odd_names_to_the_letter(tmp_path: Path) -> None:
    from slam.landmarks.database import write_landmark_map

    path = tmp_path / LONG.replace(".png", ".db")
    write_landmark_map(path, [[0.0, 0.0]], cov=[[[1.0, 0.0], [0.0, 1.0]]], backend=ODD)
    assert read_landmark_map(path).meta["backend"] == ODD
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("SELECT count(*) FROM landmarks").fetchone() == (1,)


def test_toml_holds_odd_names() -> None:
    import tomli_w

    assert tomllib.loads(tomli_w.dumps({"a": ODD}))["a"] == ODD
