"""Tables as text, and charts whose bytes are the same each time."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from training.figures.charts import chart, label, png
from training.figures.consistency import consistency_figures
from training.figures.tables import csv_table, markdown_table, number, text_table
from training.replay.picture import draw_replay
from training.runs.errors import BadInput
from training.runs.rows import resume
from training.runs.typed import whole_numbers


def test_columns_line_up() -> None:
    assert text_table(["who", "n"], [["a", "100"], ["long", "1"]]) == "who     n\na     100\nlong    1"
    assert markdown_table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"
    assert csv_table([{"a": 1}, {"b": None, "a": "x,y"}], ["c"]) == 'c,a,b\n,1,\n,"x,y",\n'
    assert number(None, 2) == "–" and number(1.005, 1, "-") == "1.0"


def test_a_chart_has_neither_date_nor_version_in_it() -> None:
    def drawn() -> bytes:
        figure, panels = chart(2, size=(300, 400))
        panels[0].plot([1, 2], [3.0, np.nan], label="a")
        label(panels[0], "σ", "t [s]", "x", log="y")
        return png(figure)

    assert drawn() == drawn()
    assert b"tEXt" not in drawn()


def test_dead_reckoning_does_not_widen_a_replay_s_picture() -> None:
    path, far = np.array([[0.0, 0.0], [np.nan, np.nan], [2.0, 1.0]]), np.array([[0.0, 0.0], [1e4, 1e4]])
    none = np.zeros((0, 2))
    figure = draw_replay(
        reference=none, reckoned=far, estimate=path, landmarks=np.array([[1.0, 3.0]]),
        surveyed=np.full((1, 2), np.nan), title="",
    )  # fmt: skip
    left, right, low, high = figure.axes[0].axis()
    assert -1 < left < 0 and 2 < right < 3 and -1 < low < 0 and 3 < high < 4


def test_numbers_of_an_option() -> None:
    assert whole_numbers("--n", "5, 1,5", low=1, high=10) == [1, 5]
    for wrong in ("", "0", "11", "a", "1,,2", "-1", "9" * 5000):
        with pytest.raises(BadInput, match=r"--n .* must be whole numbers in 1 … 10"):
            whole_numbers("--n", wrong, low=1, high=10)


def double(job: tuple[str, int]) -> list[int]:
    return [2 * job[1]]


def test_a_job_that_is_asked_for_twice_is_done_once(tmp_path: Path) -> None:
    store, done = tmp_path / "rows.jsonl", []
    rows = resume(store, [("a", 1), ("a", 1)], lambda job: done.append(job) or double(job), workers=1)
    assert rows == {("a", 1): [2]} and done == [("a", 1)] and len(store.read_text().splitlines()) == 1


def test_rows_are_resumed_and_a_line_cut_off_is_done_again(tmp_path: Path) -> None:
    store = tmp_path / "new" / "rows.jsonl"
    assert resume(store, [("a", 1), ("a", 2)], double, workers=1) == {("a", 1): [2], ("a", 2): [4]}
    first, second = store.read_text().splitlines()
    kept = [["b", 3], [7]]
    other = json.dumps([*kept, zlib.crc32(json.dumps(kept).encode())])
    store.write_text(f"{other}\n{first}\n{second[:9]}")
    rows = resume(store, [("b", 3), ("a", 2)], double, workers=1)
    assert rows == {("b", 3): [7], ("a", 2): [4]} and list(rows) == [("b", 3), ("a", 2)]
    assert resume(store, [("a", 2), ("a", 1)], pytest.fail, workers=1) == {("a", 2): [4], ("a", 1): [2]}


def test_what_befalls_the_longest_run_is_in_the_mean() -> None:
    found = consistency_figures([[3.0] * 10, [3.0] * 10, [3.0] * 10 + [300.0] * 10])
    assert found["nees_over_3_mean"] == pytest.approx((30 * 1 + 10 * 100) / 40)
    assert found["fraction_in_band"] == 1.0  # of the seconds that at least half of the runs reach


def test_runs_that_end_early_leave_the_average_to_the_others() -> None:
    found = consistency_figures([[3.0, 3.0, 300.0], [3.0, 3.0, 300.0], [3.0]])
    assert found["nees_over_3_mean"] == pytest.approx((5 * 1 + 2 * 100) / 7)
    assert found["fraction_in_band"] == pytest.approx(2 / 3)
    assert consistency_figures([[]])["nees_over_3_mean"] is None
    # So does a robot that ended while its team went on: the band is that of those that are left.
    one, ended = [[3.0, 6.0]], [[3.0, np.nan]]
    assert consistency_figures(one * 10 + ended * 90)["fraction_in_band"] == pytest.approx(0.5)
    assert consistency_figures(one + ended * 99)["fraction_in_band"] == pytest.approx(1.0)
