"""Plans from files: walls true to the raster, starts in the open, and every way in which a file can be bad."""

from __future__ import annotations

import os
import struct
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from mecanum_env import rooms
from mecanum_env.rooms.files.importers import from_raster
from mecanum_env.rooms.floor_plan import FloorPlanError
from mecanum_env.rooms.outlines.outline import outline_segments, trace
from mecanum_env.rooms.outlines.rectilinear import surfaces

DATA = Path(os.environ.get("MECANUM_DATA", Path(__file__).parents[4] / "shared" / "data"))


def data_file(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"real data absent: {path} (set MECANUM_DATA to the folder that holds it)")
    return path


def dense(segments, step=0.1):
    """Points along segments, end points included."""
    a, d = segments[:, :2], segments[:, 2:] - segments[:, :2]
    counts = np.ceil(np.hypot(*d.T) / step).astype(int) + 1
    which = np.repeat(np.arange(len(segments)), counts)
    k = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return a[which] + (k / np.maximum(counts - 1, 1)[which])[:, None] * d[which]


def distance(points, segments):
    """Distance of each point to the nearest segment, in batches."""
    a, d = segments[:, :2], segments[:, 2:] - segments[:, :2]
    squared = (d**2).sum(axis=1)
    out = []
    for part in np.array_split(points, max(1, len(points) * len(segments) // 2_000_000)):
        o = part[:, None] - a
        share = np.clip((o * d).sum(axis=2) / squared, 0, 1)
        out.append(np.hypot(*np.moveaxis(o - share[..., None] * d, 2, 0)).min(axis=1))
    return np.concatenate(out)


def near(points, segments):
    """The largest distance of points to segments, by points 0.05 apart along them: at 0.5 it errs by 6e-4."""
    return cKDTree(dense(segments, 0.05)).query(points)[0].max()


def cell_edges(free):
    """The edges between free and other cells, one by one, without the code under test."""
    padded = np.pad(free, 1)
    rows, cols = np.nonzero(padded[1:] != padded[:-1])
    level = np.stack([cols, rows + 1, cols + 1, rows + 1], axis=1)
    rows, cols = np.nonzero(padded[:, 1:] != padded[:, :-1])
    upright = np.stack([cols + 1, rows, cols + 1, rows + 1], axis=1)
    return np.vstack([level, upright]).astype(float) - 1.0


def hausdorff(free, walls_in_cells):
    """The largest distance from a surface to a cell edge, and from a cell edge to a surface [cells]."""
    edges = cell_edges(free)
    return distance(dense(walls_in_cells), edges).max(), distance(dense(edges, 0.5), walls_in_cells).max()


rasters = arrays(np.bool_, st.tuples(st.integers(1, 14), st.integers(1, 14))).filter(np.any)


@given(rasters)
def test_walls_are_within_half_a_cell_of_the_edges_both_ways(free):
    there, back = hausdorff(free, outline_segments(free))
    assert there <= 0.5 + 1e-6
    assert back <= 0.5 + 1e-6


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.floats(0.8, 3.0), st.floats(0.35, 0.65))
def test_smooth_shapes_stay_within_half_a_cell_too(seed, blur, level):
    """Blobs have the slants and arcs that noise lacks."""
    noise = np.random.default_rng(seed).random((24, 30)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur)
    free = smooth > np.quantile(smooth, level)
    there, back = hausdorff(free, outline_segments(free))
    assert max(there, back) <= 0.5 + 1e-6


@given(rasters)
def test_walls_are_closed_and_have_length(free):
    walls = outline_segments(free)
    assert np.all(np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > 0)
    # As many walls leave each point as come to it.
    starts, ends = (sorted(map(tuple, np.round(part, 9))) for part in (walls[:, :2], walls[:, 2:]))
    assert starts == ends


@given(rasters)
def test_the_exact_outline_is_every_edge_once_with_free_space_on_the_left(free):
    walls = outline_segments(free, simplify=False)
    corners, first = trace(free)
    assert len(walls) == len(corners) == first[-1]
    edges = []
    padded = np.pad(free, 2)
    for x1, y1, x2, y2 in walls.astype(int):
        d = np.array([np.sign(x2 - x1), np.sign(y2 - y1)])
        for k in range(abs(x2 - x1) + abs(y2 - y1)):
            a = np.array([x1, y1]) + k * d
            left = np.floor(a + 0.5 * d + 0.5 * np.array([-d[1], d[0]])).astype(int) + 2
            right = np.floor(a + 0.5 * d - 0.5 * np.array([-d[1], d[0]])).astype(int) + 2
            assert padded[left[1], left[0]] and not padded[right[1], right[0]]
            edges.append((*np.minimum(a, a + d), *np.maximum(a, a + d)))
    assert sorted(edges) == sorted(map(tuple, cell_edges(free).astype(int)))


def test_rectangles_come_out_exact():
    free = np.zeros((30, 40), bool)
    free[3:12, 5:30] = True
    free[8:25, 20:28] = True
    expected = surfaces(np.array([(5, 3, 30, 12), (20, 8, 28, 25)], float))
    assert sorted(map(tuple, outline_segments(free))) == sorted(map(tuple, expected))


def test_slants_become_straight():
    row, col = np.mgrid[0:60, 0:60]
    for free, most in [(row > col, 6), (2 * row > col + 20, 6)]:
        assert len(outline_segments(free)) <= most
        assert len(outline_segments(free, simplify=False)) > 40
    disc = (row - 30) ** 2 + (col - 30) ** 2 < 25**2
    assert len(outline_segments(disc)) < 0.4 * len(outline_segments(disc, simplify=False))


@pytest.mark.parametrize("slanting", [False, True])
def test_a_wall_one_pixel_thick_survives_with_two_surfaces_and_shuts(slanting):
    free = np.ones((40, 40), bool)
    free[np.arange(40), np.arange(40) if slanting else 20] = False
    walls = outline_segments(free)
    across = np.array([[5.0, 35.0, 35.0, 5.0]]) if slanting else np.array([[5.0, 10.2, 35.0, 10.2]])
    (x1, y1, x2, y2), hits = across[0], 0
    for a, b, c, d in walls:
        s = (x2 - x1) * (d - b) - (y2 - y1) * (c - a)
        if s:
            t, u = (
                ((a - x1) * (d - b) - (b - y1) * (c - a)) / s,
                ((a - x1) * (y2 - y1) - (b - y1) * (x2 - x1)) / s,
            )
            hits += 0 <= t <= 1 and 0 <= u < 1
    assert hits == 2
    assert len(walls) <= 12


@pytest.mark.parametrize("name", ["kth_50052752", "kth_50052750"])
def test_real_floors_keep_all_their_walls(name):
    path = data_file(f"floorplans/{name}.yaml")
    plan = rooms.load(path)
    begin = time.perf_counter()
    plan = rooms.load(path)
    assert time.perf_counter() - begin < 0.5
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


def test_negate_mode_and_thresholds(tmp_path):
    assert np.array_equal(rooms.load(write_map(tmp_path, 255 - picture(), negate=1)).free, picture()[::-1] == 254)
    loose = rooms.load(write_map(tmp_path, free_thresh=0.25))
    assert loose.free[60 - 32, 42]
    raw = np.where(picture() == 254, 0, np.where(picture() == 205, 255, 100)).astype(np.uint8)
    assert np.array_equal(rooms.load(write_map(tmp_path, raw, mode="raw")).free, picture()[::-1] == 254)


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
