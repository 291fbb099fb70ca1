"""Pixel formats of cameras by FourCC, converted to grey and RGB."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.messages import Bytes

Arrays = tuple[Bytes, Bytes]
"""Images grey (H, W) and rgb (H, W, 3)."""


def to_grey_and_rgb(
    code: str, data: Any, width: int, height: int, stride: int = 0
) -> Arrays | None:
    """Copies of an image's brightness and colours; None if it is damaged.

    `data` is any buffer; `stride` is bytes per row, 0 for no padding. Only formats in `CODES` are
    supported.
    """
    raw = np.frombuffer(data, np.uint8)
    if code == "MJPG":
        return _jpeg(raw, width, height)
    bytes_per_pixel, rows_num, convert = _RAW[code]
    stride = stride or width * bytes_per_pixel
    n_rows = height * rows_num // 2
    if stride < width * bytes_per_pixel or raw.size < stride * n_rows:
        return None
    rows = raw[: stride * n_rows].reshape(n_rows, stride)
    return convert(rows, width, height)


def _jpeg(raw: NDArray[np.uint8], width: int, height: int) -> Arrays | None:
    # a camera that is short of bandwidth sends half a picture; its end is then missing
    if raw.size < 4 or raw[0] != 0xFF or raw[1] != 0xD8:
        return None
    if b"\xff\xd9" not in raw[-64:].tobytes():  # some pad behind it
        return None
    decoded = cv2.imdecode(raw, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if decoded is None:
        return None
    rgb = np.asarray(decoded, np.uint8)
    return _grey(rgb), rgb


def _grey(rgb: Bytes) -> Bytes:
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _packed(grey_code: int, rgb_code: int) -> Callable[[Bytes, int, int], Arrays]:
    def convert(rows: Bytes, width: int, height: int) -> Arrays:
        pixels = rows[:, : 2 * width].reshape(height, width, 2)
        grey = cv2.cvtColor(pixels, grey_code)
        return np.asarray(grey, np.uint8), np.asarray(cv2.cvtColor(pixels, rgb_code), np.uint8)

    return convert


def _nv12(rows: Bytes, width: int, height: int) -> Arrays:
    grey = rows[:height, :width].copy()
    chroma = np.ascontiguousarray(rows[height:, :width]).reshape(height // 2, width // 2, 2)
    return grey, np.asarray(cv2.cvtColorTwoPlane(grey, chroma, cv2.COLOR_YUV2RGB_NV12), np.uint8)


def _i420(rows: Bytes, width: int, height: int) -> Arrays:
    # the planes of colour have half the stride: two of their rows in each of ours
    stride = rows.shape[1]
    grey = rows[:height, :width].copy()
    halves = rows[height:].reshape(height, stride // 2)[:, : width // 2]
    u, v = halves[: height // 2], halves[height // 2 :]
    chroma = np.stack([u, v], 2)
    return grey, np.asarray(cv2.cvtColorTwoPlane(grey, chroma, cv2.COLOR_YUV2RGB_NV12), np.uint8)


def _only_grey(rows: Bytes, width: int, height: int) -> Arrays:
    grey = rows[:, :width].copy()
    return grey, np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)


def _rgb(rows: Bytes, width: int, height: int) -> Arrays:
    rgb = rows[:, : 3 * width].reshape(height, width, 3).copy()
    return _grey(rgb), rgb


def _bgr(rows: Bytes, width: int, height: int) -> Arrays:
    bgr = rows[:, : 3 * width].reshape(height, width, 3)
    rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    return _grey(rgb), rgb


_RAW: dict[str, tuple[int, int, Callable[[Bytes, int, int], Arrays]]] = {
    # bytes of a row's pixel, rows for every two rows of the picture
    "YUYV": (2, 2, _packed(cv2.COLOR_YUV2GRAY_YUYV, cv2.COLOR_YUV2RGB_YUYV)),
    "UYVY": (2, 2, _packed(cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2RGB_UYVY)),
    "NV12": (1, 3, _nv12),
    "YU12": (1, 3, _i420),
    "RGB3": (3, 2, _rgb),
    "BGR3": (3, 2, _bgr),
    "GREY": (1, 2, _only_grey),
}

CODES = (*_RAW, "MJPG")
"""Supported formats, the cheapest to convert first; a camera without colours gives GREY."""
