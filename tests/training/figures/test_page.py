"""Every page that we write is strict: found in the sources, and proved of each."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import training
from tests.training.pages import assert_strict, hashed
from training.benchmark import leaderboard
from training.benchmark.figures import group_rows
from training.benchmark.output import Report, as_json, markdown, table
from training.benchmark.report import page as benchmark_page
from training.figures.page import html_page, security_policy
from training.studies.reliability.files import results
from training.studies.reliability.files.part import FILES
from training.studies.reliability.page import page as reliability_page

ROOT = Path(training.__file__).parent
ODD = "\"'`<script>alert(1)</script><!--|\n\x1b[31m\u202egnp" + "x" * 250


def odd_report() -> Report:
    """Return a benchmark of two agents with odd names, at a place with one."""
    plan, _ = results._plan()
    pairs = [
        ((suite, f"{ODD}.png", job.seed, agent, job.slam), results.row_of(job))
        for suite in ("rooms", "floor-plans") for agent in (ODD, "random") for job in plan.jobs
    ]  # fmt: skip
    config = {
        "agents": [ODD], "backends": ["odometry"], "baseline": "random",
        "seeds": {"rooms": [0], "floor-plans": [0]},
    }  # fmt: skip
    return Report.of(group_rows(pairs), baseline="random", config=config)


def test_pages_are_made_in_two_places_alone() -> None:
    made = {
        str(path.relative_to(ROOT))
        for path in ROOT.rglob("*")
        if path.suffix in (".py", ".html", ".js") and re.search("<!doctype|<html", path.read_text("utf-8"), re.I)
    }
    assert made == {"figures/page.py", "views/assets/page.html"}
    head = (ROOT / "views/assets/page.html").read_text("utf-8").partition("<title>")[0]
    assert head.endswith('<meta charset="utf-8">\n{{HEAD}}')


def test_the_policy_allows_what_stands_there_and_nothing_else() -> None:
    meta = security_policy(styles=["a { b: c }"], scripts=["let a = 1;"])
    assert f"script-src {hashed('let a = 1;')};" in meta and f"style-src {hashed('a { b: c }')};" in meta
    assert "unsafe" not in meta and "script-src" not in security_policy(styles=["x"])
    assert_strict(html_page("<script>", "<p>&lt;</p>"))


def test_a_benchmarks_page_and_tables_show_odd_names_as_data() -> None:
    report = odd_report()
    html = benchmark_page(report, config_text=ODD)
    page = assert_strict(html)
    assert "script" not in page.tags and "\\u202egnp" in page.text
    for text in (table(report), markdown(report), leaderboard.tables(as_json(report))):
        assert "\x1b" not in text and "\u202e" not in text
    for text in (markdown(report), leaderboard.tables(as_json(report))):
        rows = [line for line in text.splitlines() if "alert(1)" in line and line.startswith("|")]
        assert rows and all(re.search(r"\| `` .*<script>.* `` \|", row) for row in rows), (
            "code, in which nothing acts"
        )
        widths = {len(re.findall(r"(?<!\\)\|", row)) for row in text.splitlines() if row.startswith("| ")}
        assert max(widths) > 3


def test_the_campaigns_page_is_strict() -> None:
    found = {
        "tried": 1, "failures": [ODD], "seed": 0, "size": 1,
        "readers": {ODD: {"files": 1, "hostile": 1, "ends": {"read": 1}, "by_command": 0, "seconds_max": 0.0,
                          "mb_max": 0.0}},
    }  # fmt: skip
    assert_strict(reliability_page({"files": (FILES, found)}))


@pytest.mark.parametrize("width", [390, 1280])
def test_a_benchmarks_page_is_shown_by_a_browser(browser: object, width: int, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(benchmark_page(odd_report(), config_text=""), "utf-8")
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)  # type: ignore[attr-defined]
    browser.get((tmp_path / "report.html").as_uri())  # type: ignore[attr-defined]
    run = browser.execute_script  # type: ignore[attr-defined]
    assert run("return document.documentElement.scrollWidth") <= width
    assert run("return getComputedStyle(document.body).fontVariantNumeric") is not None
    assert run("return getComputedStyle(document.querySelector('h1')).fontSize") == "27.2px", "its style is taken"
    log = browser.get_log("browser")  # type: ignore[attr-defined]
    assert not [entry for entry in log if entry["level"] == "SEVERE"]
