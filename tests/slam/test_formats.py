from __future__ import annotations

import math
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from slam.formats import atomic_write, replacing, write_map_server, write_tum
from slam.geometry import wrap
from slam.grids.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.slam.written_files import read_map_server, read_tum

CLASSES = np.array([[FREE, FREE, OCCUPIED], [UNKNOWN, FREE, UNKNOWN]], np.int8)


def grid(classes: np.ndarray = CLASSES) -> OccupancyGrid:
    return OccupancyGrid.from_classes(classes, 0.05, (-1.25, 2.5))


# --- atomic writing


def test_atomic_write_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    atomic_write(path, "old, longer\n")
    atomic_write(path, "ü\n")
    assert path.read_bytes() == "ü\n".encode()
    atomic_write(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_keeps_the_old_file_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    atomic_write(path, "old")
    with pytest.raises(RuntimeError, match="midway"), replacing(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".png")
        temporary.write_text("half")
        raise RuntimeError("midway")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_written_files_are_as_readable_as_any_other(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    atomic_write(tmp_path / "atomic", "")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_missing_folder_is_named_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="create it first"), replacing(tmp_path / "none" / "a"):
        pytest.fail("the block must not run")


# --- ROS map_server


def test_map_server_files_are_what_ros_writes(tmp_path: Path) -> None:
    written = grid()
    image, description = write_map_server(tmp_path / "run.1", written)
    assert (image.name, description.name) == ("run.1.pgm", "run.1.yaml")
    pixels = cv2.imread(str(image), cv2.IMREAD_UNCHANGED)
    assert pixels.shape == written.shape
    row, col = written.to_cells(np.array([[-1.225, 2.525]]))[0]  # of the cell at the lower left of CLASSES
    bottom = written.shape[0] - row  # the image's first row is the highest y
    np.testing.assert_array_equal(pixels[bottom - 2 : bottom, col : col + 3], [[205, 254, 205], [254, 254, 0]])
    assert np.count_nonzero(pixels != 205) == 4
    assert yaml.safe_load(description.read_text()) == {
        "image": "run.1.pgm",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [*written.origin, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }


@given(hnp.arrays(np.int8, hnp.array_shapes(min_dims=2, max_dims=2), elements=st.sampled_from([-1, 0, 100])))
@settings(deadline=None, max_examples=50)
def test_map_server_round_trip(classes: np.ndarray) -> None:
    written = grid(classes)
    with tempfile.TemporaryDirectory() as folder:
        _, description = write_map_server(Path(folder) / "map", written)
        read, resolution, origin = read_map_server(description)
    assert read.dtype == np.int8
    np.testing.assert_array_equal(read, written.classes())
    assert (resolution, *origin) == (written.resolution, *written.origin)


# --- TUM trajectories


def test_tum_lines(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    write_tum(path, [0.0, 0.1], [[1.0, -2.0, 0.0], [0.5, 0.25, math.pi / 2]])
    half = math.sqrt(0.5)
    assert path.read_text().splitlines() == [
        "0.000000 1.000000000 -2.000000000 0 0 0 0.000000000000 1.000000000000",
        f"0.100000 0.500000000 0.250000000 0 0 0 {half:.12f} {half:.12f}",
    ]


@given(
    hnp.arrays(
        np.float64,
        st.tuples(st.integers(0, 8), st.just(4)),
        elements=st.floats(-1e4, 1e4),
    )
)
@settings(deadline=None, max_examples=50)
def test_tum_round_trip(rows: np.ndarray) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.tum"
        write_tum(path, rows[:, 0], rows[:, 1:])
        times, poses = read_tum(path)
    np.testing.assert_allclose(times, rows[:, 0], atol=5.1e-7, rtol=0)
    assert poses.shape == (len(rows), 3)
    np.testing.assert_allclose(poses[:, :2], rows[:, 1:3], atol=5.1e-10, rtol=0)
    np.testing.assert_allclose(wrap(poses[:, 2] - rows[:, 3]), 0.0, atol=1e-10)


def test_tum_refuses_what_no_trajectory_is(tmp_path: Path) -> None:
    for times, poses in (([0.0], np.zeros((2, 3))), ([0.0], np.zeros((1, 2))), ([0.0], [[np.nan, 0.0, 0.0]])):
        with pytest.raises(ValueError, match="trajectory"):
            write_tum(tmp_path / "a.tum", times, poses)
    assert list(tmp_path.iterdir()) == []
