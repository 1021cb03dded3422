"""Plans, configurations and policies that are made to do harm."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray
from PIL import Image, PngImagePlugin

from training.studies.reliability.files import samples
from training.studies.reliability.files.samples import Files, Hostile, Link, Pipe, as_json, one

__all__ = ["CONFIGS", "IMAGES", "MAPS", "POLICIES"]

_DEEP = 100_000


# ---- ROS maps --------------------------------------------------------------------------------------------------


def _map(**values: object) -> Callable[[], Files]:
    """Return a map's description with some of its values replaced, as they stand in YAML; None: left out."""
    sound: dict[str, object] = {
        "image": "plan.pgm", "mode": "trinary", "resolution": 0.1, "origin": "[-2.0, -1.0, 0.0]", "negate": 0,
        "occupied_thresh": 0.65, "free_thresh": 0.196,
    }  # fmt: skip
    lines = [f"{key}: {value}" for key, value in (sound | values).items() if value is not None]
    return lambda: {"plan.yaml": "\n".join(lines).encode()}


_yaml = partial(one, "plan.yaml")
_pgm = partial(one, "plan.pgm")


def _laughs() -> Files:
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    return {"plan.yaml": "\n".join([*lines, "image: *a11", "resolution: *a11", "origin: *a11"]).encode()}


MAPS: Hostile = {
    "an image of 10⁹ pixels": _pgm(b"P5\n40000 25000\n255\n" + bytes(1000)),
    "an image of 10¹⁸ pixels": _pgm(b"P5\n1000000000 1000000000\n255\n"),
    "an image of -1 pixels": _pgm(b"P5\n-1 -1\n255\n"),
    "an image in words that claims 10⁹ pixels": _pgm(b"P2\n40000 25000\n255\n0 0 0\n"),
    "an image of no pixel": _pgm(b"P5\n0 0\n255\n"),
    "an image of one pixel": _pgm(b"P5\n1 1\n255\n\xff"),
    "an image without end of header": _pgm(b"P5\n" + b"#" * 10_000_000),
    "billion laughs": _laughs,
    "a tag that runs code": _map(image="!!python/object/apply:os.system ['true']"),
    "a tag of a module": _yaml("!!python/module:os {}"),
    "a binary tag": _map(image="!!binary AAAA"),
    "deep lists": _yaml("image: " + "[" * _DEEP),
    "deep mappings": _yaml("{a: " * _DEEP),
    "deep dashes": _yaml("- " * _DEEP),
    "many merges": _yaml("a: &a {image: x}\n" + "b: {<<: [" + ", ".join(["*a"] * 20_000) + "]}\n"),
    "a megabyte of anchors": _yaml("".join(f"k{k}: &x{k} 1\n" for k in range(60_000))),
    "two megabytes": _yaml("#" * 2_100_000),
    "a cycle": _yaml("a: &a [*a]\nimage: *a"),
    "a cycle of keys": _yaml("&a {*a : 1}"),
    "a list as key": _yaml("? [a, b]\n: c"),
    "UTF-16": _yaml("image: plan.pgm\n".encode("utf-16")),
    "a null byte": _yaml("image: \0"),
    "a date": _map(resolution="2026-01-01", origin="2026-01-01"),
    "base sixty": _map(resolution="190:20:30"),
    "an integer of 5000 digits": _map(resolution="9" * 5000),
    "an image outside": _map(image="/etc/passwd"),
    "an endless device": _map(image="/dev/zero"),
    "an image above": _map(image="../given/../../plan.pgm"),
    "an image that a link leads out to": lambda: {**_map(image="link.pgm")(), "plan.pgm": Link("/etc/passwd")},
    "a link out of the folder": _pgm(Link("/etc/hostname")),
    "a folder that is a link": lambda: {**_map(image="away/passwd.pgm")(), "plan.pgm": Link("/etc")},
    "a link to itself": _pgm(Link("plan.pgm")),
    "a description that links to itself": _yaml(Link("plan.yaml")),
    "a pipe as image": _pgm(Pipe()),
    "a pipe as description": _yaml(Pipe()),
    "itself as image": _map(image="plan.yaml"),
    "a name of 5000 characters": _map(image="a" * 5000 + ".pgm"),
    "a name with a line break": _map(image='"a\\nb\\x1b[31m.pgm"'),
    **{f"a resolution of {value}": _map(resolution=value)
       for value in (".nan", ".inf", "1e308", "1e-308", "-1", "0", "true", "null", "[1]", "1e-300", "10", "1e-9")},
    **{f"an origin of {value}": _map(origin=value)
       for value in ("[.nan, 0, 0]", "[1e308, -1e308, 0]", "[1e18, 0, 0]", "[]", "[[1], 2, 3]", "{}", "abc",
                     "[0, 0, 1]", "[1e5, 1e5, 0]")},
    **{f"a threshold of {value}": _map(free_thresh=value) for value in (".nan", "2", "-1", "[]", "1", "0")},
    **{f"negate {value}": _map(negate=value) for value in ("2", "[]", "yes", "1.0")},
    **{f"mode {value}": _map(mode=value) for value in ("raw", "[]", "scale", "1")},
    **{f"{text!r}": _yaml(text) for text in (
        "", "[]", "abc", "1", "---\n---\n", "%YAML 9.9\n---\na: 1", "\ufeff", "*a",
    )},
}  # fmt: skip


# ---- images ----------------------------------------------------------------------------------------------------


def _png(width: int, height: int, *, data: bytes = b"", more: bytes = b"", kind: int = 0) -> bytes:
    """Return a PNG that claims a size, with chunks between its header and its data."""
    header = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0))
    body = _chunk(b"IDAT", zlib.compress(data, 9))
    return b"\x89PNG\r\n\x1a\n" + header + more + body + _chunk(b"IEND", b"")


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def _encoded(array: NDArray[np.uint8], suffix: str) -> Callable[[], Files]:
    return lambda: {f"hostile.{suffix}": _bytes_of(array, suffix)}


def _bytes_of(array: NDArray[np.uint8], kind: str) -> bytes:
    out = io.BytesIO()
    Image.fromarray(array).save(out, kind)
    return out.getvalue()


def _text_bomb() -> Files:
    info = PngImagePlugin.PngInfo()
    info.add_text("Comment", "0" * 60_000_000, zip=True)
    out = io.BytesIO()
    Image.fromarray(np.full((40, 40), 255, np.uint8)).save(out, "png", pnginfo=info)
    return {"hostile.png": out.getvalue()}


def _noise(rows: int, cols: int) -> NDArray[np.uint8]:
    return np.asarray(np.random.default_rng(0).integers(0, 2, (rows, cols)) * 255, np.uint8)


def _checks(rows: int, cols: int) -> NDArray[np.uint8]:
    return np.asarray(np.indices((rows, cols)).sum(axis=0) % 2 * 255, np.uint8)


_JPEG = b"\xff\xd8\xff\xc0\x00\x0b\x08" + struct.pack(">HH", 65535, 65535) + b"\x01\x01\x11\x00\xff\xd9"


def _bmp(width: int, height: int, bits: int) -> bytes:
    return b"BM" + bytes(12) + struct.pack("<IiiHHI", 40, width, height, 1, bits, 0)


IMAGES: Hostile = {
    "10⁹ pixels in PNG": lambda: {"hostile.png": _png(40_000, 25_000)},
    "4·10¹⁸ pixels in PNG": lambda: {"hostile.png": _png(2**31 - 1, 2**31 - 1)},
    "a PNG that unpacks to 300 MB": lambda: {"hostile.png": _png(100, 100, data=bytes(300_000_000))},
    "a PNG without data": lambda: {"hostile.png": _png(5000, 5000)},
    "a PNG with a comment of 60 MB": _text_bomb,
    "a PNG with a profile of 100 MB": lambda: {
        "hostile.png": _png(20, 20, data=(b"\0" + b"\xff" * 20) * 20,
                            more=_chunk(b"iCCP", b"p\0\0" + zlib.compress(bytes(100_000_000), 9))),
    },
    "a PNG of 50,000 chunks": lambda: {
        "hostile.png": _png(20, 20, data=(b"\0" + b"\xff" * 20) * 20, more=_chunk(b"tEXt", b"a\0b") * 50_000),
    },
    "an unknown colour type": lambda: {"hostile.png": _png(20, 20, kind=5)},
    "a palette that is missing": lambda: {"hostile.png": _png(20, 20, data=(b"\0" + bytes(20)) * 20, kind=3)},
    "the largest that is free": _encoded(np.full((10_000, 2500), 255, np.uint8), "png"),
    "2 million pixels of noise": _encoded(_noise(1000, 2000), "png"),
    "1 million checks": _encoded(_checks(1000, 1000), "png"),
    "a line of 10,000 pixels": _encoded(np.full((1, 10_000), 255, np.uint8), "png"),
    "one pixel": _encoded(np.full((1, 1), 255, np.uint8), "png"),
    "all walls": _encoded(np.zeros((50, 50), np.uint8), "png"),
    "JPEG of 65535²": one("hostile.jpg", _JPEG),
    "a cut JPEG": lambda: {"hostile.jpg": _bytes_of(_noise(300, 300), "jpeg")[:900]},
    "BMP of 10⁹ pixels": one("hostile.bmp", _bmp(40_000, 25_000, 8)),
    "BMP of a negative height": one("hostile.bmp", _bmp(40, -2**31, 24)),
    "PGM with a white of 0": one("hostile.pgm", b"P5\n10 10\n0\n" + bytes(100)),
    "PGM with a white of 65536": one("hostile.pgm", b"P5\n10 10\n65536\n" + bytes(200)),
    "PFM of nan": one("hostile.pgm", b"Pf\n10 10\n-1.0\n" + b"\xff" * 400),
    "an SVG under another name": one("hostile.png", b"<svg xmlns='http://www.w3.org/2000/svg'><script>1</script></svg>"),
    "EPS under another name": one("hostile.png", b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n(a) print\n"),
    "TIFF under another name": _encoded(np.full((40, 40), 255, np.uint8), "tiff"),
    "empty": one("hostile.png", b""),
    "an unknown suffix": one("hostile.svg", b"<svg/>"),
    "no suffix": one("hostile", b"\x89PNG"),
    "a folder": lambda: {"hostile.png/": b""},
    "a pipe": one("hostile.png", Pipe()),
    "a link to itself": one("hostile.png", Link("hostile.png")),
    "an endless device": one("hostile.png", Link("/dev/zero")),
}  # fmt: skip


# ---- configurations --------------------------------------------------------------------------------------------


_toml = partial(one, "config.toml")

CONFIGS: Hostile = {
    "deep lists": _toml("a = " + "[" * _DEEP),
    "deep tables": _toml("a = " + "{a = " * _DEEP),
    "a deep key": _toml(".".join(["a"] * _DEEP) + " = 1"),
    "a deep table": _toml("[" + ".".join(["a"] * _DEEP) + "]"),
    "a deep value of a setting": _toml("[slam_config]\na = " + "[" * 400 + "]" * 400),
    "an integer of 5000 digits": _toml("time_limit_s = " + "9" * 5000),
    "a long integer": _toml("[run]\nseed = " + "9" * 4000),
    "a hexadecimal integer of 10,000 digits": _toml("[run]\nseed = 0x" + "f" * 10_000),
    "100 MB": lambda: {"config.toml": b"#" * 100_000_000},
    "a million keys": lambda: {"config.toml": b"".join(b"k%d = 1\n" % k for k in range(1_000_000))},
    "a long name": _toml("slam = '" + "a" * 1_000_000 + "'"),
    "a long key": _toml("a" * 1_000_000 + " = 1"),
    "UTF-16": _toml("slam = 'ekf'".encode("utf-16")),
    "a byte that is no text": _toml(b"slam = '\xff'"),
    "an endless device as plan": _toml("floor_plan = '/dev/zero'"),
    "a password file as plan": _toml("floor_plan = '/etc/passwd'"),
    "a plan with a null byte": _toml('floor_plan = "a\\u0000.png"'),
    "a name with line breaks": _toml('slam = "a\\nb\\u001b[31m"'),
    "a key with line breaks": _toml('"a\\nb\\u001b[31m" = 1'),
    "a date": _toml("time_limit_s = 2026-01-01"),
    "a pipe": _toml(Pipe()),
    "a folder": lambda: {"other.toml/": b""},
    "an endless device": _toml(Link("/dev/zero")),
    "a link to itself": _toml(Link("config.toml")),
    **{f"{text}": _toml(text) for text in (
        "run = 3", "run = [1]", "[[run]]\nseed = 1", "[run]\nagent = 'a\\nb'",
        "[run]\nagent = '/dev/zero.safetensors'",
        "[run]\nseed = true", "[run]\nseed = -1", "[run]\nseed = 340282366920938463463374607431768211456",
        "[run]\nmax_steps = 1e9", "[run]\nmax_steps = 0", "[run]\nmax_steps = 99999999999999999999",
        "[run]\nstart = [1e308, 0.0, 0.0]", "[run]\nstart = [[1], 2, 3]", "[run]\nstart = [nan, 0.0, 0.0]",
        "step_s = nan", "step_s = 1e-300\nphysics_step_s = 1e-300", "physics_step_s = 1e-9", "time_limit_s = inf",
        "time_limit_s = nan", "grid_resolution_m = nan", "max_landmarks_observed = 1e9", "coverage_target = nan",
        "max_landmarks_observed = 99999999999999999999", "rooms = 3", "rooms = []", "slam = 3", "floor_plan = 3",
        "floor_plan = ''", "robot = 3", "robot = 'youbot'", "lidar = []", "[robot]\nlength_m = nan",
        "[robot]\nlength_m = 1e308", "[robot]\nmass_kg = '1'", "[lidar]\nbeams = 1.5", "[lidar]\nbeams = nan",
        "[noise]\npatch_friction = 3", "[noise]\npatch_friction = [nan, nan]",
        "[noise]\npatch_friction = ['a', 'b']",
        "[noise]\nencoder = nan", "[reward]\narea = inf", "[rooms_config]\nwidth_m = 1e9", "[slam_config]\na = {}",
        "rooms = 'rectangular'\n[rooms_config]\nwidth_m = [1e5, 1e5]", "odometry_filter = 'x'",
        "[slam_config.landmarks]\nnew_distance_m = nan",
        "slam = 'fastslam1'\n[slam_config]\nparticles = 1000000000",
    )},
}  # fmt: skip


# ---- policies --------------------------------------------------------------------------------------------------


def _weights(
    header: Mapping[str, object] | bytes, data: bytes = b"", told: int | None = None
) -> Callable[[], Files]:
    """Return weights with a header of one's own, which claims to be so long."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    size = (len(text) if told is None else told).to_bytes(8, "little")
    return lambda: {"ppo.safetensors": size + text + data}


def _tensor(dtype: str = "F32", shape: object = (1,), offsets: object = (0, 4)) -> dict[str, object]:
    return {"a": {"dtype": dtype, "shape": shape, "data_offsets": offsets}}


def _changed(**values: object) -> Callable[[], Files]:
    """Return the JSON file beside the weights with some values replaced."""
    return lambda: {"ppo.json": as_json(json.loads(samples.policies()["ppo.json"]) | values)}


def _filled(byte: bytes) -> Callable[[], Files]:
    """Return sound weights of which every number has the same bytes."""

    def made() -> Files:
        sound = samples.policies()["ppo.safetensors"]
        begin = 8 + int.from_bytes(sound[:8], "little")
        return {"ppo.safetensors": sound[:begin] + byte * (len(sound) - begin)}

    return made


_KINDS = ("F64", "F16", "BF16", "I64", "I8", "U8", "BOOL", "F8_E4M3", "C64", "OBJECT", "S1", "")

POLICIES: Hostile = {
    "a header of 2⁶³ bytes": _weights(b"{}", told=2**63),
    "a header of 10⁹ bytes": _weights(b"{}", told=10**9),
    "a header longer than the file": _weights(b"{}", told=100),
    "a header of nothing": _weights(b""),
    "a deep header": _weights(b"[" * _DEEP),
    "a header that is a list": _weights(b"[]"),
    "a shape of 2⁴⁰ by 2⁴⁰": _weights(_tensor(shape=[2**40, 2**40])),
    "a shape with 0 in it": _weights(_tensor(shape=[0, 2**60], offsets=[0, 0])),
    "a shape below 0": _weights(_tensor(shape=[-1]), bytes(4)),
    "offsets beyond the end": _weights(_tensor(shape=[250_000_000], offsets=[0, 10**9])),
    "offsets that go back": _weights(_tensor(offsets=[4, 0]), bytes(4)),
    "two tensors in one place": _weights(_tensor() | {"b": _tensor()["a"]}, bytes(4)),
    "bytes that belong to nobody": _weights(_tensor(), bytes(400)),
    "ten thousand tensors": _weights({f"layers.{k}.x": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}
                                      for k in range(10_000)}),
    **{f"numbers of the kind {kind!r}": _weights(_tensor(kind, offsets=[0, 8]), bytes(8)) for kind in _KINDS},
    "weights that are not numbers": _filled(b"\xff"),
    "weights that are infinite": _filled(b"\x7c"),
    "weights that are 0": _filled(b"\0"),
    "weights that are large": _filled(b"\x7b"),
    "JSON, deep": lambda: {"ppo.json": b"[" * _DEEP},
    "JSON, deep mappings": lambda: {"ppo.json": b'{"a":' * _DEEP},
    "JSON of 100 MB": lambda: {"ppo.json": b'"' + b"a" * 100_000_000 + b'"'},
    "JSON, an integer of 5000 digits": lambda: {"ppo.json": b'{"format": ' + b"9" * 5000 + b"}"},
    "JSON that is a list": lambda: {"ppo.json": b"[]"},
    "JSON that is empty": lambda: {"ppo.json": b""},
    "JSON in UTF-16": lambda: {"ppo.json": '{"a": 1}'.encode("utf-16")},
    "JSON that is a folder": one("ppo.json", Link("/tmp")),
    "JSON that is a pipe": one("ppo.json", Pipe()),
    "JSON that is an endless device": one("ppo.json", Link("/dev/zero")),
    "weights that are a pipe": one("ppo.safetensors", Pipe()),
    "weights that are an endless device": one("ppo.safetensors", Link("/dev/zero")),
    "weights in pickle": lambda: {"ppo.safetensors": b"\x80\x04cos\nsystem\n(S'true'\ntR."},
    **{f"{key} = {value!r}": _changed(**{key: value}) for key, value in (
        ("format", "x" * 100_000), ("format", "a\nb"), ("format", None), ("format", []), ("planning", []),
        ("planning", {"goal_m": "nan"}), ("planning", {"goal_m": 1e308}), ("planning", {"other": 1}),
        ("planning", {"goal_m": [1]}), ("planning", None), ("uncertainty", "no"),
        ("format", "mecanum-slam choice policy 1"), ("format", "mecanum-slam station policy 2"),
    )},
}  # fmt: skip
