"""``mecanum replay`` of ROS 2 bags: the numbers of the log that they hold, and of episodes of our own."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from mecanum_env.config import LidarConfig, RobotConfig
from slam.logs import ScanLog, open_log, with_reference
from tests.slam.logs.scans_on_disk import carmen_lines, put_lines
from tests.slam.ros.bags_on_disk import recorded, write_bag
from tests.slam.written_files import read_tum
from tests.training.recorded_episode import explore
from tests.training.replay.test_replay import refused, replayed
from training.views.mcap_file import write_mcap

pytest.importorskip("rosbags")
pytest.importorskip("mcap")

SAME = (
    "ate_rmse_m", "ate_aligned_m", "final_position_error_m", "anees", "dead_reckoning_ate_m", "relations_trans_m",
    "relations_rot_rad", "landmarks", "samples", "steps", "scans", "duration_s",
)  # fmt: skip


@pytest.mark.parametrize("backend", ["ekf", "odometry"])
def test_a_bag_gives_the_numbers_of_its_log(
    backend: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = carmen_lines(60, kind="gfs2log")
    # A bag keeps ranges in single precision: so does this log.
    rounded = []
    for line in lines:
        words = line.split()
        if words[0] == "FLASER":
            words[2:182] = [repr(float(np.float32(word))) for word in words[2:182]]
        rounded.append(" ".join(words))
    log = put_lines(tmp_path / "room.log", rounded)
    true = put_lines(tmp_path / "true.log", carmen_lines(60, kind="corrected"))
    opened = with_reference(open_log(log), true)
    assert isinstance(opened, ScanLog)
    bag = write_bag(tmp_path / "bag", recorded(opened, reference="/truth"))
    direct = replayed(
        [str(log), "--reference", str(true), "--slam", backend, "--out", str(tmp_path / "a")], capsys
    )
    found = replayed(
        [str(bag), "--reference-topic", "/truth", "--slam", backend, "--out", str(tmp_path / "b")], capsys
    )
    for name in SAME:
        assert found[name] == pytest.approx(direct[name], rel=1e-3, abs=1e-6), name  # bearings, too, are single
    one, other = (read_tum(tmp_path / out / "trajectory_estimate.tum")[1] for out in "ab")
    assert np.allclose(one, other, atol=1e-6)
    run = tomllib.loads((tmp_path / "b" / "config.toml").read_text("utf-8"))["run"]
    assert run["reference_topic"] == "/truth"
    again = replayed(
        [str(bag), "--config", str(tmp_path / "b" / "config.toml"), "--out", str(tmp_path / "c")], capsys
    )
    assert again["ate_rmse_m"] == found["ate_rmse_m"]
    # One reference is meant; an option goes before what the configuration says.
    both = [str(bag), "--reference-topic", "/truth", "--reference", str(true), "--out", str(tmp_path / "e")]
    assert "are two references; give one of them" in refused(both, capsys)
    (tmp_path / "e.toml").write_text(f'[run]\nreference = "{tmp_path / "gone.log"}"\n')
    again = replayed([*both[:3], "--config", str(tmp_path / "e.toml"), *both[5:], "--slam", backend], capsys)
    assert again["note"] == found["note"]
    # As a reference for scans of the same stamps a CARMEN log is good, too.
    more = replayed([str(bag), "--reference", str(true), "--slam", backend, "--out", str(tmp_path / "d")], capsys)
    assert more["ate_rmse_m"] == pytest.approx(direct["ate_rmse_m"], rel=1e-5)


def test_an_episode_of_ours_is_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = explore().recording
    path = tmp_path / "episode.mcap"
    write_mcap(recording, path, robot=RobotConfig(), lidar=LidarConfig())
    argv = [
        str(path),
        "--reference-topic",
        "/ground_truth",
        "--slam",
        "invariant-ekf",
        "--out",
        str(tmp_path / "out"),
    ]
    found = replayed(argv, capsys)
    assert found["scans"] == len(list(recording.scans.items())) and found["ate_rmse_m"] < 0.03
    assert found["dead_reckoning_ate_m"] > found["ate_rmse_m"]
    log = open_log(path)
    assert isinstance(log, ScanLog) and log.settings["lidar_offset_m"] == pytest.approx(0.2)
    for (step, ranges), seen in zip(recording.scans.items(), log.ranges, strict=True):
        assert np.array_equal(np.asarray(ranges, np.float32), seen, equal_nan=True), step


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bag.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert "is damaged" in refused([str(tmp_path / "bag.mcap"), "--out", str(tmp_path / "out")], capsys)
    log = put_lines(tmp_path / "a.log", carmen_lines(5))
    assert "leave --scan-topic" in refused([str(log), "--scan-topic", "/scan"], capsys)
    assert "is not X,Y,DEG" in refused([str(log), "--mount", "here"], capsys)
    assert not (tmp_path / "out").exists()
