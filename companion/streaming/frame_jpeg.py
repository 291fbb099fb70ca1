"""Frames as JPEG, of a size that the link can carry."""

from __future__ import annotations

import cv2
import numpy as np

from companion.messages import Bytes
from companion.streaming.item_codec import encode
from companion.streaming.items import ImageItem, PictureItem

SIZES = ((640, 60), (480, 50), (320, 45), (240, 40), (160, 35))
"""Width and JPEG quality, best first."""
GUESS_BYTES = (40_000, 20_000, 9_000, 5_000, 2_500)
PER_SECOND = 2.0
"""Least rate of pictures; the largest size is used that reaches it."""
MOST_FOUND = 300


def picture_of(image: ImageItem, width: int, quality: int) -> PictureItem:
    """Picture of a frame, no wider than it is; found points in pixels of the picture."""
    height_px, width_px = image.rgb.shape[:2]
    shrink = min(1.0, width / width_px)
    small: Bytes = image.rgb
    if shrink < 1.0:
        size = (round(width_px * shrink), round(height_px * shrink))
        small = np.asarray(cv2.resize(image.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, quality]
    _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(small, cv2.COLOR_RGB2BGR), options)
    found = (image.found_px + 0.5) * shrink
    return PictureItem(image.t_ns, jpeg.tobytes(), small.shape[1], found.astype(np.float32))


def as_wide(picture: PictureItem, width: int) -> PictureItem:
    """The same picture at this width; unchanged where it cannot be decoded."""
    image = cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return picture
    grow = width / image.shape[1]
    size = (width, round(image.shape[0] * grow))
    _, jpeg = cv2.imencode(".jpg", cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))
    found = picture.found_px * np.float32(grow)
    return PictureItem(picture.t_ns, jpeg.tobytes(), width, found)


class AdaptiveJpeg:
    """Encodes pictures for one viewer at the size that its link can carry."""

    def __init__(self) -> None:
        self._bytes = list(GUESS_BYTES)

    def encoded(self, image: ImageItem | None, share_bytes_s: float) -> bytes | None:
        """Bytes of a picture for this share of the link's rate; None without one."""
        if image is None:
            return None
        fits = [k for k, n in enumerate(self._bytes) if n * PER_SECOND <= share_bytes_s]
        at = fits[0] if fits else len(SIZES) - 1
        picture = picture_of(image, *SIZES[at])
        if len(picture.found_px) > MOST_FOUND:
            step = -(-len(picture.found_px) // MOST_FOUND)
            picture = PictureItem(
                picture.t_ns, picture.jpeg, picture.width, picture.found_px[::step]
            )
        payload = encode(picture)
        self._bytes[at] = round(0.7 * self._bytes[at] + 0.3 * len(payload))
        return payload
