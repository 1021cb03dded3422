"""ROS 2 bags written by rosbags: what is read of them is what was recorded, or one line says what is wrong."""

from __future__ import annotations

import math
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.geometry import compose, exp, inverse, relative
from slam.logs import BagTopics, ScanLog, open_log, parse_mount, with_reference
from slam.ros import Mount, odometry_message, scan_message, transform_message
from tests.slam.logs.logs_on_disk import data_folder
from tests.slam.logs.scans_on_disk import carmen_lines, put_lines
from tests.slam.ros.bags_on_disk import ODOMETRY, SCAN, TF, mounted, recorded, scan, write_bag

pytest.importorskip("rosbags")
pytest.importorskip("mcap")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> ScanLog:
    folder = tmp_path_factory.mktemp("carmen")
    found = open_log(put_lines(folder / "room.log", carmen_lines(30, kind="gfs2log")))
    return with_reference(found, put_lines(folder / "truth.log", carmen_lines(30, kind="corrected")))


def bag(path: Path, **topics: Any) -> ScanLog:
    found = open_log(path, topics=BagTopics(**topics) if topics else None)
    assert isinstance(found, ScanLog)
    return found


def check_same(found: ScanLog, log: ScanLog) -> None:
    assert np.allclose(found.times, log.times, atol=1e-6) and found.clock_start_s == pytest.approx(
        log.clock_start_s
    )
    assert np.allclose(found.ranges, log.ranges, rtol=1e-6, equal_nan=True)
    assert np.array_equal(np.isinf(found.ranges), np.isinf(log.ranges))
    assert np.abs(relative(log.odometry_poses, found.odometry_poses)).max() < 1e-9
    for name in ("angle_min", "angle_increment", "range_max"):
        assert getattr(found, name) == pytest.approx(getattr(log, name), rel=1e-6)
    # A bag says where the laser sits, and is watched.
    untold = {"odometry": {**found.settings["odometry"], "mount_sigma_m": 0.1}, "health": {"recover": False}}
    assert found.settings | untold == log.settings | untold
    assert "health" not in found.settings and "mount_sigma_m" not in found.settings["odometry"]


def refused(path: Path, **topics: Any) -> str:
    with pytest.raises(ValueError) as error:
        bag(path, **topics)
    text = str(error.value)
    assert "\n" not in text and path.name in text and len(text) < 600
    return text


STORAGES = [("mcap", ""), ("mcap", "storage"), ("sqlite3", ""), ("sqlite3", "message"), ("mcap", "message")]


def test_odometry_that_begins_anew_moves_nobody(tmp_path: Path) -> None:
    """Neither by the jump itself, nor at the scan in the middle of it."""
    twist, anew = np.array([0.5, 0.0, 0.2]), np.array([-3.0, 8.0, 2.0])
    true = np.array([exp(twist * 0.1 * k) for k in range(41)])
    messages = [mounted(0.0, 0.0, 0.0)]
    for k, pose in enumerate(true):
        said = pose if k <= 20 else compose(anew, compose(inverse(true[21]), pose))
        messages.append(("/odom", ODOMETRY, 0.1 * k, odometry_message(0.1 * k, "odom", "base_link", said, twist)))
        at = 0.1 * k + 0.05
        messages.append(("/scan", SCAN, at, scan_message(at, "laser", scan(np.full(90, 2.0)))))
    found = bag(write_bag(tmp_path / "anew", messages))
    assert "jumps of the odometry that are left out: 1" in found.note
    moved = relative(found.odometry_poses[:-1], found.odometry_poses[1:])
    usual = exp(twist * 0.1)
    assert np.allclose(moved[:19], usual, atol=1e-3) and np.allclose(moved[22:], usual, atol=1e-3)
    assert np.hypot(*moved[:, :2].T).max() < 0.06  # the step across the jump is the only one that is missing
    assert np.hypot(*(found.odometry_poses[-1] - true[-1])[:2]) < 0.15


@pytest.mark.parametrize(("storage", "mode"), STORAGES)
def test_a_carmen_log_as_a_bag_is_the_same_log(storage: str, mode: str, log: ScanLog, tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "drive", recorded(log, reference="/truth"), storage=storage, mode=mode)
    found = bag(folder, reference="/truth")
    check_same(found, log)
    assert np.array_equal(found.reference_times, log.reference_times)
    assert np.abs(relative(log.reference_poses, found.reference_poses)).max() < 1e-9
    assert np.allclose(found.start_pose, log.start_pose) and found.name == "drive"
    assert "/truth" in found.note and bag(folder).reference_poses.shape == (0, 3)
    (alone,) = (p for p in folder.iterdir() if p.suffix in (".mcap", ".db3"))
    check_same(bag(alone), log)


def test_a_real_log_as_a_bag_is_the_same_log(tmp_path: Path) -> None:
    real = open_log(data_folder("carmen") / "intel.gfs.log.gz").until(600.0)
    assert isinstance(real, ScanLog)
    check_same(bag(write_bag(tmp_path / "intel", recorded(real))), real)


def test_odometry_of_tf_and_of_any_name(log: ScanLog, tmp_path: Path) -> None:
    check_same(bag(write_bag(tmp_path / "tf", recorded(log, odometry="/tf"))), log)
    check_same(bag(write_bag(tmp_path / "named", recorded(log, odometry="/wheels"))), log)
    transforms = (message for message in recorded(log, odometry="/tf") if message[0] == "/tf")
    both = write_bag(tmp_path / "both", chain(recorded(log), transforms))
    check_same(bag(both, odom="/tf", scan="/scan").until(log.duration_s), bag(both))


def drive(*, mount: Any, at: float = 1e9, base: str = "base_link", place: Any = None, scans: int = 12) -> Any:
    """Yield a drive along a curve, odometry at 20 Hz, scans between; each scan of so many beams of its number."""
    yield mount
    step = np.array([0.05, 0.01, 0.03])
    pose = np.array([3.0, -1.0, 3.1])
    for k in range(4 * scans):
        time_s = at + 0.05 * k
        yield "/odom", ODOMETRY, time_s, odometry_message(time_s, "odom", base, pose, step / 0.05)
        pose = compose(pose, step)
        if k % 4 == 1:
            ranges = np.arange(1.0, 9.0) / 2.0
            seen = scan(ranges) if place is None else place(k // 4, ranges)
            yield "/scan", SCAN, time_s + 0.02, scan_message(time_s + 0.02, "laser", seen)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_files_of_a_bag_are_read_by_number(storage: str, tmp_path: Path) -> None:
    messages = list(drive(mount=mounted(0.2, 0.0, 0.0), scans=24))
    whole = write_bag(tmp_path / "drive", messages, storage=storage)
    split = tmp_path / "split"
    split.mkdir()
    for k in range(12):
        part = write_bag(tmp_path / f"part{k}", _twelfth(messages, k), storage=storage)
        (file,) = (p for p in part.iterdir() if p.suffix in (".mcap", ".db3"))
        file.rename(split / f"drive_{k}{file.suffix}")
    assert np.array_equal(bag(split).odometry_poses, bag(whole).odometry_poses)
    (split / f"drive_12{file.suffix}.zstd").write_bytes(b"")
    assert "take the packed files away" in refused(split)


def _twelfth(messages: list[Any], k: int) -> list[Any]:
    length = -(-len(messages) // 12)
    return messages[k * length : (k + 1) * length]


def test_the_robot_is_what_carries_the_lidar(log: ScanLog, tmp_path: Path) -> None:
    """Other frames may hang from odom, too; and odd messages on other topics are nobody's affair."""

    utm = transform_message("utm", "map", 1.0, [448262.0, 5411932.0, 0.0])
    nowhere = odometry_message(1.0, "odom", "base_link", np.array([math.nan, 0.0, 0.0]), np.zeros(3))

    def more(odd: bool) -> Any:
        for message in recorded(log, odometry="/tf"):
            yield message
            topic, _, at, _ = message
            if topic == "/tf":
                dock = transform_message("odom", "dock", at + 0.01, [4.3, 1.7, 0.9])
                yield "/tf", TF, at + 0.01, {"transforms": [utm, dock]}
                if odd:
                    yield "/gps/odom", ODOMETRY, at, nowhere

    check_same(bag(write_bag(tmp_path / "dock", more(True)), odom="/tf"), log)
    assert "'/gps/odom' has a position" in refused(write_bag(tmp_path / "odd", more(True)), odom="/gps/odom")
    both = [m for m in more(False) if m[0] != "/tf_static"]
    assert "all hang from odom in /tf" in refused(write_bag(tmp_path / "none", both), mount=Mount(0.0, 0.0, 0.0))


def test_scans_between_two_odometries_and_outside(tmp_path: Path) -> None:
    late = ("/scan", SCAN, 2e9, scan_message(2e9, "laser", scan(np.ones(8))))
    found = bag(write_bag(tmp_path / "b", [*drive(mount=mounted(0.2, 0.0, 0.0)), late]))
    assert len(found.times) == 12 and found.clock_start_s == pytest.approx(1e9 + 0.07, abs=1e-6)
    assert found.settings["lidar_offset_m"] == pytest.approx(0.2)
    pose = np.array([3.0, -1.0, 3.1])
    before = compose(pose, np.array([0.05, 0.01, 0.03]))
    after = compose(before, np.array([0.05, 0.01, 0.03]))
    assert np.allclose(found.odometry_poses[0][:2], before[:2] + 0.4 * (after - before)[:2], atol=1e-6)
    assert math.cos(found.odometry_poses[0][2] - before[2] - 0.012) == pytest.approx(1.0, abs=1e-10)


@pytest.mark.parametrize("base", ["base_link", "base_footprint"])
def test_a_lidar_that_looks_back_sideways_and_upside_down(base: str, tmp_path: Path) -> None:
    like = drive(mount=mounted(0.1, 0.3, math.pi / 2, flipped=True, base=base), base=base)
    found = bag(write_bag(tmp_path / "b", like))
    # Beam k of 8 runs at -π + kπ/4 in its own frame, and at π/2 less that by the robot's heading.
    assert found.angle_increment == pytest.approx(math.pi / 4, rel=1e-6)
    bearings = found.angle_min + found.angle_increment * np.arange(8)
    measured = {round(float(r), 3): b for r, b in zip(found.ranges[0], bearings, strict=True)}
    for k in range(8):
        meant = math.pi / 2 - (-math.pi + k * math.pi / 4)
        assert math.cos(measured[0.5 + 0.5 * k] - meant) == pytest.approx(1.0, abs=1e-9)
    straight = bag(write_bag(tmp_path / "c", drive(mount=mounted(0.1, 0.0, 0.0, base=base), base=base)))
    beside = relative(straight.odometry_poses, found.odometry_poses)
    assert np.allclose(beside, [0.0, 0.3, 0.0], atol=1e-9), "poses are of the point behind the lidar"
    assert found.settings["lidar_offset_m"] == pytest.approx(0.1)
    # So are those of a reference, which are of the robot's frame.
    rows = np.column_stack([straight.odometry_poses, straight.stamps])
    lines = ["FLASER 2 1 1 {:.9f} {:.9f} {:.9f} 0 0 0 {:.6f} host 0".format(*row) for row in rows]
    (tmp_path / "truth.log").write_text("\n".join(lines) + "\n")
    moved = with_reference(found, tmp_path / "truth.log").reference_poses
    assert np.allclose(moved, found.odometry_poses, atol=1e-6)


def test_messages_in_any_order_and_twice_are_the_same_log(tmp_path: Path) -> None:
    messages = list(drive(mount=mounted(0.2, 0.0, 0.0)))
    log = bag(write_bag(tmp_path / "whole", messages))
    mixed = np.random.default_rng(0).permutation(len(messages))
    for name, again in {
        "mixed": [messages[k] for k in mixed],
        "twice": [message for message in messages for _ in range(2)],
        "merged": [*messages, *messages],
    }.items():
        found = bag(write_bag(tmp_path / name, again))
        assert np.array_equal(found.stamps, log.stamps) and np.array_equal(found.times, log.times), name
        assert np.array_equal(found.ranges, log.ranges), name
        assert np.array_equal(found.odometry_poses, log.odometry_poses), name


def test_scans_of_one_stamp_that_differ_are_all_kept(tmp_path: Path) -> None:
    """A coarse clock's."""
    messages = [(t, d, at, m) for t, d, at, m in drive(mount=mounted(0.2, 0.0, 0.0)) if t != "/scan"]
    for k in range(20):
        at = 1e9 + 0.5 + 0.5 * (k // 5)
        messages.append(("/scan", SCAN, at, scan_message(at, "laser", scan(np.full(8, 1.0 + 0.1 * k)))))
    assert len(bag(write_bag(tmp_path / "b", messages)).times) == 20


def test_a_reference_at_rare_scans_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The picture of a replay breaks it at gaps: a scan a second or two is none."""
    messages = [mounted(0.2, 0.0, 0.0)]
    for k in range(40):
        at, pose = 1e9 + 0.25 * k, np.array([0.1 * k, 0.0, 0.0])
        messages += [(t, ODOMETRY, at, odometry_message(at, "odom", "base_link", pose, np.zeros(3)))
                     for t in ("/odom", "/truth")]  # fmt: skip
        if k % 8 == 4:
            messages.append(("/scan", SCAN, at, scan_message(at, "laser", scan(np.full(8, 2.0)))))
    monkeypatch.chdir(write_bag(tmp_path / "rare", messages))
    log = bag(Path("."), reference="/truth")
    assert len(log.reference_times) == 5 and np.diff(log.reference_times).max() < log.reference_gap_s < 10.0
    assert log.name == "rare", "the folder that it is in"


def test_two_lidars_on_one_topic_are_refused(tmp_path: Path) -> None:
    messages = list(drive(mount=mounted(0.2, 0.0, 0.0)))
    rear = ("/scan", SCAN, 1e9 + 0.3, scan_message(1e9 + 0.3, "rear", scan(np.ones(8))))
    text = refused(write_bag(tmp_path / "b", [*messages, rear]))
    assert "topic '/scan' has scans in frames 'laser' and 'rear'; record a topic for each lidar" in text


def test_a_lidar_that_measures_nothing_is_refused(tmp_path: Path) -> None:
    in_mm = drive(mount=mounted(0.2, 0.0, 0.0), place=lambda _, ranges: scan(1e3 * ranges))
    text = refused(write_bag(tmp_path / "b", in_mm))
    assert "every beam of /scan is lost: no range lies between range_min and range_max, 0.02 and 8 m" in text
    glass = drive(mount=mounted(0.2, 0.0, 0.0), place=lambda _, r: scan(np.where(r > 2.0, 1e3 * r, math.inf)))
    assert "every beam of /scan is lost" in refused(write_bag(tmp_path / "glass", glass))


def test_messages_of_ros_1_are_told_what_to_do(tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "drive.mcap"
    with path.open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start(profile="ros1", library="x")
        schema = writer.register_schema("sensor_msgs/LaserScan", "ros1msg", b"")
        writer.add_message(writer.register_channel("/scan", "ros1", schema), 0, b"", 0)
        writer.finish()
    assert "is of ROS 1; take the bag that it was made from, and make it one of ROS 2" in refused(path)


@pytest.mark.parametrize("others", [(1, 3, 5, 7, 9, 11), (0,)])
def test_scans_of_changing_beams_are_laid_on_most(tmp_path: Path, others: tuple[int, ...]) -> None:
    """Where neither are more, on the first."""

    def place(number: int, ranges: Any) -> Any:
        twice = scan(np.repeat(ranges, 2), angle_min=-math.pi - math.pi / 16)
        return twice if number in others else scan(ranges)

    found = bag(write_bag(tmp_path / "b", drive(mount=mounted(0.2, 0.0, 0.0), place=place)))
    assert np.array_equal(found.ranges, np.tile(np.arange(1.0, 9.0) / 2.0, (12, 1)))


def test_which_topics_there_are_is_said(log: ScanLog, tmp_path: Path) -> None:
    none = write_bag(tmp_path / "none", [mounted(0.0, 0.0, 0.0)], topics=["/chatter"])
    text = refused(none)
    assert "no topic of scan; record a sensor_msgs/LaserScan" in text and "/chatter (String)" in text
    more = [
        (topic, SCAN, 500.0, scan_message(500.0, "laser", scan(np.ones(8))))
        for topic in ("/front/scan", "/rear/scan")
    ]
    two = write_bag(tmp_path / "two", [*more, *(m for m in recorded(log) if m[0] != "/scan")])
    assert "2 topics could be the scan; choose by --scan-topic from /front/scan (LaserScan)" in refused(two)
    assert bag(two, scan="/rear/scan").ranges.shape == (1, 8)
    assert "no scan on topic '/odom'" in refused(two, scan="/odom")
    whole = write_bag(tmp_path / "whole", recorded(log))
    assert "no odometry on topic '/x'; choose by --odom-topic" in refused(whole, odom="/x")
    assert "no reference on topic '/x'; choose by --reference-topic" in refused(whole, reference="/x")
    still = write_bag(tmp_path / "still", (m for m in recorded(log) if m[0] != "/odom"))
    assert "no topic of odometry; record a nav_msgs/Odometry, or the transform odom → base" in refused(still)


def test_where_the_lidar_is_has_to_be_known(log: ScanLog, tmp_path: Path) -> None:
    bare = write_bag(tmp_path / "bare", (m for m in recorded(log) if m[0] != "/tf_static"))
    assert "'laser' is on 'base_link'; record /tf_static, or give --mount X,Y,DEG" in refused(bare)
    found = bag(bare, mount=parse_mount("0.2,0,180"))
    assert found.settings["lidar_offset_m"] == 0.2
    assert math.cos(found.angle_min + math.pi / 2 - math.pi) == pytest.approx(1.0)
    leaning = transform_message("base_link", "laser", 0.0, [0.0, 0.0, 0.0])
    leaning["transform"]["rotation"] = {"x": math.sin(0.3), "w": math.cos(0.3)}
    moved = [("/tf_static", TF, 0.0, {"transforms": [leaning]})]
    text = refused(write_bag(tmp_path / "lean", [*moved, *(m for m in recorded(log) if m[0] != "/tf_static")]))
    assert "leans by 34°" in text
    ring = [transform_message(a, b, 0.0, [0.0, 0.0, 0.0]) for a, b in (("laser", "x"), ("x", "laser"))]
    circle = [("/tf_static", TF, 0.0, {"transforms": ring})]
    text = refused(write_bag(tmp_path / "ring", [*circle, *(m for m in recorded(log) if m[0] != "/tf_static")]))
    assert "frames in a circle" in text


@pytest.mark.parametrize("text", ["", "1,2", "a,b,c", "nan,0,0", "0,0,361", "11,0,0", "0,0,0,upside", "1,2,3,4,5"])
def test_what_a_mount_may_not_be(text: str) -> None:
    with pytest.raises(ValueError, match="is not X,Y,DEG"):
        parse_mount(text)
    assert parse_mount("0.2,-0.1,90,flipped") == pytest.approx(Mount(0.2, -0.1, math.pi / 2, True))


def test_what_a_bag_may_not_say(log: ScanLog, tmp_path: Path) -> None:
    base = [*recorded(log)]
    at = log.clock_start_s + 1.0
    bad = {
        "no sweep": ("/scan", SCAN, at, scan_message(at, "laser", scan(np.ones(8), angle_increment=3.0))),
        "range_max": ("/scan", SCAN, at, scan_message(at, "laser", scan(np.ones(8), range_max=math.nan))),
        "quaternion": ("/odom", ODOMETRY, at, {}),
        "no robot has": (
            "/odom",
            ODOMETRY,
            at,
            odometry_message(at, "odom", "b", np.array([1e9, 0, 0]), np.zeros(3)),
        ),
    }
    for k, (words, message) in enumerate(bad.items()):
        assert words in refused(write_bag(tmp_path / str(k), [*base, *[message] * 4]))
    jump = odometry_message(at + 0.01, "odom", "b", np.array([9e4, 0.0, 0.0]), np.zeros(3))
    assert "jumps by" in refused(write_bag(tmp_path / "jump", [*base, ("/odom", ODOMETRY, at, jump)]))
    other = [
        (t, d, at, {**m, "header": {**m["header"], "stamp": {"sec": 7}}} if d == SCAN else m)
        for t, d, at, m in base
    ]
    assert "no scan of /scan is from the time of the odometry" in refused(write_bag(tmp_path / "clock", other))


def test_damaged_and_hostile_bags(log: ScanLog, tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "whole", recorded(log))
    (file,) = folder.glob("*.mcap")
    data = file.read_bytes()
    for name, content in {
        "cut": data[: len(data) // 2], "empty": b"", "text": b"hello" * 99,
        "magic": data[:8],
    }.items():  # fmt: skip
        (tmp_path / f"{name}.mcap").write_bytes(content)
        assert "is damaged" in refused(tmp_path / f"{name}.mcap")
    (tmp_path / "text.db3").write_bytes(b"hello" * 99)
    assert "is damaged" in refused(tmp_path / "text.db3")
    (tmp_path / "folder.mcap").mkdir()
    with pytest.raises(ValueError, match="no log that is known"):
        open_log(tmp_path / "folder.mcap")
    (tmp_path / "gone.mcap").symlink_to("nowhere.mcap")
    with pytest.raises(ValueError, match="does not exist"):
        open_log(tmp_path / "gone.mcap")
    packed = write_bag(tmp_path / "files", recorded(log), storage="sqlite3", mode="file")
    assert "unpack it by zstd -d" in refused(packed)
    (one,) = packed.glob("*.zstd")
    assert "is packed; unpack it by zstd -d" in refused(one)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "brotli"])
def test_a_bomb_is_no_bag(compression: str, tmp_path: Path) -> None:
    import lz4.frame
    import zstandard
    from mcap.records import Chunk
    from mcap.writer import Writer

    zeros = bytes(200 * 2**20)
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "brotli": lambda _: b"x"}[compression](zeros)
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as stream:
        writer: Any = Writer(stream)
        writer.start(profile="ros2", library="x")
        writer.finish()
    whole = path.read_bytes()
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    Chunk(compression, packed, 0, 0, 0, len(zeros)).write(builder)
    end_of_header = 8 + 9 + int.from_bytes(whole[9:17], "little")
    path.write_bytes(whole[:end_of_header] + builder.end() + whole[end_of_header:])
    assert ("is packed by 'brotli'" if compression == "brotli" else "unpacks to more") in refused(path)


def test_options_of_bags_are_of_no_other_log(tmp_path: Path) -> None:
    path = put_lines(tmp_path / "a.log", carmen_lines(5))
    with pytest.raises(ValueError, match="is no ROS 2 bag; leave --scan-topic"):
        open_log(path, topics=BagTopics(scan="/scan"))
