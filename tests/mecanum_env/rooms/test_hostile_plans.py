"""Plans that are made to do harm: images elsewhere, numbers that no building has, noise for walls."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from mecanum_env import rooms
from mecanum_env.env import ExploreEnv
from mecanum_env.rooms.floor_plan import FloorPlanError


def write_map(folder: Path, image: str = "plan.pgm", **values: object) -> Path:
    folder.mkdir(exist_ok=True)
    picture = np.zeros((60, 80), np.uint8)
    picture[5:-5, 5:-5] = 254
    cv2.imwrite(str(folder / "plan.pgm"), picture)
    keys = {
        "image": f'"{image}"',
        "resolution": 0.1,
        "origin": "[0, 0, 0]",
        "negate": 0,
        "free_thresh": 0.2,
    } | values
    (folder / "plan.yaml").write_text("".join(f"{key}: {value}\n" for key, value in keys.items()))
    return folder / "plan.yaml"


def refused(path: Path, words: str) -> None:
    with pytest.raises(FloorPlanError, match=words) as caught:
        rooms.load(path)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 700


def test_an_image_lies_beside_its_map(tmp_path: Path) -> None:
    other = write_map(tmp_path / "other").with_suffix(".pgm")
    path = write_map(tmp_path / "map")
    assert rooms.load(path).name == "plan"
    for image in (str(other), "../other/plan.pgm", "/etc/passwd", "/dev/zero", "a/../../other/plan.pgm"):
        said = f"outside of its folder; put it beside the map, and name it there by image: '{Path(image).name}'"
        refused(write_map(tmp_path / "map", image=image), said)
    link = tmp_path / "map" / "link.pgm"
    link.symlink_to(other)
    refused(write_map(tmp_path / "map", image="link.pgm"), "outside of its folder")
    # A map that is itself a link may lie beside its image, or where it is linked from.
    (tmp_path / "linked.yaml").symlink_to(path)
    write_map(tmp_path / "map")
    refused(tmp_path / "linked.yaml", "does not exist")
    (tmp_path / "map" / "below").mkdir()
    (tmp_path / "map" / "plan.pgm").rename(tmp_path / "map" / "below" / "plan.pgm")
    (tmp_path / "map" / "plan.yaml").write_text(path.read_text().replace("plan.pgm", "below/plan.pgm"))
    assert rooms.load(path).free.any()


def test_links_in_a_circle_and_pipes_are_no_images(tmp_path: Path) -> None:
    (tmp_path / "round.pgm").symlink_to("round.pgm")
    refused(write_map(tmp_path, image="round.pgm"), "leads nowhere|No such file")
    os.mkfifo(tmp_path / "pipe.pgm")
    refused(write_map(tmp_path, image="pipe.pgm"), "is not a file")
    refused(write_map(tmp_path, image="a" * 5000 + ".pgm"), "leads nowhere|File name too long")


@pytest.mark.parametrize("origin", ["[1e18, 0, 0]", "[0, -1e300, 0]"])
def test_an_origin_is_on_earth(origin: str, tmp_path: Path) -> None:
    refused(write_map(tmp_path, origin=origin), "origin must be")


def test_the_name_of_a_plan_that_is_not_there_is_written_out() -> None:
    with pytest.raises(ValueError, match=r"floor_plan a\\x00\\x1b\.png does not exist"):
        ExploreEnv(floor_plan="a\0\x1b.png")


def test_noise_is_no_plan(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 2, (400, 400)).astype(np.uint8) * 255
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    refused(tmp_path / "noise.png", "walls, more than 100000")


def test_a_plan_of_square_kilometres_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    env = ExploreEnv(floor_plan=write_map(tmp_path, resolution=10))
    with pytest.raises(FloorPlanError, match=r"800 m by 600 m, more than 30 million cells of 0\.05 m"):
        env.reset(seed=0)
