"""Image files as grey rasters, read with distrust: sizes are checked in the header before anything is decoded."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mecanum_env.rooms.floor_plan import FloorPlanError

__all__ = ["IMAGE_SUFFIXES", "read_bytes", "read_grey"]

_MAX_SIDE = 10_000
_MAX_PIXELS = 25_000_000
_MAX_BYTES = 256 * 2**20

_PNG = b"\x89PNG\r\n\x1a\n"


class _Damaged(Exception):
    """A file that does not hold what its format asks for."""


def read_bytes(path: Path, *, what: str, limit: int = _MAX_BYTES) -> bytes:
    """Return a file's contents.

    Raises
    ------
    FloorPlanError
        If it is missing, not a file, not readable or larger than ``limit`` bytes.
    """
    try:
        if not path.exists():
            raise FloorPlanError(f"{what} {path} does not exist; check the path")
        if not path.is_file():
            raise FloorPlanError(f"{what} {path} is not a file; give the path of one")
        if path.stat().st_size > limit:
            raise FloorPlanError(f"{what} {path} is larger than {limit >> 20} MiB; give a smaller file")
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if isinstance(error, FloorPlanError):
            raise
        reason = getattr(error, "strerror", None) or str(error)
        raise FloorPlanError(f"cannot read {what} {path}: {reason}; check its permissions") from error


def read_grey(path: Path) -> NDArray[np.float32]:
    """Return an image as grey values ``(rows, cols)`` in 0 to 255, row 0 at the top; transparent is 0.

    Colours are averaged, as ROS's map_server does.

    Raises
    ------
    FloorPlanError
        If the file is missing, damaged, of another format or too large.
    """
    data = read_bytes(path, what="image")
    try:
        width, height = _header(data)
    except (_Damaged, struct.error, IndexError, ValueError) as error:
        detail = f" ({error})" if isinstance(error, _Damaged) else ""
        raise FloorPlanError(f"image {path} is damaged or no image{detail}; save it again as PNG") from error
    if max(width, height) > _MAX_SIDE or width * height > _MAX_PIXELS:
        raise FloorPlanError(
            f"image {path} of {width} × {height} pixels is too large; scale it down to at most {_MAX_SIDE} a side "
            f"and {_MAX_PIXELS // 10**6} million pixels"
        )
    grey = _decode(data)
    if grey is None or grey.shape != (height, width):
        raise FloorPlanError(f"image {path} is damaged (it cannot be decoded); save it again as PNG")
    return grey


def _decode(data: bytes) -> NDArray[np.float32] | None:
    """Decode a checked image; None where OpenCV cannot."""
    if data[:2] in (b"P2", b"P5"):
        return _decode_pgm(data)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    if image is None:
        return None
    scale = 255.0 / 65535.0 if image.dtype == np.uint16 else 1.0
    pixels = np.asarray(image, np.float32) * np.float32(scale)
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] == 4:
        return np.where(pixels[..., 3] >= 128, pixels[..., :3].mean(axis=2), np.float32(0))
    return np.asarray(pixels.mean(axis=2), np.float32)


def _header(data: bytes) -> tuple[int, int]:
    """Return width and height by the file's header, after checking that the file is whole."""
    for magic, read in _READERS.items():
        if data.startswith(magic):
            width, height = read(data)
            if width <= 0 or height <= 0:
                raise _Damaged("it has no pixels")
            return width, height
    raise _Damaged("neither PNG, PGM, JPEG nor BMP")


def _png_size(data: bytes) -> tuple[int, int]:
    width, height = struct.unpack(">II", data[16:24])
    if max(width, height) > _MAX_SIDE or width * height > _MAX_PIXELS:
        return width, height  # too large already: no need to look further
    position, ended = len(_PNG), False
    while position < len(data) and not ended:
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        body = data[position + 4 : position + 8 + length]
        (check,) = struct.unpack(">I", data[position + 8 + length : position + 12 + length])
        if zlib.crc32(body) != check:
            raise _Damaged("a checksum is wrong")
        position += 12 + length
        ended = kind == b"IEND"
    if not ended:
        raise _Damaged("it is cut short")
    return width, height


_PGM_HEADER = re.compile(
    rb"P([25])(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s"
)


def _pgm_fields(data: bytes) -> tuple[int, int, int, int, int]:
    """Return format (2 text, 5 binary), width, height, largest value and where the pixels begin."""
    match = _PGM_HEADER.match(data[:65536])
    if match is None:
        raise _Damaged("its PGM header is incomplete")
    kind, width, height, largest = (int(g) for g in match.groups())
    if not 0 < largest < 65536:
        raise _Damaged(f"its largest value is {largest}")
    return kind, width, height, largest, match.end()


def _pgm_size(data: bytes) -> tuple[int, int]:
    kind, width, height, largest, begin = _pgm_fields(data)
    least = width * height * (2 if largest > 255 else 1) if kind == 5 else 2 * width * height - 1
    small = max(width, height) <= _MAX_SIDE and width * height <= _MAX_PIXELS
    if small and len(data) - begin < least:
        raise _Damaged("it is cut short")
    return width, height


def _decode_pgm(data: bytes) -> NDArray[np.float32] | None:
    """Decode PGM here: OpenCV fills what a cut file lacks, and does not scale by the largest value."""
    kind, width, height, largest, begin = _pgm_fields(data)
    if kind == 5:
        dtype = np.dtype(">u2") if largest > 255 else np.dtype(np.uint8)
        values = np.frombuffer(data, dtype, width * height, begin).astype(np.float32)
    else:
        words = re.sub(rb"#[^\n]*", b" ", data[begin:]).split(None, width * height)[: width * height]
        try:
            values = np.array(words, dtype="S8").astype(np.float32)
        except ValueError:
            return None
    if values.size != width * height or not np.all((values >= 0) & (values <= largest)):
        return None
    return np.asarray(values.reshape(height, width) * np.float32(255.0 / largest), np.float32)


def _bmp_size(data: bytes) -> tuple[int, int]:
    (size,) = struct.unpack("<I", data[2:6])
    width, height = struct.unpack("<ii", data[18:26])
    if len(data) < size:
        raise _Damaged("it is cut short")
    return width, abs(height)


def _jpeg_size(data: bytes) -> tuple[int, int]:
    if b"\xff\xd9" not in data[-64:]:
        raise _Damaged("it is cut short")
    position = 2
    while True:
        while data[position] == 0xFF:
            position += 1
        marker = data[position]
        (length,) = struct.unpack(">H", data[position + 1 : position + 3])
        # The start of a frame, whatever its coding; C4, C8 and CC are tables.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 4 : position + 8])
            return width, height
        position += 1 + length
        if data[position] != 0xFF:
            raise _Damaged("a JPEG marker is missing")


_READERS: dict[bytes, Callable[[bytes], tuple[int, int]]] = {
    _PNG: _png_size,
    b"P5": _pgm_size,
    b"P2": _pgm_size,
    b"BM": _bmp_size,
    b"\xff\xd8": _jpeg_size,
}

IMAGE_SUFFIXES = (".png", ".pgm", ".jpg", ".jpeg", ".bmp")
"""Suffixes of the image files that can be read."""
