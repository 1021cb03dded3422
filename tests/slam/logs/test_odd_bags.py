"""Bags of which something is odd: a few messages, names of files, topics that are asked for twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.logs import BagTopics, ScanLog, open_log, with_reference
from slam.ros import odometry_message, scan_message
from tests.slam.logs.scans_on_disk import carmen_lines, put_lines
from tests.slam.ros.bags_on_disk import ODOMETRY, SCAN, Recorded, mounted, recorded, scan, write_bag

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

SCANS = 40


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> ScanLog:
    folder = tmp_path_factory.mktemp("carmen")
    found = open_log(put_lines(folder / "room.log", carmen_lines(SCANS, kind="gfs2log")))
    return with_reference(found, put_lines(folder / "truth.log", carmen_lines(SCANS, kind="corrected")))


def bag(path: Path, **topics: str) -> ScanLog:
    found = open_log(path, topics=BagTopics(**topics))
    assert isinstance(found, ScanLog)
    return found


def refused(path: Path, **topics: str) -> str:
    with pytest.raises(ValueError) as error:
        bag(path, **topics)
    text = str(error.value)
    assert "\n" not in text and len(text) < 600
    return text


def empty_scan(at: float) -> Recorded:
    return "/scan", SCAN, at, scan_message(at, "laser", scan(np.ones(8))._replace(ranges=np.zeros(0)))


def no_quaternion(at: float) -> Recorded:
    message: Any = odometry_message(at, "odom", "base_link", np.zeros(3), np.zeros(3))
    return "/odom", ODOMETRY, at, {**message, "pose": {}}


@pytest.mark.parametrize(("odd", "words"), [(empty_scan, "0 beams"), (no_quaternion, "quaternion of length 0")])
def test_a_few_odd_messages_are_left_out_and_counted(odd: Any, words: str, log: ScanLog, tmp_path: Path) -> None:
    messages = list(recorded(log, reference="/truth"))
    at = [log.clock_start_s + 1.0 + 0.01 * k for k in range(5)]
    few = bag(write_bag(tmp_path / "few", [*messages, *(odd(when) for when in at[:2])]))
    assert np.array_equal(few.stamps, bag(write_bag(tmp_path / "none", messages)).stamps)
    topic = odd(0.0)[0]
    assert few.note.endswith(f"invalid messages that are left out: 2 of {topic}")
    text = refused(write_bag(tmp_path / "many", [*messages, *(odd(when) for when in at)]))
    assert f"topic '{topic}' has a" in text and words in text
    assert f"(at stamp {at[0]:.3f} s; 5 of {SCANS + 5} messages are invalid)" in text


def test_odd_messages_of_a_reference_are_counted_too(log: ScanLog, tmp_path: Path) -> None:
    odd = ("/truth", *no_quaternion(log.clock_start_s + 1.0)[1:])
    path = write_bag(tmp_path / "b", [*recorded(log, reference="/truth"), odd])
    assert bag(path, reference="/truth").note.endswith("left out: 1 of /truth")
    assert "left out" not in bag(path).note


def test_a_topic_of_nothing_but_odd_messages_says_so(log: ScanLog, tmp_path: Path) -> None:
    others = [message for message in recorded(log) if message[0] != "/scan"]
    bad = [("/laser", *empty_scan(log.clock_start_s + k)[1:]) for k in range(4)]
    assert "topic '/laser' has a scan of 0 beams" in refused(write_bag(tmp_path / "b", [*others, *bad]))


def test_the_note_names_the_topics(log: ScanLog, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "b", recorded(log, odometry="/wheels", reference="/truth"))
    assert bag(path, odom="/wheels").note.endswith("; scans of /scan, odometry of /wheels")
    note = bag(path, reference="/truth").note
    assert note == "reference: /truth; the start pose is the reference's; scans of /scan, odometry of /wheels"


def test_odometry_is_no_truth(log: ScanLog, tmp_path: Path) -> None:
    """Neither that of ``/tf``, nor the topic that is the odometry."""
    by_tf = write_bag(tmp_path / "tf", [*recorded(log, odometry="/tf", reference="/truth")])
    assert "no reference on topic '/tf'; choose by --reference-topic from" in refused(by_tf, reference="/tf")
    only_tf = write_bag(tmp_path / "only", recorded(log, odometry="/tf"))
    text = refused(only_tf, reference="/tf")
    assert "no reference on topic '/tf'; record a nav_msgs/Odometry, PoseStamped or" in text
    both = write_bag(tmp_path / "both", recorded(log, reference="/truth"))
    for topics in ({}, {"odom": "/odom"}):
        text = refused(both, reference="/odom", **topics)
        assert "topic '/odom' cannot be both odometry and reference; choose another by --odom-topic or" in text
    swapped = bag(both, odom="/truth", reference="/odom")
    assert np.allclose(swapped.reference_poses, log.odometry_poses, atol=1e-9)
    one = write_bag(tmp_path / "one", recorded(log, odometry="/wheels"))
    assert "topic '/wheels' cannot be both" in refused(one, reference="/wheels")


@pytest.mark.parametrize(("storage", "suffix"), [("mcap", ".MCAP"), ("sqlite3", ".DB3")])
def test_suffixes_may_be_capitals(storage: str, suffix: str, log: ScanLog, tmp_path: Path) -> None:
    folder = write_bag(tmp_path / "b", recorded(log), storage=storage)
    (file,) = (path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    capital = file.rename(file.with_suffix(suffix))
    for path in (capital, folder):
        assert len(bag(path).times) == SCANS
    packed = capital.rename(capital.with_suffix(f"{suffix}.ZSTD"))
    assert "is packed; unpack it by zstd -d" in refused(packed)


def test_without_scans_it_says_what_to_record(tmp_path: Path) -> None:
    messages = [mounted(0.2, 0.0, 0.0), ("/odom", ODOMETRY, 1.0, no_quaternion(1.0)[3])]
    text = refused(write_bag(tmp_path / "b", messages))
    assert "no topic of scan; record a sensor_msgs/LaserScan. Its topics: /odom (Odometry)" in text
