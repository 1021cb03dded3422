"""The benchmark's page: whole, self-contained, safe, and with the worst cases first."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from tests.training.benchmark.small import made_up_group
from training.benchmark.figures import Group
from training.benchmark.output import Report, as_json, markdown, table, write_tables
from training.benchmark.report import page, worst_first, write_report
from training.benchmark.report_charts import band, coverage_chart, extent

VOID = {"meta", "img", "br", "line"}


class Page(HTMLParser):
    """Checks that what is opened is closed, and collects what a browser would load or name."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.tags: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "src" or (name == "href" and tag != "a"):
                self.loaded.append(value or "")
            elif name == "href":
                self.links.append(value or "")
            elif name == "id":
                assert value not in self.anchors
                self.anchors.add(value or "")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag


def some_groups() -> list[Group]:
    reached = [50.0, None, 40.0, 30.0]
    return [
        made_up_group(agent, suite, time_to_95_s=times, collisions=[0, 2, 0, 0])
        for suite in ("rooms", "mazes", "rooms-slippery")
        for agent, times in (("nearest-frontier", reached), ("random <b>", [80.0, None, None, 90.0]))
    ]


def some_report(groups: list[Group] | None = None, baseline: str | None = "nearest-frontier") -> Report:
    config = {"agents": ["nearest-frontier", "random <b>"], "split": "test", "mecanum-slam": "0.1.0"}
    return Report.of(some_groups() if groups is None else groups, baseline=baseline, config=config)


def test_the_page_is_whole_and_needs_nothing_else(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("slam = '</pre><script>'")
    write_report(tmp_path, some_report())
    text = (tmp_path / "report.html").read_text("utf-8")
    parsed = Page(text)
    assert all(source.startswith("data:image/png;base64,") for source in parsed.loaded)
    assert {link.removeprefix("#") for link in parsed.links} <= parsed.anchors
    assert "script" not in parsed.tags and "url(" not in text and "://" not in text
    assert "<b>" not in re.sub(r"<b>(rectangular, )?seed \d+</b>", "", text)  # names are text
    assert parsed.tags.count("svg") == 6 and parsed.tags.count("figure") == 24
    assert "prefers-color-scheme: dark" in text and "width=device-width" in text
    assert "is of at least 10 episodes: of fewer" in text  # the four here have no colour
    assert "all nominal suites together" in text and "all slippery" not in text  # of which there is but one


def test_a_page_of_one_agent_compares_nothing() -> None:
    report = some_report([made_up_group(time_to_95_s=[50.0, 60.0])], baseline=None)
    text = page(report, config_text="")
    Page(text)
    assert "Against" not in text
    assert "comparison" in as_json(report) and as_json(report)["comparison"] == {}


def test_one_episode_has_figures_but_no_intervals() -> None:
    groups = [made_up_group(agent, time_to_95_s=[50.0]) for agent in ("nearest-frontier", "b")]
    report = some_report(groups)
    text = page(report, config_text="") + table(report) + markdown(report)
    assert "nan" not in text and "50.0" in text
    assert as_json(report)["rooms"]["b"]["time_to_95_s"]["low"] is None


def test_the_worst_come_first() -> None:
    group = made_up_group(
        time_to_95_s=[50.0, None, 40.0, None, 45.0], coverage=[0.99, 0.9, 0.97, 0.4, 0.99],
        ate_rmse_m=[0.1, 9.0, 0.2, 0.0, 0.05], collisions=[0, 0, 0, 1, 1],
    )  # fmt: skip
    assert [key[2] for key, _ in worst_first(group.keys, group.rows)] == [3, 1, 4, 2, 0]
    text = page(some_report([group], baseline=None), config_text="")
    assert re.findall(r"<b>seed (\d)</b>", text) == ["3", "1", "4", "2", "0"]


def test_curves_hold_their_last_value_and_have_the_middle_half_around_them() -> None:
    group = made_up_group(time_s=[10.0, 20.0, 40.0], path_length_m=[1.0, 2.0, 4.0])
    found = band(group, name="a", along="time_s", high=40.0)
    assert np.all(found.low <= found.middle) and np.all(found.middle <= found.high)
    np.testing.assert_allclose([found.low[0], found.middle[-1], found.low[-1]], [0.1, 0.99, 0.99], rtol=1e-6)
    # At 20 s the second is done, the first long since, the third halfway.
    np.testing.assert_allclose(np.interp(20.0, found.x, found.middle), 0.99, atol=0.01)
    chart = coverage_chart([found], along="time_s", colours=[9])
    assert "c1 dashed" in chart and "nan" not in chart
    assert extent([group], "time_s") == pytest.approx(36.0)
    slow = made_up_group(time_s=[1000.0], path_length_m=[1.0])
    assert extent([group, slow], "time_s") == pytest.approx(3 * 36.0)


def test_tables_say_the_same_in_every_form(tmp_path: Path) -> None:
    report = some_report()
    write_tables(tmp_path, report)
    found = json.loads((tmp_path / "summary.json").read_text("utf-8"))
    ours = found["mazes"]["random <b>"]
    assert ours["time_to_95_s"]["iqm"] == pytest.approx((90 + 300) / 2) and ours["reached_95"]["value"] == 0.5
    assert ours["time_to_95_s"]["median"] is None  # infinite
    against = found["comparison"]["all-nominal"]["random <b>"]["time_to_95_s"]
    assert against["n"] == 8
    assert against["ratio"]["value"] == pytest.approx(found["comparison"]["mazes"]["random <b>"]["time_to_95_s"]
                                                      ["ratio"]["value"])  # fmt: skip
    lines = (tmp_path / "comparison.csv").read_text("utf-8").splitlines()
    assert sum(line.startswith("all-nominal,random <b>,ekf,nearest-frontier,") for line in lines) == len(
        found["comparison"]["mazes"]["random <b>"]
    )
    tables = markdown(report)
    assert tables.startswith("## all nominal suites together") and "| `random <b>` | 4 | 50 [" in tables
    rows = [line.count("|") for line in tables.splitlines() if "` | 4 |" in line]
    assert len(rows) == 6 and len(set(rows)) == 1
    printed = table(report)
    assert "195.0" in printed and "against nearest-frontier" in printed


def test_several_backends_have_names_of_their_own() -> None:
    a = made_up_group("a", time_to_95_s=[1.0, 2.0])
    b = Group(suite="rooms", agent="a", slam="odometry", keys=a.keys, rows=a.rows)
    assert as_json(some_report([a, b], baseline="a"))["rooms"].keys() == {"a@ekf", "a@odometry"}
