"""Images as JPEG, and validated decoding of what a network sends."""

from __future__ import annotations

import cv2
import numpy as np

from companion.errors import StreamError
from companion.messages import Bytes

MARKER, START, FIRST_FRAME, LAST_FRAME = 0xFF, 0xD8, 0xC0, 0xCF
NO_FRAMES = frozenset({0xC4, 0xC8, 0xCC})
"""Markers of tables, in the range of frame markers."""


def jpeg_of(image: Bytes, quality: int) -> bytes:
    """JPEG of a grey (H, W) or an RGB (H, W, 3) image."""
    if image.ndim == 3:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), np.uint8)
    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return jpeg.tobytes()


def without_colour(jpeg: bytes, quality: int) -> bytes:
    """The same in grey; at its quality hardly anything more is lost."""
    grey = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise StreamError("a JPEG that cannot be decoded")
    return jpeg_of(np.asarray(grey, np.uint8), quality)


def image_of(jpeg: bytes, width: int, height: int, colour: bool) -> Bytes:
    """Pixels, (H, W, 3) RGB or (H, W); StreamError where it is no image of that size.

    The size is read before anything is decoded: a few bytes can claim to be a gigapixel.
    """
    if size_of(jpeg) != (width, height):
        raise StreamError(f"no JPEG of {width} x {height} pixels")
    mode = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    try:
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), mode | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise StreamError("a JPEG that cannot be decoded") from error
    if image is None or image.shape[:2] != (height, width):
        raise StreamError("a JPEG that cannot be decoded")
    if colour:
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return np.asarray(image, np.uint8)


def size_of(jpeg: bytes) -> tuple[int, int] | None:
    """Width and height by the frame header of a JPEG; None without one."""
    if jpeg[:2] != bytes([MARKER, START]):
        return None
    at = 2
    while at + 9 <= len(jpeg) and jpeg[at] == MARKER:
        kind = jpeg[at + 1]
        if FIRST_FRAME <= kind <= LAST_FRAME and kind not in NO_FRAMES:
            height = int.from_bytes(jpeg[at + 5 : at + 7], "big")
            return int.from_bytes(jpeg[at + 7 : at + 9], "big"), height
        length = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        at += 2 + max(length, 2)
    return None
