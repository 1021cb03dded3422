from __future__ import annotations

import json

import pytest

from training.benchmark.leaderboard import BEGIN, END, tables, update
from training.cli import main
from training.runs.errors import BadInput


def figure(value, low=None, high=None):
    return {"value": value, "low": low, "high": high}


def agent(time, ate=0.01):
    keys = ("reached_95", "path_length_m", "collisions_per_100_m", "map_iou", "corner_mean_m", "anees")
    own = {"time_to_95_s": figure(time, time and time - 1.0, time and time + 1.0), "ate_rmse_m": figure(ate)}
    return {key: figure(1.0) for key in keys} | own


SUMMARY = {
    "apartments": {"slow": agent(50.0), "fast": agent(40.0), "known-map": agent(30.0), "lost": agent(None)},
    "apartments-slippery": {"slow": agent(60.0), "fast": agent(45.0)},
    "comparison": {"all-nominal": {"fast": {"time_to_95_s": {"ratio": figure(0.8, 0.7, 0.9)}}}},
    "ends": {"apartments": {"slow": {"covered": 2}, "lost": {"time": 1, "stuck": 1}}, "apartments-slippery": {}},
    "config": {
        "seeds": {"apartments": [10000, 10001], "apartments-slippery": [10000]},
        "backends": ["ekf"],
        "baseline": "slow",
        "numpy": "2.4",
    },
}


def test_tables_rank_the_agents_and_tell_the_whole_story():
    text = tables(SUMMARY)
    suite = text.split("### apartments\n")[1].split("### ")[0]
    order = [suite.index(name) for name in ("*known-map*", "`fast`", "`slow`", "`lost`")]
    assert order == sorted(order)
    assert "40.0 [39.0, 41.0]" in suite and "1.00" in suite
    assert "`lost` time 1, stuck 1" in suite and "`slow` covered" not in suite
    overview = text.split("### apartments\n")[0]
    assert "-20.0 % [-30.0, -10.0]" in overview and "apartments-slippery" in overview
    assert "Seeds 10000 to 10001." in suite
    chosen = SUMMARY["config"] | {"seeds": {"apartments": [7, 0, 2, 1], "apartments-slippery": [5]}}
    told = tables(SUMMARY | {"config": chosen})
    assert "Seeds 0 to 2, 7." in told and "Seeds 5." in told, "not those between them"
    assert "numpy 2.4" in text and "baseline slow" not in text


def test_a_mean_nees_that_is_infinite_is_told_from_none():
    infinite, none = ({"n": n} | figure(None) for n in (3, 0))
    summary = SUMMARY | {
        "apartments": {"sure": agent(40.0) | {"anees": infinite}, "blind": agent(50.0) | {"anees": none}}
    }
    rows = tables(summary | {"ends": {"apartments": {}, "apartments-slippery": {}}}).splitlines()
    cells = {row.split(" | ")[0]: row for row in rows if row.count("|") > 8}
    assert "∞" in cells["| `sure`"] and "∞" not in cells["| `blind`"]


def test_update_keeps_the_rest_of_the_page():
    page = f"# Title\n{BEGIN}\nold\n{END}\nmore\n"
    once = update(page, "new")
    assert once == f"# Title\n{BEGIN}\n\nnew\n{END}\nmore\n"
    assert update(once, "new") == once
    with pytest.raises(BadInput, match="marks"):
        update("# Title\n", "new")


def test_command(tmp_path, capsys):
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    page = tmp_path / "PAGE.md"
    page.write_text(f"{BEGIN}{END}")
    assert main(["study", "leaderboard", str(tmp_path), str(page)]) == 0
    assert "### apartments" in page.read_text()
    assert main([str(tmp_path / "none"), str(page)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
