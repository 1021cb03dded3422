"""What ``mecanum play`` shows: the environment's frame, a strip above it that says who drives where, and help."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mecanum_env.views.canvas import FLOOR, INK, PAGE, WALL, Colour, put_text, text_width
from mecanum_env.views.paint import BELIEVED_PATH, PLANNED_PATH, UNSEEN
from mecanum_env.views.render import FRAME_SHAPE
from training.play.controls import KEYS
from training.play.session import Session

__all__ = ["PICTURE_SHAPE", "play_picture"]

Image = NDArray[np.uint8]

_STRIP = 40  # height [pixels]
PICTURE_SHAPE = (FRAME_SHAPE[0] + _STRIP, FRAME_SHAPE[1])
"""Height and width of a picture [pixels]."""

_LEFT = 14
_PLACE, _PACE = 646, 1020  # where these readouts begin
_LINE = 33  # of help [pixels]


def play_picture(
    session: Session, *, steps_per_s: float | None, show_help: bool = False, notice: str = ""
) -> Image:
    """Return the picture ``(760, 1280, 3)``, RGB: the strip, and below it the frame.

    Over the frame the keys may be listed, and a notice tells what the next picture takes some time for.
    """
    # Drawn as OpenCV draws, blue first; the frame comes red first.
    picture = np.empty((*PICTURE_SHAPE, 3), np.uint8)
    picture[_STRIP:] = session.frame()[:, :, ::-1]
    _write_strip(picture[:_STRIP], session, steps_per_s)
    if show_help:
        _write_help(picture)
    if notice:
        text = _shortened(notice, picture.shape[1] - 100, size=18)
        box = _box(picture, text_width(text, size=18) + 60, 60)
        put_text(box, text, (30, 37), WALL, size=18)
    return np.ascontiguousarray(picture[:, :, ::-1])


def _write_strip(strip: Image, session: Session, steps_per_s: float | None) -> None:
    strip[:] = WALL
    strip[:, :6] = BELIEVED_PATH if session.agent is None else PLANNED_PATH
    x = _write(strip, session.driver, _LEFT, FLOOR, bold=True)
    room = _PLACE - 20 - (x + 16)
    _write(strip, _shortened(session.driver_note, room), x + 16, UNSEEN)
    _write(strip, _shortened(session.place, _PACE - 20 - _PLACE), _PLACE, FLOOR)
    pace = "–" if steps_per_s is None else f"{steps_per_s:.1f}"
    _write(strip, f"{pace} steps/s", _PACE, FLOOR)
    hint = "F1: keys"
    _write(strip, hint, strip.shape[1] - _LEFT - text_width(hint, size=17), UNSEEN)


def _write(strip: Image, text: str, x: int, colour: Colour, *, bold: bool = False) -> int:
    """Write a readout; return where it ends."""
    put_text(strip, text, (x, 26), colour, size=17, bold=bold)
    return x + text_width(text, size=17, bold=bold)


def _shortened(text: str, width: int, *, size: int = 17) -> str:
    """Return a text, or as much of its beginning as is no wider."""
    if text_width(text, size=size) <= width:
        return text
    while text and text_width(f"{text}…", size=size) > width:
        text = text[:-1]
    return f"{text}…"


def _write_help(picture: Image) -> None:
    box = _box(picture, 700, 88 + _LINE * len(KEYS))
    put_text(box, "Keys", (36, 46), WALL, size=21, bold=True)
    for line, (keys, meaning) in enumerate(KEYS):
        y = 88 + _LINE * line
        put_text(box, keys, (36, y), WALL, size=17, bold=True)
        put_text(box, meaning, (270, y), INK, size=17)


def _box(picture: Image, width: int, height: int) -> Image:
    """Clear a box in the middle of the picture, framed, and return it to be written in."""
    y, x = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
    box = picture[y : y + height, x : x + width]
    box[:] = WALL
    box[2:-2, 2:-2] = PAGE
    return box
