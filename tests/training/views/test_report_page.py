"""An episode's recording and its report: what the page replays is what happened, seen in a real browser."""

from __future__ import annotations

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mecanum_env.env import ExploreEnv
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.training.pages import assert_strict
from training.episodes import explore
from training.episodes.recording import Recorded as Recording_
from training.episodes.recording import Recorder, Recording, _MapFollower
from training.views.episode_files import write_episode
from training.views.report_page import LOST, NO_RETURN, _thinned, pack

STEPS = 120


class Recorded(NamedTuple):
    env: ExploreEnv
    recording: Recording
    out: Path


def explored(out: Path, **options: Any) -> Recorded:
    episode, recorder = explore.prepare(out=out, max_steps=STEPS, **options), Recorder()
    explore.run(episode, lambda **_: None, [recorder])
    recording = recorder.recording()
    write_episode(episode, recording)
    return Recorded(episode.env, recording, out)


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return explored(tmp_path_factory.mktemp("episode"), agent="brisk-tour", seed=3)


def page_data(page: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the header of a page and its arrays, read as its script reads them."""
    texts = re.findall(r'<script type="[a-z/]+" id="(?:header|data)">(.*?)</script>', page, re.DOTALL)
    header = json.loads(texts[0])
    return header, unpack(header, texts[1])


def unpack(header: dict[str, Any], data: str) -> dict[str, Any]:
    """Return the arrays, flat, from the base64 text that the page holds: what its script does."""
    raw, at, arrays = zlib.decompress(base64.b64decode(data)), 0, {}
    for name, kind, size in header["arrays"]:
        arrays[name] = np.frombuffer(raw, np.dtype(kind).newbyteorder("<"), size, at)
        at += -(-arrays[name].nbytes // 4) * 4
    return arrays


def rebuilt(recording: Recording) -> tuple[np.ndarray, tuple[int, int]]:
    row0, col0, row1, col1 = recording.bounds()
    classes = np.full((row1 - row0, col1 - col0), UNKNOWN, np.int64)
    for change in recording.map_changes.values:
        row, col, now = np.asarray(change, np.int64).T
        classes[row - row0, col - col0] = now
    return classes, (row0, col0)


# ---- the recording ---------------------------------------------------------------------------------------------


def test_a_recording_holds_every_row_of_the_episode(episode: Recorded) -> None:
    recording, record = episode.recording, episode.env.truth.record
    assert len(recording.times) == len(recording.pose_covs) == len(recording.twists) == STEPS + 1
    np.testing.assert_array_equal(recording.true_poses, record.true_poses)
    np.testing.assert_array_equal(recording.pose_covs[-1], episode.env.backend.pose_cov)
    np.testing.assert_array_equal(recording.scans.values[-1], episode.env.truth.scan.ranges.astype(np.float32))
    assert recording.scans.steps[-1] == STEPS
    np.testing.assert_allclose(recording.landmarks.values[-1][:, :2], episode.env.belief.landmarks, atol=1e-5)
    assert len(recording.goals.values[0]) == 0 and len(recording.goals.values[-1]) > 0


@pytest.mark.parametrize("slam", ["ekf", "dp-slam"])
def test_the_map_that_the_changes_make_is_the_beliefs(slam: str, tmp_path: Path) -> None:
    # DP-SLAM redraws the whole map whenever another particle is the likeliest.
    episode = explored(tmp_path, slam=slam, seed=5, rooms="rectangular")
    classes, (row0, col0) = rebuilt(episode.recording)
    grid = episode.env.backend.grid
    known = np.argwhere(grid.classes() != UNKNOWN)
    assert len(known) == np.count_nonzero(classes != UNKNOWN) > 1000
    at = known + np.array(grid.lattice_origin) - (row0, col0)
    np.testing.assert_array_equal(classes[at[:, 0], at[:, 1]], grid.classes()[known[:, 0], known[:, 1]])


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_whatever_happens_to_a_map_is_told(data: st.DataObject) -> None:
    """Cells that change to and fro, whole redraws, grids that grow and move: what was told is what is there."""
    follower, told = _MapFollower(), {}
    shown: dict[tuple[int, int], int] = {}
    cell = st.tuples(st.integers(-70, 90), st.integers(-40, 40))
    for _ in range(data.draw(st.integers(1, 6))):
        if data.draw(st.booleans()):
            shown = data.draw(st.dictionaries(cell, st.sampled_from([FREE, OCCUPIED]), max_size=8))
            follower.follow(None)
        for _ in range(data.draw(st.integers(0, 3))):
            now = data.draw(st.dictionaries(cell, st.sampled_from([FREE, OCCUPIED, UNKNOWN]), max_size=8))
            rows = [(r, c, shown.get((r, c), UNKNOWN), value) for (r, c), value in now.items()]
            follower.follow(np.array(rows, np.int32).reshape(-1, 4))
            shown |= now
        for row, col, value in follower.take(grid_of(shown)).tolist():
            assert told.get((row, col), UNKNOWN) != value, "told again"
            told[row, col] = value
        assert {k: v for k, v in told.items() if v != UNKNOWN} == {k: v for k, v in shown.items() if v != UNKNOWN}


def grid_of(shown: dict[tuple[int, int], int]) -> OccupancyGrid:
    """Return a grid that covers the cells and holds their classes."""
    rows, cols = zip(*shown, strict=True) if shown else ((0,), (0,))
    classes = np.full((max(rows) - min(rows) + 1, max(cols) - min(cols) + 1), UNKNOWN, np.int8)
    for (row, col), value in shown.items():
        classes[row - min(rows), col - min(cols)] = value
    return OccupancyGrid.from_classes(classes, 0.05, (min(cols) * 0.05, min(rows) * 0.05))


# ---- what the page holds ---------------------------------------------------------------------------------------


def test_the_page_holds_what_was_recorded(episode: Recorded) -> None:
    page = (episode.out / "report.html").read_text("utf-8")
    header, arrays = page_data(page)
    recording = episode.recording
    np.testing.assert_allclose(arrays["true"].reshape(-1, 3), recording.true_poses, atol=1e-5)
    np.testing.assert_allclose(arrays["cov"].reshape(-1, 4)[:, 3], recording.pose_covs[:, 2, 2], rtol=1e-6)
    np.testing.assert_allclose(arrays["coverage"], recording.coverage, atol=1e-6)
    # Ranges to a 252nd of the reach.
    codes = np.cumsum(arrays["scan"].reshape(-1, header["beams"]), axis=1, dtype=np.uint8)
    ranges = np.array(recording.scans.values)
    known = np.isfinite(ranges)
    assert np.abs(codes[known] / 252 * header["range_max"] - ranges[known]).max() <= header["range_max"] / 504
    assert (codes[np.isinf(ranges)] == NO_RETURN).all() and (codes[np.isnan(ranges)] == LOST).all()
    np.testing.assert_array_equal(decoded_map(header, arrays), rebuilt(recording)[0])
    # Ellipses: the covariance from axes and direction.
    last = recording.landmarks.values[-1]
    x, y, a, b, angle = arrays["landmark"].reshape(5, -1)[:, -len(last) :].astype(float)
    np.testing.assert_allclose(np.column_stack([x, y]) / 1e3, last[:, :2], atol=6e-4)
    turn = np.radians(angle)
    xx = (a * np.cos(turn)) ** 2 + (b * np.sin(turn)) ** 2
    xy = (a**2 - b**2) * np.sin(turn) * np.cos(turn)
    size = np.abs(last[:, 2:]).max()
    np.testing.assert_allclose(np.column_stack([xx, xy]) / 1e8, last[:, 2:4], atol=0.05 * size)


def decoded_map(header: dict[str, Any], arrays: dict[str, Any]) -> np.ndarray:
    rows, cols = header["map"]["rows"], header["map"]["cols"]
    classes = np.zeros(rows * cols, np.int64)
    gaps, cells = iter(arrays["map_gap"].tolist()), iter(arrays["map_class"].tolist())
    for count in arrays["map_count"].tolist():
        index = 0
        for _ in range(count):
            index += next(gaps)
            classes[index] = next(cells)
    return classes.reshape(rows, cols) - 1


def test_cells_far_apart_are_told_rightly(episode: Recorded) -> None:
    recording = episode.recording
    change = np.array([(0, 0, FREE), (0, 1, FREE), (400, 399, OCCUPIED), (799, 0, FREE)], np.int32)
    far = type(recording.map_changes)(np.array([0], np.int32), (change,))
    header, arrays = pack(Recording(**(recording.__dict__ | {"map_changes": far})))
    classes = decoded_map(header, {k: np.ravel(v) for k, v in arrays.items()})
    assert classes.shape == (800, 400) and np.count_nonzero(classes != UNKNOWN) == 4
    assert classes[400, 399] == OCCUPIED and classes[799, 0] == FREE


def test_the_page_needs_nothing_else_and_says_what_it_shows(episode: Recorded) -> None:
    page = (episode.out / "report.html").read_text("utf-8")
    assert not re.search(r'(src|href)="(?!#|data:)', page) and "http" not in page.replace("http-equiv", "")
    assert "{{" not in page
    assert_strict(page)
    assert "apartment, seed 3: brisk-tour on invariant-ekf" in page and "time: the step limit" in page
    assert len(page) < 400_000
    read_out = re.findall(r"<output[^>]*>", page)
    assert len(read_out) >= 2 and all('aria-live="off"' in tag for tag in read_out), "they change at every frame"


def test_names_from_outside_cannot_leave_their_place(tmp_path: Path) -> None:
    from tests.training.plans import write_room

    odd = write_room(tmp_path / "<script>alert(1)<&{{DATA}}.png")
    episode = explored(tmp_path / "out", floor_plan=odd)
    page = (episode.out / "report.html").read_text("utf-8")
    assert "<script>alert" not in page and page.count('id="data"') == 1
    assert page_data(page)[0]["rows"] == episode.env.truth.record.times.size


def test_of_many_notes_the_first_and_the_last_stay() -> None:
    many = Recording_(np.arange(0, 3000, 10, dtype=np.int32), tuple(np.zeros((k, 5)) for k in range(300)))
    kept = _thinned(many, 240)
    assert kept.steps[0] == 0 and kept.steps[-1] == 2990 and len(kept.steps) <= 240


def test_a_recorder_is_ready_for_an_episode_of_no_step(tmp_path: Path) -> None:
    episode = explore.prepare(out=tmp_path, rooms="rectangular")
    recorder = Recorder()
    recorder.take(episode.env, None)
    header, arrays = pack(recorder.recording())
    assert header["rows"] == 1 and arrays["map_count"].sum() > 0


# ---- in a browser ----------------------------------------------------------------------------------------------


def opened(browser: Any, episode: Recorded, *, at: str = "", width: int = 1280, height: int = 900) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    browser.get("about:blank")
    browser.get((episode.out / "report.html").resolve().as_uri() + at)
    WebDriverWait(browser, 20).until(lambda b: b.execute_script("return Boolean(window.replay)"))
    settled(browser)


def settled(browser: Any) -> None:
    browser.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")


def test_the_page_replays_the_episode_in_a_browser(browser: Any, episode: Recorded) -> None:
    opened(browser, episode, at="#t=5")
    assert browser.execute_script("return replay.k") == 50
    assert browser.find_element("id", "clock").text == "5.0 s"
    # Forth and back in time the map is what it was then.
    recording = episode.recording
    move = "const t = document.getElementById('time'); t.value = arguments[0]; t.dispatchEvent(new Event('input'))"
    for row in (50, 120, 20, 0):
        browser.execute_script(move, row)
        settled(browser)
        expected: dict[tuple[int, int], int] = {}
        for step, change in zip(recording.map_changes.steps, recording.map_changes.values, strict=True):
            if step <= row:
                expected |= {(r, c): now for r, c, now in change.tolist()}
        free = sum(now == FREE for now in expected.values())
        assert browser.execute_script("return replay.map.classes.filter((c) => c === 1).length") == free
        walls = browser.execute_script("return replay.map.classes.filter((c) => c === 101).length")
        assert walls == sum(now == OCCUPIED for now in expected.values())
    outputs = [e.text for e in browser.find_elements("css selector", "#curves output")]
    assert outputs[0] == f"{100 * recording.coverage[0]:.1f}" and len(outputs) == 5
    assert not [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def test_keys_and_buttons_drive_the_replay(browser: Any, episode: Recorded) -> None:
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import WebDriverWait

    opened(browser, episode)
    row = "return replay.k"
    assert browser.execute_script(row) == STEPS, "the whole path is shown first"
    body = browser.find_element("tag name", "body")
    for key, expected in ((Keys.HOME, 0), (Keys.ARROW_RIGHT, 10), (Keys.ARROW_RIGHT, 20), (Keys.ARROW_LEFT, 10)):
        body.send_keys(key)
        assert browser.execute_script(row) == expected
    browser.execute_script("document.getElementById('speed').value = 1")
    browser.find_element("id", "play").click()
    assert browser.execute_script("return replay.playing")
    WebDriverWait(browser, 10).until(lambda b: b.execute_script(row) > 15)
    body.send_keys(Keys.SPACE)
    assert not browser.execute_script("return replay.playing")
    # What scrolls takes the keys for itself.
    browser.execute_script("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    at, config = browser.execute_script(row), browser.find_elements("tag name", "pre")[1]
    browser.execute_script("arguments[0].tabIndex = 0; arguments[0].focus()", config)
    config.send_keys(Keys.ARROW_RIGHT)
    assert browser.execute_script(row) == at
    # A layer taken away changes the picture.
    picture = "return document.getElementById('belief').toDataURL()"
    before = browser.execute_script(picture)
    browser.find_element("css selector", "[data-layer=landmarks]").click()
    settled(browser)
    assert browser.execute_script(picture) != before


def test_it_plays_from_the_end_whenever_it_is_pressed(browser: Any, episode: Recorded) -> None:
    opened(browser, episode)
    for _ in range(12):
        browser.execute_script("replay.seek(replay.header.rows - 1)")
        settled(browser)
        browser.find_element("id", "play").click()
        settled(browser)
        assert browser.execute_script("return replay.playing && replay.k >= 0")
        browser.execute_script("replay.pause()")
    assert not [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def test_a_layer_is_switched_by_keys_too(browser: Any, episode: Recorded) -> None:
    from selenium.webdriver.common.keys import Keys

    opened(browser, episode)
    browser.find_element("id", "speed").send_keys(Keys.TAB + Keys.SPACE)
    assert not browser.find_element("css selector", "[data-layer=scan]").is_selected()
    assert not browser.execute_script("return replay.playing")


def test_a_goal_lies_within_its_curve(browser: Any, tmp_path: Path) -> None:
    episode, recorder = explore.prepare(out=tmp_path, rooms="rectangular", max_steps=2), Recorder()
    explore.run(episode, lambda **_: None, [recorder])
    recording = recorder.recording()
    write_episode(episode, replace(recording, nees=np.full_like(recording.nees, 0.3)))
    opened(browser, Recorded(episode.env, recording, tmp_path))
    curves = browser.execute_script("return replay.curves.map(({ goal, top }) => [goal ?? 0, top])")
    assert len(curves) == 5 and all(goal <= top for goal, top in curves), "or it is drawn where another value is"


def test_the_belief_is_drawn_where_it_is(browser: Any, episode: Recorded) -> None:
    """Colours of the canvas at cells known to be a wall, free and unknown, away from the robot."""
    opened(browser, episode)
    for layer in ("scan", "landmarks", "frontiers", "goal", "paths"):
        browser.find_element("css selector", f"[data-layer={layer}]").click()
    settled(browser)
    recording = episode.recording
    classes, (row0, col0) = rebuilt(recording)
    colours = {FREE: [255, 255, 255], OCCUPIED: [54, 62, 74], UNKNOWN: [222, 225, 228]}
    script = """
      const [x, y] = arguments, canvas = document.getElementById("belief"), c = canvas.getContext("2d");
      const p = c.getTransform().transformPoint(new DOMPoint(x, y));
      return [...c.getImageData(Math.floor(p.x), Math.floor(p.y), 1, 1).data].slice(0, 3)"""
    for value, colour in colours.items():
        padded = np.pad(classes, 1, constant_values=UNKNOWN)
        alike = np.ones(classes.shape, bool)  # with its eight neighbours, but for walls, which are thin
        around = [(dr, dc) for dr in (0, 1, 2) for dc in (0, 1, 2)] if value != OCCUPIED else [(1, 1)]
        for dr, dc in around:
            alike &= padded[dr : dr + classes.shape[0], dc : dc + classes.shape[1]] == value
        cells = np.argwhere(alike)
        points = (cells[:, ::-1] + (col0, row0) + 0.5) * recording.resolution
        far = np.hypot(*(points - recording.estimates[-1, :2]).T) > 0.6
        for x, y in points[far][:: max(far.sum() // 8, 1)].tolist():
            assert browser.execute_script(script, x, y) == colour, (value, x, y)


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_fits_a_phone(browser: Any, episode: Recorded, width: int) -> None:
    opened(browser, episode, width=width, height=844)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    bottom = browser.execute_script("return document.querySelector('.bar').getBoundingClientRect().bottom")
    assert bottom <= 844 or width > 600, "the slider is at hand"
