"""Image files as grey rasters, read with distrust: sizes are checked in the header before anything is decoded."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from mecanum_env.rooms.floor_plan import FloorPlanError
from slam.files import read_bytes as read_file
from slam.files import shown_path
from slam.types import Floats

__all__ = ["IMAGE_SUFFIXES", "read_bytes", "read_grey"]

IMAGE_SUFFIXES = (".png", ".pgm", ".jpg", ".jpeg", ".bmp")
"""Suffixes of the image files that can be read."""

_FORMATS = ("PNG", "PPM", "JPEG", "BMP")  # Pillow counts PGM to PPM
_MAX_SIDE = 10_000
_MAX_PIXELS = 25_000_000
_MAX_BYTES = 256 * 2**20


def read_bytes(path: Path, *, what: str, limit: int = _MAX_BYTES) -> bytes:
    """Return a file's contents.

    Raises
    ------
    FloorPlanError
        If it is missing, not a file, not readable or larger than ``limit`` bytes.
    """
    try:
        if not (path.exists() or path.is_symlink()):
            raise FloorPlanError(f"{what} {shown_path(path)} does not exist; check the path")
        return read_file(path, what=what, limit=limit)
    except (OSError, ValueError) as error:
        if isinstance(error, FloorPlanError):
            raise
        if type(error) is ValueError:
            raise FloorPlanError(str(error)) from error
        raise FloorPlanError(f"cannot read {what} {shown_path(path)}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def read_grey(path: Path) -> Floats:
    """Return an image as grey values ``(rows, cols)`` in 0 to 255, row 0 at the top; transparent is NaN.

    Colours are averaged, as ROS's map_server does. An image is turned as its EXIF says.

    Raises
    ------
    FloorPlanError
        If the file is missing, damaged, of another format or too large.
    """
    data = io.BytesIO(read_bytes(path, what="image"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(data, formats=_FORMATS)
        if max(image.size) > _MAX_SIDE or image.width * image.height > _MAX_PIXELS:
            raise Image.DecompressionBombError(f"it has {image.width} × {image.height} pixels")
        image.verify()  # a PNG's checksums; the image must be opened again after it
        return _grey(ImageOps.exif_transpose(Image.open(data, formats=_FORMATS)))
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise FloorPlanError(
            f"image {path} is too large ({error}); scale it down to at most {_MAX_SIDE} a side and "
            f"{_MAX_PIXELS // 10**6} million pixels"
        ) from error
    except Exception as error:  # Pillow does not say which its decoders raise on damaged bytes: many kinds
        raise FloorPlanError(
            f"image {path} is damaged, cut short or neither PNG, PGM, JPEG nor BMP; save it again as PNG"
        ) from error


def _grey(image: Image.Image) -> Floats:
    if image.mode.startswith("I"):  # 16 bits, which Pillow scales to 65535
        values = np.asarray(image, np.float32)
        grey = values * np.float32(255.0 / 65535.0)
        return np.where(values == image.info.get("transparency"), np.float32(np.nan), grey)
    pixels = np.asarray(image.convert("RGBA"))
    return np.where(pixels[..., 3] >= 128, pixels[..., :3].mean(axis=2, dtype=np.float32), np.float32(np.nan))
