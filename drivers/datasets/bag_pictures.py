"""Images of a bag's topic, raw or compressed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.errors import FlightError
from companion.messages import Bytes
from drivers.datasets.bag_reader import open_bag_file

MAX_SIDE = 16384
Convert = Callable[[NDArray[Any]], NDArray[Any]]
ENCODINGS: dict[str, tuple[str, int, Convert]] = {
    "mono8": ("u1", 1, lambda i: cv2.cvtColor(i, cv2.COLOR_GRAY2RGB)),
    "8UC1": ("u1", 1, lambda i: cv2.cvtColor(i, cv2.COLOR_GRAY2RGB)),
    "mono16": ("u2", 1, lambda i: cv2.cvtColor((i >> 8).astype(np.uint8), cv2.COLOR_GRAY2RGB)),
    "rgb8": ("u1", 3, lambda i: i),
    "bgr8": ("u1", 3, lambda i: i[..., ::-1]),
    "8UC3": ("u1", 3, lambda i: i[..., ::-1]),
    "rgba8": ("u1", 4, lambda i: i[..., :3]),
    "bgra8": ("u1", 4, lambda i: i[..., 2::-1]),
    "yuv422": ("u1", 2, lambda i: cv2.cvtColor(i, cv2.COLOR_YUV2RGB_UYVY)),
    "uyvy": ("u1", 2, lambda i: cv2.cvtColor(i, cv2.COLOR_YUV2RGB_UYVY)),
    "yuv422_yuy2": ("u1", 2, lambda i: cv2.cvtColor(i, cv2.COLOR_YUV2RGB_YUY2)),
    "yuyv": ("u1", 2, lambda i: cv2.cvtColor(i, cv2.COLOR_YUV2RGB_YUY2)),
    # OpenCV names the pattern by its second row and column, ROS by its first
    "bayer_rggb8": ("u1", 1, lambda i: cv2.cvtColor(i, cv2.COLOR_BayerBG2RGB)),
    "bayer_bggr8": ("u1", 1, lambda i: cv2.cvtColor(i, cv2.COLOR_BayerRG2RGB)),
    "bayer_gbrg8": ("u1", 1, lambda i: cv2.cvtColor(i, cv2.COLOR_BayerGR2RGB)),
    "bayer_grbg8": ("u1", 1, lambda i: cv2.cvtColor(i, cv2.COLOR_BayerGB2RGB)),
}
"""Data type, channels, and conversion to RGB."""


def rgb_of(message: Any) -> Bytes | None:
    """Image (H, W, 3) of a decoded Image or CompressedImage; None where it is damaged.

    FlightError for an unknown encoding.
    """
    if hasattr(message, "format"):
        data = np.frombuffer(message.data, np.uint8)
        try:
            bgr = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        except cv2.error:  # a size in the file's head that nobody would send
            bgr = None
        return None if bgr is None else np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
    known = ENCODINGS.get(message.encoding)
    if known is None:
        raise FlightError(
            f"pictures are encoded as {str(message.encoding)[:40]!r}; known are "
            + ", ".join(ENCODINGS)
        )
    number, channels, convert = known
    height, width, step = int(message.height), int(message.width), int(message.step)
    kind = np.dtype((">" if message.is_bigendian else "<") + number)
    data = np.frombuffer(message.data, np.uint8)
    used = width * channels * kind.itemsize
    whole = 0 < height <= MAX_SIDE and 0 < width <= MAX_SIDE and used <= step
    if not whole or height * step > len(data):
        return None
    rows = data[: height * step].reshape(height, step)[:, :used]
    image = np.ascontiguousarray(rows).view(kind).reshape(height, width, -1)
    try:
        rgb = convert(image[..., 0] if channels == 1 else image)
    except cv2.error:  # pairs of pixels in a picture of odd width
        return None
    return np.ascontiguousarray(rgb, np.uint8)


class BagPictures:
    """Images of one topic, in order of their recording; see `FrameSource`."""

    def __init__(
        self, path: Path, topic: str, recorded_ns: Sequence[int], stamps_ns: Sequence[int],
        size: tuple[int, int],
    ) -> None:  # fmt: skip
        self.path = path
        self.width, self.height = size
        self._topic = topic
        self._recorded_ns = recorded_ns
        self._stamps_ns = stamps_ns

    @property
    def n_frames(self) -> int:
        """Number of images."""
        return len(self._recorded_ns)

    def own_times_ns(self) -> list[int]:
        """Header stamps of the images."""
        return list(self._stamps_ns)

    def pictures(self, first: int, last: int) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB image of images first..last; None for a damaged or odd-sized one."""
        number = first
        # several may have been written in the same nanosecond
        while number > 0 and self._recorded_ns[number - 1] == self._recorded_ns[first]:
            number -= 1
        beyond_ns = self._recorded_ns[last] + 1
        try:
            with open_bag_file(self.path) as bag:
                for message in bag.messages([self._topic], self._recorded_ns[number], beyond_ns):
                    if number > last:
                        return
                    if number >= first:
                        yield number, self._decoded(bag.decoded(message))
                    number += 1
        except FlightError:
            pass  # it is damaged here: what is missing stays missing, which the numbers show
        for missing in range(max(number, first), last + 1):
            yield missing, None

    def _decoded(self, message: Any | None) -> Bytes | None:
        rgb = rgb_of(message) if message is not None else None
        return rgb if rgb is not None and rgb.shape[:2] == (self.height, self.width) else None
