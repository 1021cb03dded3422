"""Plans from files: walls true to the raster, starts in the open, and every way in which a file can be bad."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mecanum_env import ExploreEnv, rooms
from mecanum_env.rooms.files.importers import from_raster
from mecanum_env.rooms.floor_plan import FloorPlanError
from mecanum_env.rooms.outlines.outline import outline_segments
from tests.mecanum_env.rooms.outlines.test_outline import cell_edges, dense, near, rasters

DATA = Path(os.environ.get("MECANUM_DATA", Path(__file__).parents[5] / "shared" / "data"))


def data_file(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"real data absent: {path} (set MECANUM_DATA to the folder that holds it)")
    return path


@pytest.mark.parametrize("name", ["kth_50052752", "kth_50052750"])
def test_real_floors_keep_all_their_walls(name):
    path = data_file(f"floorplans/{name}.yaml")
    plan = rooms.load(path)
    image = cv2.imread(str(path.with_suffix(".pgm")), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(plan.free, image[::-1] == 254)
    walls = plan.walls / plan.resolution
    exact = outline_segments(plan.free, simplify=False)
    # All walls: the exact outline is as long as there are cell edges, and lies on them.
    edges = cell_edges(plan.free)
    assert np.hypot(*(exact[:, 2:] - exact[:, :2]).T).sum() == pytest.approx(len(edges))
    assert near(edges[:, :2], exact) < 1e-9
    assert max(near(dense(walls), exact), near(dense(exact), walls)) <= 0.5 + 1e-3
    assert plan.distance_to_surfaces(np.array([plan.start[:2]]))[0] >= 0.6


def test_dungeons_are_read_as_plain_images():
    path = data_file("dungeons/1.png")
    plan = rooms.load(path, resolution=0.2, seed=3)
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(plan.free, image[::-1] > 150)
    assert plan.bounds == pytest.approx((5.0, 5.0, 95.0, 95.0), abs=5.0)
    exact = outline_segments(plan.free, simplify=False)
    assert max(near(dense(plan.walls / 0.2), exact), near(dense(exact), plan.walls / 0.2)) < 0.026


# --- files written by the test ---------------------------------------------------------------------------------


def picture(height=60, width=80):
    """A room with a bright corner mark: the free pixel outside it at the top left tells rows and columns apart."""
    image = np.zeros((height, width), np.uint8)
    image[10:-10, 10:-10] = 254
    image[2, 3] = 254
    image[30:34, 40:44] = 205
    return image


def write_map(folder, pixels=None, suffix=".pgm", **keys):
    cv2.imwrite(str(folder / f"floor{suffix}"), picture() if pixels is None else pixels)
    values = {
        "image": f"floor{suffix}",
        "resolution": 0.05,
        "origin": "[-1.0, 2.0, 0.0]",
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    } | keys
    path = folder / "floor.yaml"
    path.write_text("".join(f"{k}: {v}\n" for k, v in values.items() if v is not None))
    return path


@pytest.mark.parametrize("suffix", [".pgm", ".png", ".bmp"])
def test_a_ros_map_has_its_lower_left_pixel_at_the_origin(tmp_path, suffix):
    plan = rooms.load(write_map(tmp_path, suffix=suffix))
    assert plan.free.shape == (60, 80)
    assert plan.free[57, 3] and not plan.free[2, 3]
    assert plan.bounds == pytest.approx((-1.0 + 3 * 0.05, 2.0 + 10 * 0.05, -1.0 + 70 * 0.05, 2.0 + 58 * 0.05))
    assert not plan.free[60 - 32, 42], "unknown counts as solid"
    assert plan.start[2] == 0.0
    assert plan.distance_to_surfaces(np.array([plan.start[:2]]))[0] >= 0.6


def test_a_start_is_drawn_where_the_robot_fits_turned_any_way(tmp_path):
    free = np.zeros((400, 600), np.uint8)
    free[20:-20, 20:-20] = 254
    path = write_map(tmp_path, free)
    for seed in range(20):
        plan = rooms.load(path, seed=seed, roomy_m=1.5)
        assert plan.distance_to_surfaces(np.array([plan.start[:2]]))[0] >= 1.5
    env = ExploreEnv(floor_plan=path, robot={"length_m": 1.6, "width_m": 1.2, "wheel_radius_m": 0.1})
    for seed in range(40):
        env.reset(seed=seed)


def test_negate_mode_and_thresholds(tmp_path):
    assert np.array_equal(rooms.load(write_map(tmp_path, 255 - picture(), negate=1)).free, picture()[::-1] == 254)
    loose = rooms.load(write_map(tmp_path, free_thresh=0.25))
    assert loose.free[60 - 32, 42]
    raw = np.where(picture() == 254, 0, np.where(picture() == 205, 255, 100)).astype(np.uint8)
    assert np.array_equal(rooms.load(write_map(tmp_path, raw, mode="raw")).free, picture()[::-1] == 254)


def test_numbers_without_a_point_are_numbers(tmp_path):
    """ROS 2's map_saver writes what is near 0 so; to PyYAML it is a word."""
    plan = rooms.load(write_map(tmp_path, resolution="5e-2", origin="[-1e-05, 2e+00, -0]"))
    assert plan.resolution == 0.05 and plan.origin == (-1e-05, 2.0)
    refuse(write_map(tmp_path, resolution="nan"), "resolution must be above 0")
    refuse(write_map(tmp_path, origin="[inf, 0, 0]"), "origin must be")
    refuse(write_map(tmp_path, resolution="five"), "resolution must be above 0")


def test_images_of_all_kinds_are_read_alike(tmp_path):
    image = np.where(picture() == 254, 255, 0).astype(np.uint8)
    expected = image[::-1] > 127
    colour, clear = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.full((60, 80, 4), 255, np.uint8)
    clear[..., 3] = image
    for name, pixels in [
        ("a.png", image),
        ("b.bmp", colour),
        ("c.png", clear),
        ("d.png", image.astype(np.uint16) * 257),
    ]:
        cv2.imwrite(str(tmp_path / name), pixels)
        assert np.array_equal(rooms.load(tmp_path / name).free, expected), name
    keyed = Image.fromarray(image.astype(np.uint16) * 257)
    keyed.save(tmp_path / "keyed.png", transparency=65535)
    with pytest.raises(FloorPlanError, match="no free space"):
        rooms.load(tmp_path / "keyed.png")
    turned = Image.fromarray(np.rot90(image))
    exif = turned.getexif()
    exif[274] = 6  # shown turned by a quarter, clockwise
    turned.save(tmp_path / "turned.jpg", exif=exif, quality=100)
    assert np.array_equal(rooms.load(tmp_path / "turned.jpg").free, expected)
    block = np.zeros((64, 64), np.uint8)
    block[16:48, 16:48] = 255
    cv2.imwrite(str(tmp_path / "e.jpg"), block, [cv2.IMWRITE_JPEG_QUALITY, 100])
    assert np.array_equal(rooms.load(tmp_path / "e.jpg").free, block[::-1] > 127)
    text = "P2\n# a comment\n80 60\n# another\n7\n" + "\n".join(
        " ".join("7" if v else "0" for v in row) for row in image
    )
    (tmp_path / "f.pgm").write_text(text)
    assert np.array_equal(rooms.load(tmp_path / "f.pgm").free, expected)
    (tmp_path / "g.pgm").write_bytes(b"P5 80 60 65535\n" + (image.astype(">u2") * 257).tobytes())
    assert np.array_equal(rooms.load(tmp_path / "g.pgm").free, expected)
    # Scaled by the largest value; what is above it counts as that.
    (tmp_path / "h.pgm").write_bytes(b"P5 80 60 15\n" + (image // 255 * 200).tobytes())
    assert np.array_equal(rooms.load(tmp_path / "h.pgm").free, expected)


def test_resolution_of_an_image(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    assert rooms.load(tmp_path / "a.png").resolution == 0.05
    assert rooms.load(tmp_path / "a.png", resolution=0.1).bounds[2] == pytest.approx(7.0)


def test_the_start_is_in_the_largest_area_and_follows_the_seed():
    free = np.zeros((60, 160), bool)
    free[5:55, 5:60] = True
    free[5:55, 70:155] = True
    starts = {from_raster(free, name="two", resolution=0.05, seed=s).start for s in range(20)}
    assert len(starts) > 10
    assert all(x > 3.5 for x, _, _ in starts)
    again = from_raster(free, name="two", resolution=0.05, seed=7).start
    assert again == from_raster(free, name="two", resolution=0.05, seed=7).start


@given(rasters, st.integers(0, 100))
def test_any_free_cell_is_enough_for_a_start(free, seed):
    plan = from_raster(free, name="any", resolution=0.05, seed=seed)
    assert plan.is_free(np.array([plan.start[:2]]))[0]


def test_a_given_start_is_checked(tmp_path):
    path = write_map(tmp_path)
    assert rooms.load(path, start=(0.5, 3.0, 1.2)).start == (0.5, 3.0, 1.2)
    for bad, words in [
        ((-0.9, 2.1, 0.0), "not in free space; choose a free point"),
        ((99.0, 0.0, 0.0), "not in free space"),
        ((np.nan, 0.0, 0.0), "finite"),
        ((1.0, 2.0), "three numbers"),
        ("abc", "three numbers"),
    ]:
        refuse(path, words, start=bad)


def refuse(path, words, **options):
    with pytest.raises(FloorPlanError, match=words) as caught:
        rooms.load(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def png_header(width, height):
    """A PNG that claims a size and has a few bytes of pixels."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(bytes(100)))
        + chunk(b"IEND", b"")
    )


def bmp_header(width, height):
    """A BMP of 24 bits a pixel that claims a size and has a few bytes of pixels."""
    return b"BM" + struct.pack("<IIIIiiHHIIiiII", 94, 0, 54, 40, width, height, 1, 24, *(0,) * 6) + bytes(40)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "damaged"),
        (b"hello", "damaged"),
        (png_header(100, 100)[:60], "damaged"),
        (png_header(100, 100)[:-20] + b"x" * 20, "damaged"),
        (png_header(20_000, 100), "too large"),
        (png_header(9_000, 9_000), "too large"),
        (png_header(2**31, 2**31), "too large"),
        (png_header(0, 10), "damaged"),
        (b"P5 99999 99999 255\n", "too large"),
        (b"P5 100 100 255\n" + bytes(9_999), "damaged"),
        (b"P5 100", "damaged"),
        (b"P5 10 10 0\n" + bytes(100), "damaged"),
        (b"P2 3 1 9\n1 x 3", "damaged"),
        (b"P2 3 1 9\n1 nan 3", "damaged"),
        (b"P2 9 1 9\n1 2 3 4  5                 ", "damaged"),
        (bmp_header(10, 10), "damaged"),
        (bmp_header(30_000, 10), "too large"),
        (b"\xff\xd8\xff\xe0", "damaged"),
        (b"\xff\xd8\xff\xc0\x00\x0b\x08\xff\xff\xff\xff\x01\x01\x11\x00\xff\xd9", "too large"),
        (b"\xff\xd8" + b"\xff" * 50 + b"\xff\xd9", "damaged"),
    ],
)
def test_a_damaged_or_huge_image_is_refused(tmp_path, data, words):
    path = tmp_path / "bad.png"
    path.write_bytes(data)
    assert str(path) in refuse(path, words)


def test_a_truncated_jpeg_and_a_flipped_png_byte_are_noticed(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), picture())
    whole = (tmp_path / "a.jpg").read_bytes()
    (tmp_path / "a.jpg").write_bytes(whole[: len(whole) // 2])
    refuse(tmp_path / "a.jpg", "damaged")
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    whole = bytearray((tmp_path / "a.png").read_bytes())
    whole[len(whole) // 2] ^= 0x55
    (tmp_path / "a.png").write_bytes(bytes(whole))
    refuse(tmp_path / "a.png", "damaged")


@settings(max_examples=40)
@given(st.data())
def test_a_flipped_bit_anywhere_gives_a_plan_or_one_line(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("fuzz")
    suffix = data.draw(st.sampled_from([".pgm", ".png", ".bmp", ".jpg"]))
    cv2.imwrite(str(folder / f"a{suffix}"), picture())
    whole = bytearray((folder / f"a{suffix}").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        # Mostly in the header, where the harm is.
        at = data.draw(st.one_of(st.integers(0, min(60, len(whole) - 1)), st.integers(0, len(whole) - 1)))
        whole[at] = data.draw(st.integers(0, 255))
    (folder / f"a{suffix}").write_bytes(bytes(whole))
    try:
        rooms.load(folder / f"a{suffix}")
    except FloorPlanError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"image": "gone.pgm"}, "gone.pgm does not exist"),
        ({"image": None}, "image must name a file"),
        ({"image": "[1, 2]"}, "image must name a file"),
        ({"image": "."}, "is not a file"),
        ({"resolution": None}, "resolution must be above 0"),
        ({"resolution": 0}, "resolution must be above 0"),
        ({"resolution": -0.05}, "resolution must be above 0"),
        ({"resolution": ".nan"}, "resolution must be above 0"),
        ({"resolution": ".inf"}, "resolution must be above 0"),
        ({"resolution": 10.5}, "resolution must be above 0"),
        ({"resolution": "five"}, "resolution must be above 0"),
        ({"resolution": "true"}, "resolution must be above 0"),
        ({"origin": None}, "origin must be"),
        ({"origin": "[0, 0, 0.5]"}, "yaw must be 0"),
        ({"origin": "[0, .nan, 0]"}, "origin must be"),
        ({"origin": "[0, 1e999, 0]"}, "origin must be"),
        ({"negate": 2}, "negate must be 0 or 1"),
        ({"negate": "[]"}, "negate must be 0 or 1"),
        ({"mode": "fancy"}, "unknown mode 'fancy'; valid: trinary, scale, raw"),
        ({"mode": "[a]"}, "unknown mode"),
        ({"free_thresh": 1.5}, "free_thresh must be between 0 and 1"),
        ({"occupied_thresh": "x"}, "occupied_thresh must be between 0 and 1"),
        ({"free_thresh": 0.0}, "no free space"),
        ({"image": "!!python/object/apply:os.getcwd []"}, "damaged: not YAML"),
        ({"image": "'unclosed"}, "damaged: not YAML"),
    ],
)
def test_a_bad_map_is_refused(tmp_path, keys, words):
    assert str(tmp_path) in refuse(write_map(tmp_path, **keys), words)


@pytest.mark.parametrize(
    "data", [b"\xff\xfe\x00", b"- a\n- b\n", b"", b"[" * 50_000, b"a: &a [*a]\n\x00", b"just text"]
)
def test_what_is_no_map_is_refused(tmp_path, data):
    path = tmp_path / "bad.yaml"
    path.write_bytes(data)
    refuse(path, "damaged|too large")


def test_missing_files_unknown_suffixes_and_resolutions(tmp_path):
    refuse(tmp_path / "gone.yaml", "does not exist; check the path")
    refuse(tmp_path / "gone.png", "does not exist; check the path")
    refuse(tmp_path / "plan.dwg", r"unknown suffix '.dwg'; valid: .yaml, .yml, .png")
    (tmp_path / "dir.png").mkdir()
    refuse(tmp_path / "dir.png", "not a file")
    refuse(write_map(tmp_path), "says its own resolution", resolution=0.1)
    cv2.imwrite(str(tmp_path / "a.png"), picture())
    for bad in (0.0, -1.0, float("nan"), 11.0, "x", True):
        refuse(tmp_path / "a.png", "resolution must be above 0", resolution=bad)
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((20, 20), np.uint8))
    refuse(tmp_path / "black.png", "no free space")
