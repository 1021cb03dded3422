"""Messages from our types and back, through CDR and against rosbags' own types."""

from __future__ import annotations

import array
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.formats import write_map_server
from slam.geometry import transform_points
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.ros import (
    Frames,
    Mount,
    fill,
    grid_message,
    mount_of,
    odometry_message,
    odometry_of,
    pose_with_covariance,
    resampled,
    rosbags_message,
    scan_message,
    scan_of,
    stamp_of,
    transform_message,
    transforms_of,
    twist_message,
)
from slam.types import Scan
from tests.slam.ros.bags_on_disk import ODOMETRY, SCAN, TF, mounted, scan
from tests.slam.written_files import read_map_server

pytest.importorskip("rosbags")
from rosbags.typesys import Stores, get_typestore

STORES = (get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS2_JAZZY))
poses = st.tuples(*[st.floats(-1e4, 1e4)] * 2, st.floats(-math.pi + 1e-9, math.pi - 1e-9)).map(np.array)


def through_cdr(datatype: str, message: Any, types: Any = STORES[0]) -> Any:
    return types.deserialize_cdr(
        types.serialize_cdr(rosbags_message(types, datatype, message), datatype), datatype
    )


@given(pose=poses, twist=poses, at=st.floats(0.0, 2e9))
def test_odometry_comes_back(pose, twist, at):
    for types in STORES:
        got = through_cdr(ODOMETRY, odometry_message(at, "odom", "base_link", pose, twist), types)
        assert np.allclose(odometry_of(got), pose, rtol=1e-12, atol=1e-12)
        assert stamp_of(got) == pytest.approx(at, abs=1e-9 + 1e-6 * (at > 1e6))
        assert (got.header.frame_id, got.child_frame_id) == ("odom", "base_link")
        linear, angular = got.twist.twist.linear, got.twist.twist.angular
        assert (linear.x, linear.y, linear.z, angular.z) == (twist[0], twist[1], 0.0, twist[2])
    alone = through_cdr("geometry_msgs/msg/Twist", twist_message(twist))
    assert (alone.linear.x, alone.linear.y, alone.angular.z) == tuple(twist)


@given(
    ranges=st.lists(
        st.one_of(st.floats(0.03125, 7.875, width=32), st.sampled_from([math.inf, math.nan])), min_size=2
    ),
    angle_min=st.floats(-3.125, 0.0, width=32),
)
def test_a_scan_comes_back(ranges, angle_min):
    step = 2.0 * math.pi / len(ranges)
    sent = Scan(np.array(ranges), angle_min, step, 8.0, 0.02)
    got = scan_of(through_cdr(SCAN, scan_message(1.5, "laser", sent)))
    assert np.array_equal(got.ranges, sent.ranges, equal_nan=True)
    assert (got.angle_min, got.range_max) == (angle_min, 8.0)
    assert got.angle_increment == pytest.approx(step, rel=1e-6) and got.range_min == pytest.approx(0.02)


def test_rep_117():
    said = [0.01, 0.0, -1.0, 0.02, 1.0, 7.99, 8.0, 8.01, 65.0, math.inf, -math.inf, math.nan]
    meant = [math.nan] * 3 + [0.02, 1.0, 7.99, math.inf] + [math.nan] * 2 + [math.inf] + [math.nan] * 2
    got = scan_of(SimpleNamespace(ranges=said, angle_min=-1.0, angle_increment=0.1, range_min=0.02, range_max=8.0))
    assert np.array_equal(got.ranges, meant, equal_nan=True)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"ranges": [1.0]}, "1 beams"), ({"ranges": [1.0] * 10_001}, "10001 beams"),
        ({"angle_increment": 0.0}, "no sweep"), ({"angle_increment": math.nan}, "no sweep"),
        ({"angle_increment": 1.0}, "no sweep"), ({"angle_min": 1e30}, "no sweep"),
        ({"range_max": math.inf}, "range_max inf"),
        ({"range_max": 0.01}, "range_min 0.02"), ({"range_min": math.nan}, "range_min nan"),
    ],
)  # fmt: skip
def test_what_a_scan_may_not_be(fields, words):
    good = {"ranges": [1.0] * 10, "angle_min": -1.0, "angle_increment": 0.1, "range_min": 0.02, "range_max": 8.0}
    with pytest.raises(ValueError, match=words):
        scan_of(SimpleNamespace(**good | fields))


@given(pose=poses, data=st.data())
def test_a_pose_and_its_covariance_are_where_ros_looks(pose, data):
    root = np.array(data.draw(st.lists(st.floats(-2.0, 2.0), min_size=9, max_size=9))).reshape(3, 3)
    cov = root @ root.T
    got = through_cdr("geometry_msgs/msg/PoseWithCovarianceStamped", pose_with_covariance(2.0, "map", pose, cov))
    whole = got.pose.covariance.reshape(6, 6)  # x, y, z, and the turns about them
    assert np.array_equal(whole[np.ix_([0, 1, 5], [0, 1, 5])], cov) and np.array_equal(whole, whole.T)
    assert not whole[[2, 3, 4]].any()
    (placed,) = transforms_of(through_cdr(TF, {"transforms": [transform_message("map", "odom", 2.0, pose)]}))
    assert (placed.parent, placed.child, placed.time_s) == ("map", "odom", 2.0)
    point = np.array([[0.3, -1.2]])
    assert np.allclose((placed.matrix @ [0.3, -1.2, 0.0, 1.0])[:2], transform_points(pose, point)[0], atol=1e-8)


def test_a_map_is_the_one_that_map_server_is_given(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    classes = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), (30, 41))
    grid = OccupancyGrid.from_classes(classes, 0.05, (-1.25, 3.5))
    write_map_server(tmp_path / "map", grid)
    message = grid_message(1.0, "map", grid.classes(), grid.resolution, grid.origin)
    got = through_cdr("nav_msgs/msg/OccupancyGrid", message)
    from_file, resolution, origin = read_map_server(tmp_path / "map.yaml")
    assert np.array_equal(got.data.reshape(got.info.height, got.info.width), from_file)
    assert set(np.unique(got.data)) == {-1, 0, 100} and got.data.dtype == np.int8
    assert got.info.resolution == pytest.approx(resolution)
    assert (got.info.origin.position.x, got.info.origin.position.y) == pytest.approx(origin)


# ---- where the lidar sits --------------------------------------------------------------------------------------


@given(
    yaw=st.floats(-math.pi, math.pi), flipped=st.booleans(), clockwise=st.booleans(),
    angle_min=st.floats(-math.pi, math.pi), beams=st.integers(2, 50),
)  # fmt: skip
def test_a_level_scan_points_where_the_beams_did(yaw, flipped, clockwise, angle_min, beams):
    _, _, _, message = mounted(0.4, -0.1, yaw, flipped=flipped)
    (placed,) = transforms_of(through_cdr(TF, message))
    mount = mount_of(placed.matrix)
    assert (mount.x_m, mount.y_m, mount.flipped) == (0.4, -0.1, flipped)
    step = (-1.0 if clockwise else 1.0) * 4.0 / beams
    seen = scan(np.arange(1.0, beams + 1), angle_min=angle_min, angle_increment=step, range_max=100.0)
    level = mount.level(seen)
    assert level.angle_increment > 0.0
    bearings = level.angle_min + level.angle_increment * np.arange(beams)
    assert -math.pi - 1e-9 <= bearings.mean() <= math.pi + 1e-9
    by_heading = {r: (r * math.cos(b), r * math.sin(b)) for r, b in zip(level.ranges, bearings, strict=True)}
    for k, r in enumerate(seen.ranges):
        b = angle_min + k * step
        point = placed.matrix[:3, :3] @ (r * np.array([math.cos(b), math.sin(b), 0.0]))
        assert np.allclose(by_heading[r], point[:2], atol=1e-6 * r) and abs(point[2]) < 1e-6


def test_frames_are_followed_to_their_root():
    frames = Frames()
    for parent, child, pose in (
        ("odom", "base_footprint", [7.0, 7.0, 1.0]), ("base_footprint", "base_link", [0.1, 0.0, 0.0]),
        ("base_link", "tower", [0.0, 0.0, math.pi / 2]), ("tower", "laser", [0.2, 0.1, 0.0]),
    ):  # fmt: skip
        (placed,) = transforms_of(
            through_cdr(TF, {"transforms": [transform_message(f"/{parent}", child, 0.0, pose)]})
        )
        frames.add(placed)
    matrix = frames.between("base_footprint", "laser")
    assert matrix is not None
    assert mount_of(matrix) == pytest.approx(Mount(0.0, 0.2, math.pi / 2), abs=1e-9)
    assert frames.between("base_link", "camera") is None
    assert np.allclose(frames.between("camera", "camera"), np.eye(4))


def test_what_no_lidar_or_robot_is():
    for roll, ok in ((0.15, True), (0.2, False), (math.pi - 0.2, False), (math.pi - 0.15, True)):
        q = SimpleNamespace(x=math.sin(roll / 2), y=0.0, z=0.0, w=math.cos(roll / 2))
        moved = SimpleNamespace(translation=SimpleNamespace(x=0.0, y=0.0, z=0.0), rotation=q)
        header = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="base_link")
        each = SimpleNamespace(header=header, child_frame_id="laser", transform=moved)
        (placed,) = transforms_of(SimpleNamespace(transforms=[each]))
        if ok:
            mount_of(placed.matrix)
        else:
            with pytest.raises(ValueError, match="leans by 11"):
                mount_of(placed.matrix)
    bad = rosbags_message(STORES[0], ODOMETRY, {})
    with pytest.raises(ValueError, match="quaternion of length 0"):
        odometry_of(bad)
    far = rosbags_message(
        STORES[0], ODOMETRY, odometry_message(0.0, "odom", "b", np.array([math.nan, 0, 0]), np.zeros(3))
    )
    with pytest.raises(ValueError, match="no robot has"):
        odometry_of(far)


@given(turn=st.integers(-40, 40), beams=st.integers(8, 40), drop=st.integers(0, 5))
def test_resampled_is_the_nearest_beam(turn, beams, drop):
    step = 2.0 * math.pi / beams
    seen = scan(np.arange(1.0, beams + 1), angle_min=-math.pi + (turn + 0.3) * step, range_max=100.0)
    seen = seen._replace(ranges=seen.ranges[: beams - drop], angle_increment=step)
    got = resampled(seen, -math.pi, step, beams)
    for k, r in enumerate(got):
        asked = -math.pi + k * step
        away = np.abs((seen.angle_min + step * np.arange(beams) - asked + math.pi) % (2 * math.pi) - math.pi)
        nearest = int(np.argmin(away))
        assert r == seen.ranges[nearest] if nearest < beams - drop else math.isnan(r)


def test_a_message_of_ros_is_filled_in_place():
    target = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id=""),
        info=SimpleNamespace(
            map_load_time=SimpleNamespace(sec=0, nanosec=0), resolution=0.0, width=0, height=0,
            origin=SimpleNamespace(position=SimpleNamespace(x=0.0, y=0.0, z=0.0),
                                   orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)),
        ),
        data=array.array("b"),
    )  # fmt: skip
    classes = np.array([[-1, 0], [100, 0]], np.int8)
    assert fill(target, grid_message(2.5, "map", classes, 0.1, (1.0, 2.0))) is target
    assert target.data == array.array("b", [-1, 0, 100, 0]) and target.info.origin.position.y == 2.0
    assert (target.header.stamp.sec, target.header.stamp.nanosec) == (2, 500_000_000)
    covariance = fill(SimpleNamespace(covariance=np.zeros(36)), {"covariance": np.arange(36.0)}).covariance
    assert covariance.dtype == np.float64 and covariance[35] == 35.0
