"""H.264 by FFmpeg: images as an elementary stream (ITU-T H.264, annex B)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fractions import Fraction
from typing import Any, NamedTuple

import av
import av.error
import numpy as np

from companion.config import RecorderConfig
from companion.errors import ConfigError
from companion.messages import Bytes

MOST_INSIDE = 64
"""Most images held by an encoder."""
SOFTWARE = "libx264"
HARDWARE = ("h264_v4l2m2m", "h264_nvenc")
"""FFmpeg encoders in hardware, tried first."""
OPTIONS = {SOFTWARE: {"preset": "ultrafast", "tune": "zerolatency"}}
_IDR_OR_SPS = re.compile(rb"\x00\x00\x01(?:[\x25\x45\x65\x05]|[\x27\x47\x67\x07])")
"""IDR slice or sequence parameter set in an H.264 byte stream (ITU-T H.264, annex B)."""


class H264Picture(NamedTuple):
    """One image, which needs those before it unless `intra`."""

    seq: int
    t_ns: int
    data: bytes
    intra: bool


class H264Encoder:
    """Video without reordering: each image comes out as it goes in."""

    def __init__(self, config: RecorderConfig, width: int, height: int, rate_hz: float) -> None:
        self._config, self._size, self._rate_hz = config, (width, height), rate_hz
        self._inside: dict[int, tuple[int, int]] = {}
        """Number and time of the frames in the encoder, by presentation stamp."""
        self._number = 0
        self._intra_requested = False
        wanted = config.h264_encoder
        names = (*HARDWARE, SOFTWARE) if wanted == "auto" else (wanted,)
        for name in names:
            try:
                self._codec = self._opened(name)
            except (av.error.FFmpegError, ValueError, OSError):
                continue
            self.name = name
            return
        raise ConfigError(
            f"expert.recorder.h264_encoder = {wanted!r}: it encodes no {width} x {height} here; "
            "set it to auto, or recorder.codec to mjpeg"
        )

    def encode(self, seq: int, t_ns: int, rgb: Bytes) -> list[H264Picture]:
        """Encode an image (H, W, 3) with its number and time; those that are finished."""
        return self._encode(self._codec, seq, t_ns, rgb)

    def request_intra(self) -> None:
        """Make the next image independent of those before it, after a loss."""
        self._intra_requested = True

    def finish(self) -> list[H264Picture]:
        """Finish; images that are left."""
        try:
            return self._finished(self._codec, self._codec.encode(None))
        except av.error.FFmpegError:
            return []

    def _opened(self, name: str) -> Any:
        """An encoder that has been tested."""
        width, height = self._size
        blank = np.zeros((height, width, 3), np.uint8)
        with av.logging.Capture():
            codec = self._open(name)
            if not any(self._encode(codec, number, number, blank) for number in range(8)):
                raise ValueError("it gives nothing")
        self._inside.clear()
        return self._open(name)

    def _open(self, name: str) -> Any:
        width, height = self._size
        codec: Any = av.CodecContext.create(name, "w")
        codec.width, codec.height, codec.pix_fmt = width, height, "yuv420p"
        codec.time_base = Fraction(1, 1000)
        codec.framerate = Fraction(round(self._rate_hz * 1000), 1000)
        codec.bit_rate = self._config.h264_kbit_s * 1000
        codec.gop_size = max(1, round(self._rate_hz))  # a second, which a cut may cost
        codec.max_b_frames = 0
        codec.thread_count = 1
        codec.options = OPTIONS.get(name, {})
        return codec

    def _encode(self, codec: Any, seq: int, t_ns: int, rgb: Bytes) -> list[H264Picture]:
        picture = av.VideoFrame.from_ndarray(rgb, "rgb24").reformat(format="yuv420p")
        self._number += 1
        picture.pts = self._number
        picture.time_base = codec.time_base
        if self._intra_requested:
            picture.pict_type = av.video.frame.PictureType.I
            self._intra_requested = False
        self._inside[self._number] = seq, t_ns
        if len(self._inside) > MOST_INSIDE:  # it has dropped that one
            del self._inside[next(iter(self._inside))]
        return self._finished(codec, codec.encode(picture))

    def _finished(self, codec: Any, packets: Iterable[Any]) -> list[H264Picture]:
        out = []
        for packet in packets:
            if packet.pts not in self._inside:
                continue
            seq, t_ns = self._inside.pop(packet.pts)
            data = bytes(packet)
            intra = is_intra(data)
            if intra and codec.extradata and b"\x00\x00\x01\x67" not in data[:64]:
                data = codec.extradata + data
            out.append(H264Picture(seq, t_ns, data, intra))
        return out


def is_intra(h264: bytes | memoryview) -> bool:
    """True if an image of an H.264 byte stream can be decoded without those before it."""
    return _IDR_OR_SPS.search(bytes(h264[:256])) is not None
