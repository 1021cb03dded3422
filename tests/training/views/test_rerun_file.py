"""The Rerun export, read back with Rerun's own reader and compared with what was recorded."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mecanum_env.config import LidarConfig, RobotConfig
from slam.geometry import wrap
from slam.grids.occupancy import UNKNOWN
from tests.training.recorded_episode import STEPS, Recorded, explore
from training.episodes.playback import map_origin, maps
from training.runs.errors import BadInput
from training.views.rerun_file import APPLICATION, TIMELINE, write_rerun

pytest.importorskip("rerun")
from rerun.chunk import RrdReader

Columns = dict[str, dict[str, list[Any]]]


@pytest.fixture(scope="module")
def episode() -> Recorded:
    return explore()


@pytest.fixture(scope="module")
def path(episode: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("rerun") / "episode.rrd"
    write_rerun(episode.recording, path, robot=RobotConfig(), lidar=LidarConfig(), name="rectangular 3")
    return path


@pytest.fixture(scope="module")
def columns(path: Path) -> Columns:
    """Return what is logged over time: entity → column → a value a row, in order of time."""
    found: Columns = {}
    for chunk in RrdReader(path).stream().to_chunks():
        if not chunk.is_static:
            table = chunk.to_record_batch().to_pydict()
            entity = found.setdefault(chunk.entity_path, {})
            for name, values in table.items():
                entity.setdefault(name, []).extend(values)
    for entity in found.values():
        order = np.argsort(entity[TIMELINE], kind="stable")
        for name, values in entity.items():
            entity[name] = [values[k] for k in order]
    return found


def times_of(columns: Columns, entity: str) -> NDArray[np.float64]:
    return np.array([t.total_seconds() for t in columns[entity][TIMELINE]])


def test_one_recording_with_its_blueprint(path: Path) -> None:
    reader = RrdReader(path)
    (store,) = reader.recordings()
    assert store.application_id == APPLICATION and len(reader.blueprints()) == 1
    assert [p.name for p in path.parent.iterdir()] == ["episode.rrd"]


def test_entities_and_their_rows(path: Path, columns: Columns, episode: Recorded) -> None:
    recording = episode.recording
    rows = {entity: len(values[TIMELINE]) for entity, values in columns.items()}
    n = STEPS + 1
    landmark_notes = len(set(recording.landmarks.steps.tolist()))
    assert rows == {
        "/world/map": len(list(maps(recording))),
        "/world/true": n, "/world/true_path": n - 1, "/world/believed": n, "/world/believed_path": n - 1,
        "/world/believed/lidar/scan": len(recording.scans.steps), "/world/plan": len(recording.goals.steps),
        "/world/landmarks": landmark_notes, "/world/landmarks/ellipses": landmark_notes,
        "/coverage": n, "/error/position_m": n, "/error/heading_rad": n, "/nees": n, "/health": n,
        "/collisions": n,
    }  # fmt: skip
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "exports.md").read_text("utf-8")
    named = {entity for entity in rows if f"`{entity[1:]}`" in page}
    assert set(rows) - named == {"/world/landmarks/ellipses"}, "the page has it as …/ellipses"
    static = Counter(c.entity_path for c in RrdReader(path).stream().to_chunks() if c.is_static)
    assert {"/world", "/world/true/body", "/world/believed/body", "/world/believed/lidar"} <= set(static)
    timelines = {name for c in RrdReader(path).stream().to_chunks() for name in c.timeline_names}
    assert timelines == {TIMELINE}


def test_poses_are_those_recorded(columns: Columns, episode: Recorded) -> None:
    recording = episode.recording
    for entity, poses in (("/world/true", recording.true_poses), ("/world/believed", recording.estimates)):
        np.testing.assert_allclose(times_of(columns, entity), recording.times, atol=1e-9)
        places = np.array(columns[entity]["Transform3D:translation"])[:, 0]
        np.testing.assert_allclose(places[:, :2], poses[:, :2], atol=1e-6)
        turns = np.array(columns[entity]["Transform3D:quaternion"])[:, 0]
        np.testing.assert_array_equal(turns[:, :2], 0.0)
        headings = 2.0 * np.arctan2(turns[:, 2], turns[:, 3])
        np.testing.assert_allclose(wrap(headings - poses[:, 2]), 0.0, atol=1e-6)


def test_maps_are_images_with_the_highest_row_first(columns: Columns, episode: Recorded) -> None:
    recording = episode.recording
    logged = columns["/world/map"]
    for k, (step, classes) in enumerate(maps(recording)):
        assert times_of(columns, "/world/map")[k] == pytest.approx(recording.times[step])
        (image,) = logged["GridMap:format"][k]
        assert (image["height"], image["width"]) == classes.shape
        (data,) = logged["GridMap:data"][k]
        np.testing.assert_array_equal(np.array(data, np.uint8).view(np.int8).reshape(classes.shape), classes[::-1])
        assert logged["GridMap:cell_size"][k] == [pytest.approx(recording.resolution)]
        np.testing.assert_allclose(logged["GridMap:translation"][k][0], [*map_origin(recording), 0.0], atol=1e-6)
    grid = episode.env.belief.grid
    assert np.count_nonzero(classes != UNKNOWN) == np.count_nonzero(grid.classes() != UNKNOWN)


def test_scans_hold_what_returned(columns: Columns, episode: Recorded) -> None:
    scans = episode.recording.scans
    for points, ranges in zip(
        columns["/world/believed/lidar/scan"]["Points3D:positions"], scans.values, strict=True
    ):
        returned = ranges[np.isfinite(ranges)]
        np.testing.assert_allclose(np.linalg.norm(np.array(points), axis=1), returned, rtol=1e-5)


def test_plans_and_landmarks_are_those_recorded(columns: Columns, episode: Recorded) -> None:
    goals, belief = episode.recording.goals, episode.env.belief
    for strips, way in zip(columns["/world/plan"]["LineStrips3D:strips"], goals.values, strict=True):
        assert len(strips) == int(len(way) > 0)
        for strip in strips:
            np.testing.assert_allclose(np.array(strip)[:, :2], way, atol=1e-6)
    places = np.array(columns["/world/landmarks"]["Points3D:positions"][-1])
    np.testing.assert_allclose(places[:, :2], belief.landmarks, atol=1e-5)
    axes = np.array(columns["/world/landmarks/ellipses"]["Ellipsoids3D:half_sizes"][-1])[:, :2]
    areas = np.sqrt(np.linalg.det(belief.landmark_cov)) * 9.0
    np.testing.assert_allclose(axes.prod(axis=1), areas, rtol=1e-3)


def test_curves_are_those_recorded(columns: Columns, episode: Recorded) -> None:
    recording = episode.recording
    off = recording.true_poses - recording.estimates
    for entity, values in (
        ("/coverage", recording.coverage),
        ("/nees", recording.nees),
        ("/health", recording.health),
        ("/collisions", recording.collisions),
        ("/error/position_m", np.hypot(off[:, 0], off[:, 1])),
        ("/error/heading_rad", np.abs(wrap(off[:, 2]))),
    ):
        np.testing.assert_array_equal(np.array(columns[entity]["Scalars:scalars"])[:, 0], values)


def test_without_the_library_the_remedy_is_named(
    episode: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(BadInput, match=r"pip install 'mecanum-slam\[rerun\]'"):
        write_rerun(episode.recording, tmp_path / "e.rrd", robot=RobotConfig(), lidar=LidarConfig())
    assert list(tmp_path.iterdir()) == []
