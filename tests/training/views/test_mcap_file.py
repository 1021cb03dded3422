"""The MCAP export, read back with the format's own reader and compared with what was recorded."""

from __future__ import annotations

import math
import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from mecanum_env.config import LidarConfig, RobotConfig
from slam.geometry import compose, inverse, transform_points
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN
from tests.training.recorded_episode import STEPS, Recorded, explore
from training.episodes.playback import dead_reckoned, ellipses
from training.runs.errors import BadInput
from training.views.mcap_file import TOPICS, write_mcap

pytest.importorskip("mcap_ros2")
pytest.importorskip("rosbags")
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

Array = NDArray[np.float64]
LIDAR = LidarConfig()


@pytest.fixture(scope="module")
def episode() -> Recorded:
    return explore()


@pytest.fixture(scope="module")
def path(episode: Recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mcap") / "episode.mcap"
    write_mcap(episode.recording, path, robot=RobotConfig(), lidar=LIDAR, about={"agent": "nearest-frontier"})
    return path


@pytest.fixture(scope="module")
def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return each topic's messages with their log times [ns], decoded by mcap-ros2-support."""
    found = defaultdict(list)
    with path.open("rb") as file:
        for _, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found[channel.topic].append((message.log_time, decoded))
    return found


def planar(position: Any, orientation: Any) -> Array:
    assert (position.z, orientation.x, orientation.y) == (0.0, 0.0, 0.0)
    assert math.hypot(orientation.z, orientation.w) == pytest.approx(1.0)
    return np.array([position.x, position.y, 2.0 * math.atan2(orientation.z, orientation.w)])


def frames_at(messages: dict[str, list[tuple[int, Any]]], step: int) -> dict[tuple[str, str], Array]:
    """Return the transforms of a step by parent and child."""
    transforms = messages["/tf_static"][0][1].transforms + messages["/tf"][step][1].transforms
    return {
        (t.header.frame_id, t.child_frame_id): planar(t.transform.translation, t.transform.rotation)
        for t in transforms
    }


def test_every_topic_is_there_with_its_type_and_a_whole_definition(path: Path) -> None:
    with path.open("rb") as file:
        reader = make_reader(file)
        summary, header = reader.get_summary(), reader.get_header()
    assert summary is not None and header.profile == "ros2"
    assert {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()} == TOPICS
    for schema in summary.schemas.values():
        assert schema.encoding == "ros2msg"
        named = re.findall(r"^MSG: (\S+)$", schema.data.decode(), re.MULTILINE)
        assert len(named) == len(set(named)) == schema.data.decode().count("=" * 80)
    assert all(chunk.compression == "zstd" for chunk in summary.chunk_indexes)
    assert summary.statistics is not None
    assert summary.statistics.message_start_time == 0
    assert summary.statistics.message_end_time == round(STEPS * 1e8)


def test_latched_topics_are_offered_so(path: Path) -> None:
    # Else RViz hears no static transforms from `ros2 bag play`, and no map that came before it was opened.
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert summary is not None
    durability = {}
    for channel in summary.channels.values():
        (qos,) = yaml.safe_load(channel.metadata["offered_qos_profiles"])
        durability[channel.topic] = qos["durability"]
        assert qos["reliability"] == 1 and qos["history"] == 1 and qos["depth"] >= 1
    assert {t for t, d in durability.items() if d == 1} == {"/tf_static", "/robot", "/map", "/plan"}
    assert metadata == {"rosbag2": {"ROS_DISTRO": "humble"}, "mecanum-slam": {"agent": "nearest-frontier"}}


def test_time_goes_forward_from_zero(path: Path, episode: Recorded) -> None:
    with path.open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    assert set(times) == {round(t * 1e9) for t in episode.recording.times}


def test_transforms_compose_to_the_belief_and_to_the_truth(
    messages: dict[str, list[tuple[int, Any]]], episode: Recorded
) -> None:
    recording = episode.recording
    odom = dead_reckoned(recording)
    assert len(messages["/tf"]) == STEPS + 1
    for step in range(STEPS + 1):
        frames = frames_at(messages, step)
        assert set(frames) == {
            ("map", "odom"), ("odom", "base_link"), ("base_link", "laser"), ("map", "base_link_true")
        }  # fmt: skip
        believed = compose(frames["map", "odom"], frames["odom", "base_link"])
        np.testing.assert_allclose(believed, recording.estimates[step], atol=1e-9)
        np.testing.assert_allclose(frames["odom", "base_link"], odom[step], atol=1e-9)
        np.testing.assert_allclose(frames["map", "base_link_true"], recording.true_poses[step], atol=1e-9)
        np.testing.assert_allclose(frames["base_link", "laser"], [LIDAR.offset_m, 0.0, 0.0], atol=1e-12)
    for time, message in messages["/tf"]:
        assert {t.header.stamp.sec * 10**9 + t.header.stamp.nanosec for t in message.transforms} == {time}


def test_dead_reckoning_drifts_from_the_truth_but_not_far(episode: Recorded) -> None:
    recording = episode.recording
    off = np.hypot(*(dead_reckoned(recording) - recording.true_poses)[:, :2].T)
    travelled = np.hypot(*np.diff(recording.true_poses[:, :2], axis=0).T).sum()
    assert 0.0 < off.max() < 0.05 * travelled


def test_poses_and_odometry_are_those_recorded(
    messages: dict[str, list[tuple[int, Any]]], episode: Recorded
) -> None:
    recording = episode.recording
    odom = dead_reckoned(recording)
    for step in range(STEPS + 1):
        pose = messages["/pose"][step][1]
        assert pose.header.frame_id == "map"
        believed = planar(pose.pose.pose.position, pose.pose.pose.orientation)
        np.testing.assert_allclose(believed, recording.estimates[step], atol=1e-9)
        whole = np.array(pose.pose.covariance).reshape(6, 6)
        np.testing.assert_array_equal(whole[np.ix_([0, 1, 5], [0, 1, 5])], recording.pose_covs[step])
        assert np.count_nonzero(whole) == np.count_nonzero(recording.pose_covs[step])
        for topic, frame, child, where in (
            ("/odom", "odom", "base_link", odom),
            ("/ground_truth", "map", "base_link_true", recording.true_poses),
        ):
            message = messages[topic][step][1]
            assert (message.header.frame_id, message.child_frame_id) == (frame, child)
            found = planar(message.pose.pose.position, message.pose.pose.orientation)
            np.testing.assert_allclose(found, where[step], atol=1e-9)
        twist = messages["/odom"][step][1].twist.twist
        np.testing.assert_array_equal([twist.linear.x, twist.linear.y, twist.angular.z], recording.twists[step])
    # The true twist is in the body's own frame: forward where it drives forward.
    twist = messages["/ground_truth"][30][1].twist.twist
    ahead = compose(inverse(recording.true_poses[29]), recording.true_poses[30])
    np.testing.assert_allclose([twist.linear.x, twist.linear.y], ahead[:2] / 0.1, atol=0.02)


def test_maps_are_the_belief_as_it_was(messages: dict[str, list[tuple[int, Any]]], episode: Recorded) -> None:
    times = np.array([time for time, _ in messages["/map"]]) / 1e9
    assert times[0] == 0.0 and np.all(np.diff(times)[:-1] > 0.95)
    known = []
    for _, message in messages["/map"]:
        assert message.header.frame_id == "map"
        data = np.array(message.data, np.int8)
        assert len(data) == message.info.width * message.info.height
        known.append(np.count_nonzero(data != UNKNOWN))
    assert known[0] > 0 and known == sorted(known)
    # The last one is the belief's grid, cell by cell: row-major, x fastest, its origin cell (0, 0).
    message, grid = messages["/map"][-1][1], episode.env.belief.grid
    data = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    assert message.info.resolution == pytest.approx(grid.resolution)
    origin = planar(message.info.origin.position, message.info.origin.orientation)
    row, col = round(origin[1] / grid.resolution), round(origin[0] / grid.resolution)
    assert origin[2] == 0.0
    classes = np.full_like(data, UNKNOWN)
    r, c = grid.lattice_origin[0] - row, grid.lattice_origin[1] - col
    rows, cols = np.nonzero(grid.classes() != UNKNOWN)
    classes[rows + r, cols + c] = grid.classes()[rows, cols]
    np.testing.assert_array_equal(data, classes)
    assert {UNKNOWN, FREE, OCCUPIED} == {-1, 0, 100} == set(np.unique(data).tolist())


def test_scans_are_those_recorded_and_end_on_the_map(
    messages: dict[str, list[tuple[int, Any]]], episode: Recorded
) -> None:
    recording = episode.recording
    assert len(messages["/scan"]) == len(recording.scans.steps)
    grid = episode.env.belief.grid
    walls = np.argwhere(grid.classes() == OCCUPIED)
    for (time, message), step, ranges in zip(
        messages["/scan"], recording.scans.steps.tolist(), recording.scans.values, strict=True
    ):
        assert time == round(recording.times[step] * 1e9) and message.header.frame_id == "laser"
        np.testing.assert_array_equal(np.array(message.ranges, np.float32), ranges)  # nan and inf among them
        assert message.scan_time == pytest.approx(recording.times[recording.scans.steps[1]])
        assert message.intensities == [] and message.range_max == LIDAR.range_max_m
        assert message.angle_increment == pytest.approx(LIDAR.angle_increment)
        assert message.angle_max == pytest.approx(message.angle_min + (LIDAR.beams - 1) * LIDAR.angle_increment)
        frames = frames_at(messages, step)
        sensor = compose(compose(frames["map", "odom"], frames["odom", "base_link"]), frames["base_link", "laser"])
        bearings = message.angle_min + message.angle_increment * np.arange(LIDAR.beams)
        hit = np.isfinite(ranges)
        rays = np.column_stack([np.cos(bearings), np.sin(bearings)])[hit]
        ends = grid.to_cells(transform_points(sensor, rays * ranges[hit, None]))
        apart = np.abs(ends[:, None] - walls[None]).max(axis=2).min(axis=1)
        assert np.mean(apart <= 1) > 0.95  # in a wall or the cell next to it


def test_lost_beams_are_nan_and_free_ones_inf(messages: dict[str, list[tuple[int, Any]]]) -> None:
    ranges = np.concatenate([message.ranges for _, message in messages["/scan"]])
    assert np.isnan(ranges).any() and not np.isneginf(ranges).any()


def test_plans_lead_to_the_goal(messages: dict[str, list[tuple[int, Any]]], episode: Recorded) -> None:
    goals = episode.recording.goals
    assert len(messages["/plan"]) == len(goals.steps) and len(goals.values[0]) == 0
    for (time, message), step, path in zip(messages["/plan"], goals.steps.tolist(), goals.values, strict=True):
        assert time == round(episode.recording.times[step] * 1e9)
        poses = np.array([planar(p.pose.position, p.pose.orientation) for p in message.poses]).reshape(-1, 3)
        np.testing.assert_allclose(poses[:, :2], path)
        along = np.diff(poses[:, :2], axis=0)
        np.testing.assert_allclose(np.cos(poses[:-1, 2] - np.arctan2(along[:, 1], along[:, 0])), 1.0)


def test_landmarks_are_their_three_sigma_ellipses(
    messages: dict[str, list[tuple[int, Any]]], episode: Recorded
) -> None:
    belief = episode.env.belief
    markers = messages["/landmarks"][-1][1].markers
    assert len(markers) == len(belief.landmarks) > 0 and [m.id for m in markers] == list(range(len(markers)))
    for marker, landmark, cov in zip(markers, belief.landmarks, belief.landmark_cov, strict=True):
        place = planar(marker.pose.position, marker.pose.orientation)
        np.testing.assert_allclose(place[:2], landmark, atol=1e-5)
        variances, axes = np.linalg.eigh(cov)
        width = np.maximum(6.0 * np.sqrt(variances[::-1]), 0.02)  # smaller ones are drawn larger, to be seen
        np.testing.assert_allclose([marker.scale.x, marker.scale.y], width, rtol=1e-4)
        if variances[1] > 1.5 * variances[0]:
            along = np.array([math.cos(place[2]), math.sin(place[2])])
            assert abs(along @ axes[:, 1]) == pytest.approx(1.0, abs=1e-4)


def test_ellipses_by_hand() -> None:
    rows = np.array([[0, 0, 0.04, 0, 0.01], [0, 0, 0.05, 0.03, 0.05]], np.float32)
    axes, directions = ellipses(rows, sigmas=1.0)
    np.testing.assert_allclose(axes, [[0.2, 0.1], [math.sqrt(0.08), math.sqrt(0.02)]], rtol=1e-6)
    np.testing.assert_allclose(np.abs(np.sin(directions - np.array([0.0, math.pi / 4]))), 0.0, atol=1e-6)


def test_the_robot_is_shown_where_it_is_believed_and_where_it_is(
    messages: dict[str, list[tuple[int, Any]]],
) -> None:
    ((time, message),) = messages["/robot"]
    robot = RobotConfig()
    assert time == 0 and [m.header.frame_id for m in message.markers] == ["base_link", "base_link_true"]
    for marker in message.markers:
        assert marker.frame_locked
        assert (marker.scale.x, marker.scale.y) == (robot.length_m, robot.width_m)


def test_without_the_library_the_remedy_is_named(
    episode: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for library in ("mcap.writer", "rosbags.typesys"):
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, library, None)
            with pytest.raises(BadInput, match=r"pip install 'mecanum-slam\[ros\]'"):
                write_mcap(episode.recording, tmp_path / "e.mcap", robot=RobotConfig(), lidar=LIDAR)
    assert list(tmp_path.iterdir()) == []
