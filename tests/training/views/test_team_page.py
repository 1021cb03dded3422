"""The page of a team: every robot's recording is in it, and a browser replays them all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mecanum_env.team.picture import COLOURS, draw_maps
from slam.grids.occupancy import FREE
from tests.training.pages import assert_strict
from tests.training.team_episode import STEPS, Explored, explore_together
from tests.training.views.test_report_page import opened, page_data, settled
from training.episodes.recording import TeamRecorder
from training.episodes.team import prepare, read_team, run
from training.views.film import filmed
from training.views.team_files import write_team_episode
from training.views.team_page import colour


@dataclass(frozen=True)
class Written:
    explored: Explored
    out: Path


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    out = tmp_path_factory.mktemp("page")
    explored = explore_together(out, communication="line-of-sight", unknown_starts=True)
    write_team_episode(explored.episode, explored.recordings)
    return Written(explored, out)


def test_the_page_holds_every_robots_steps(written: Written) -> None:
    page = (written.out / "report.html").read_text("utf-8")
    assert "https://" not in page.replace("http://www.w3.org", "") and "{{" not in page
    assert_strict(page)
    header, arrays = page_data(page)
    team, log = written.explored.episode.team, written.explored.episode.log
    assert header["rows"] == STEPS + 1 and len(header["robots"]) == 3
    assert np.allclose(arrays["coverage"], log.coverage)
    assert np.array_equal(arrays["group"].reshape(-1, 3), log.groups)
    for member, robot, frame in zip(team.members, header["robots"], team.frames, strict=True):
        true = arrays[f"{member.number}.true"].reshape(-1, 3)
        assert np.allclose(true, member.truth.record.true_poses, atol=1e-5)
        assert np.allclose(robot["frame"], frame)
        assert robot["colour"] == colour(member.number)
    assert len({colour(k) for k in range(24)}) == 24, "told apart in teams of more than eight, too"
    assert colour(0) == "#" + "".join(f"{channel:02x}" for channel in reversed(COLOURS[0]))


def test_a_browser_replays_all_robots(browser: Any, written: Written) -> None:
    opened(browser, written, at="#t=2")  # type: ignore[arg-type]
    assert browser.execute_script("return replay.k") == 20
    outputs = [e.text for e in browser.find_elements("css selector", "#curves output")]
    assert outputs[0] == f"{100 * written.explored.episode.log.coverage[20]:.1f}" and len(outputs) == 4
    apart = [r.true_poses[20, :2] - r.estimates[20, :2] for r in written.explored.recordings]
    errors = [f"{error:.1f}" for error in sorted(100 * np.hypot(*np.transpose(apart)))]
    assert outputs[1] == " – ".join(dict.fromkeys([errors[0], errors[-1]])), "of all robots, not of the last"
    nees = sorted(r.nees[20] / 3 for r in written.explored.recordings)
    assert outputs[2] == f"{nees[0]:.2f} – {nees[-1]:.2f}"
    picture = "return document.getElementById('{}').toDataURL()"
    for layer, canvas in (("scan", "world"), ("links", "world"), ("paths", "belief"), ("landmarks", "belief")):
        before = browser.execute_script(picture.format(canvas))
        browser.find_element("css selector", f"[data-layer={layer}]").click()
        settled(browser)
        changed = browser.execute_script(picture.format(canvas)) != before
        heard = len(set(written.explored.episode.log.groups[20].tolist())) < 3
        assert changed == (heard or layer != "links"), layer
    before = browser.execute_script(picture.format("belief"))
    browser.execute_script(
        "const s = document.getElementById('map-of'); s.value = '1'; s.dispatchEvent(new Event('change'))"
    )
    settled(browser)
    assert browser.execute_script(picture.format("belief")) != before
    browser.find_element("css selector", "[data-layer=follow]").click()
    settled(browser)
    assert not [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def test_who_has_ended_goes_nowhere_any_more(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("terminate_on_collision = true\n")
    episode = prepare(
        read_team(robots=4), out=tmp_path / "out", agent="random", rooms="rectangular", seed=2, max_steps=60,
        config=tmp_path / "config.toml",
    )  # fmt: skip
    recorder = TeamRecorder()
    run(episode, lambda **_: None, [recorder])
    recordings = recorder.recording()
    write_team_episode(episode, recordings)
    rows = [len(recording.times) for recording in recordings]
    first, ended = int(np.argmin(rows)), min(rows)
    assert ended < max(rows) and len(recordings[first].goals.values[-1])
    opened(browser, Written(Explored(episode, recordings), tmp_path / "out"))  # type: ignore[arg-type]
    choose = "const s = document.getElementById('map-of'); s.value = {}; s.dispatchEvent(new Event('change'))"
    browser.execute_script(choose.format(first))
    picture = "return document.getElementById('belief').toDataURL()"
    for row, goes in ((ended - 1, True), (ended, False)):
        browser.execute_script("replay.seek(arguments[0])", row)
        settled(browser)
        before = browser.execute_script(picture)
        browser.find_element("css selector", "[data-layer=goal]").click()
        settled(browser)
        assert (browser.execute_script(picture) != before) == goes


def test_maps_are_drawn_in_the_mean_of_their_robots_colours(browser: Any, written: Written) -> None:
    opened(browser, written)  # type: ignore[arg-type]
    for layer in ("goal", "paths"):
        browser.find_element("css selector", f"[data-layer={layer}]").click()
    settled(browser)
    team = written.explored.episode.team
    script = """
      const [x, y] = arguments, canvas = document.getElementById("belief"), c = canvas.getContext("2d");
      const p = c.getTransform().transformPoint(new DOMPoint(x, y));
      return [...c.getImageData(Math.floor(p.x), Math.floor(p.y), 1, 1).data]"""
    rng = np.random.default_rng(0)
    seen: set[int] = set()
    for x, y in rng.uniform((-4, -4), (8, 8), (400, 2)):
        who, near = [], False
        for member, (fx, fy, ft) in zip(team.members, team.frames, strict=True):
            c, s = np.cos(ft), np.sin(ft)
            own = np.array([c * (x - fx) + s * (y - fy), c * (y - fy) - s * (x - fx)])
            grid = member.backend.grid
            col, row = np.floor((own - grid.origin) / grid.resolution).astype(int)
            around = grid.classes()[max(row - 2, 0) : row + 3, max(col - 2, 0) : col + 3]
            near |= np.hypot(*(own - member.backend.pose[:2])) < 0.8
            if around.shape != (5, 5):
                near |= around.size > 0
                continue
            near |= len(np.unique(around)) > 1
            who += [member.number] if around[2, 2] == FREE else []
        if near or not who:
            continue
        tint = 0.45 * np.mean([COLOURS[k][::-1] for k in who], axis=0) + 0.55 * 255
        red, green, blue, alpha = browser.execute_script(script, x, y)
        assert alpha > 235 and np.abs(np.array([red, green, blue]) - tint).max() < 8, (x, y, who)
        seen.add(len(who))
    assert len(seen) > 1, "places of one robot, and of several"


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits_a_phone(browser: Any, written: Written, width: int) -> None:
    opened(browser, written, width=width, height=844)  # type: ignore[arg-type]
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width


def test_a_team_is_filmed(tmp_path: Path, written: Written) -> None:
    pytest.importorskip("imageio_ffmpeg")
    team = written.explored.episode.team
    with filmed(tmp_path, team.config, team=True) as film:
        for _ in range(3):
            film.take(team, [None] * 3)
        path = film.finish()
        assert path is not None and path.stat().st_size > 1000


def test_a_picture_of_the_maps_alone(written: Written) -> None:
    picture = draw_maps(written.explored.episode.team, longest_px=300)
    assert picture.dtype == np.uint8 and max(picture.shape) == 300 and len(np.unique(picture)) > 10
