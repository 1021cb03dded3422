"""``mecanum complexity``: a map of the size asked for, times that are times, points that are kept."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import slam
from tests.training.cli.test_bad_input import refused
from training.cli import main
from training.studies.costs import complexity


@pytest.mark.parametrize("count", [10, 25, 60])
def test_the_map_has_every_landmark_and_the_robot_sees_ten_nearby(count: int) -> None:
    world = complexity._landmarks(count)
    assert world.shape == (count, 2)
    drive = complexity._record(world, 40)
    assert all(len(observations.range_bearing) == complexity.SEEN for _, observations, _ in drive)
    backend = slam.make("ekf", config={"lidar_offset_m": 0.0})
    complexity._map_everything(backend, world, drive[0][2])
    assert backend.landmark_count == count
    for odometry, observations, _ in drive:
        backend.predict(odometry)
        backend.observe(observations)
    assert backend.landmark_count == count  # ten known ones a step, none new
    assert np.hypot(*(backend.pose - drive[-1][2])[:2]) < 0.2


def test_the_density_does_not_depend_on_the_number() -> None:
    def reach(count: int) -> float:
        world = complexity._landmarks(count)
        return float(np.mean([o.range_bearing[:, 0].max() for _, o, _ in complexity._record(world, 200)]))

    assert reach(800) == pytest.approx(reach(100), rel=0.2)


def test_a_power_law_comes_back() -> None:
    sizes = [25, 50, 100]
    assert complexity.exponent(sizes, [3.0 * n**1.7 for n in sizes]) == pytest.approx(1.7)
    assert complexity.exponent([25], [1.0]) is None


def test_json_keys_and_files_and_going_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = ["complexity", "--slam", "ekf", "--steps", "10", "--out", str(tmp_path), "--json"]
    assert main([*argv, "--landmarks", "25,12"]) == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert set(result) == {"ekf", complexity.REFERENCE, "config"}
    for name in ("ekf", complexity.REFERENCE):
        assert [row["landmarks"] for row in result[name]["times"]] == [12, 25]
        assert all(0.1 < row["us_per_step"] < 1e6 for row in result[name]["times"])
        assert isinstance(result[name]["exponent"], float)
    row = result["ekf"]["times"][0]
    assert 0 < row["us_correction"] < row["us_per_step"] and 0 < row["us_predict"] < row["us_per_step"]
    assert json.loads((tmp_path / "complexity.json").read_text("utf-8")) == result
    assert cv2.imread(str(tmp_path / "complexity.png")) is not None

    def again(job: complexity.Job) -> complexity.Point:
        raise AssertionError(f"{job} is there already")

    monkeypatch.setattr(complexity, "run_job", again)
    assert main([*argv, "--landmarks", "12"]) == 0
    one = json.loads(capsys.readouterr().out)
    assert one["ekf"]["times"] == [row] and one["ekf"]["exponent"] is None
    assert "holds runs with steps = 10, not 11" in refused([*argv, "--steps", "11"], capsys)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--slam", "efk"], ["unknown SLAM backend 'efk'", "did you mean 'ekf'?"]),
        (["--landmarks", "a"], ["--landmarks 'a'", "10,11"]),
        (["--landmarks", ""], ["--landmarks ''", "10,11"]),
        (["--landmarks", "25,-3"], ["--landmarks", "10,11"]),
        (["--landmarks", "9"], ["10 … 2000"]),
        (["--landmarks", "25,99999999999"], ["10 … 2000"]),
        (["--steps", "1"], ["--steps", "10"]),
    ],
)
def test_bad_input(argv: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(["complexity", "--out", str(tmp_path / "out"), *argv], capsys)
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


def test_an_out_that_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    assert "is not a folder" in refused(["complexity", "--out", str(tmp_path / "file")], capsys)
