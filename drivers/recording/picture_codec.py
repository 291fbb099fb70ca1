"""Encoding and decoding of a recording's images, each by itself."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError

from companion.config import RecorderConfig
from companion.messages import Bytes, Frame
from drivers.recording.recording_codec import serialised, set_time
from drivers.recording.recording_topics import GREY, IMAGE, RAW

FRAME_ID = "camera"
PNG_LEVEL = 1


class EncodedPicture(NamedTuple):
    """One message with the image of a frame; unless `intra` it needs the image before it."""

    topic: str
    seq: int
    t_ns: int
    data: bytes
    intra: bool = True


class PictureEncoder(Protocol):
    """Encoder of images to messages; one for each flight."""

    name: str
    """For people."""

    def encode(self, frame: Frame) -> list[EncodedPicture]:
        """Encode a frame; finished messages, of this frame or of earlier ones."""

    def request_intra(self) -> None:
        """Make the next image independent of those before it, after a loss."""

    def finish(self) -> list[EncodedPicture]:
        """Finish; messages that are left."""


def picture_encoder(config: RecorderConfig, width: int, height: int, rate_hz: float) -> (
    PictureEncoder
):  # fmt: skip
    """The configured encoder; ConfigError where it does not work."""
    if config.codec == "h264":
        # FFmpeg, 15 MB, which no other codec needs
        from drivers.recording.video_codec import H264

        return H264(config, width, height, rate_hz)
    if config.codec == "mjpeg":
        return Stills("jpeg", [cv2.IMWRITE_JPEG_QUALITY, config.jpeg_quality])
    if config.codec == "png":
        return Stills("png", [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    return Raw()


class _EachAlone:
    """Part of encoders whose images need no others."""

    def request_intra(self) -> None:
        """See `PictureEncoder`."""

    def finish(self) -> list[EncodedPicture]:
        """See `PictureEncoder`."""
        return []


class Stills(_EachAlone):
    """Each image by itself: as JPEG, or lossless as PNG, with a separate grey image if needed."""

    def __init__(self, form: str, parameters: list[int]) -> None:
        self.name = form
        self._parameters = parameters

    def encode(self, frame: Frame) -> list[EncodedPicture]:
        """See `PictureEncoder`."""
        bgr = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencode(f".{self.name}", bgr, self._parameters)
        image = CompressedImage(frame_id=FRAME_ID, format=self.name, data=data.tobytes())
        set_time(image.timestamp, frame.t_ns)
        out = [EncodedPicture(IMAGE, frame.seq, frame.t_ns, serialised(image))]
        return out + _lossless_grey(frame) if self.name == "png" else out


class Raw(_EachAlone):
    """Uncompressed images; the chunk's compression makes them a little smaller."""

    name = "raw"

    def encode(self, frame: Frame) -> list[EncodedPicture]:
        """See `PictureEncoder`."""
        return [_raw(RAW, frame, frame.rgb, "rgb8"), *_lossless_grey(frame)]


def still(topic: str, data: bytes | memoryview) -> Bytes | None:
    """RGB (or grey, of the grey topic) of an independent image; None if it is damaged."""
    try:
        if topic == IMAGE:
            image = CompressedImage.FromString(bytes(data))
            packed = np.frombuffer(image.data, np.uint8)
            if not packed.size:
                return None
            bgr = cv2.imdecode(packed, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
            if bgr is None:
                return None
            return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
        raw = RawImage.FromString(bytes(data))
    except (ValueError, cv2.error, DecodeError):
        return None
    shape = (raw.height, raw.width, 3) if raw.encoding == "rgb8" else (raw.height, raw.width)
    if len(raw.data) != int(np.prod(shape)) or raw.encoding not in ("rgb8", "mono8"):
        return None
    return np.frombuffer(raw.data, np.uint8).reshape(shape)


def grey_of(rgb: Bytes) -> Bytes:
    """Grey of a colour image, as in all recorded flights."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _lossless_grey(frame: Frame) -> list[EncodedPicture]:
    """The grey image, where it differs from that of the colours (of a camera that gives Y, say)."""
    if np.array_equal(frame.grey, grey_of(frame.rgb)):
        return []
    return [_raw(GREY, frame, frame.grey, "mono8")]


def _raw(topic: str, frame: Frame, pixels: Bytes, encoding: str) -> EncodedPicture:
    height, width = pixels.shape[:2]
    step = width * (3 if encoding == "rgb8" else 1)
    image = RawImage(
        frame_id=FRAME_ID, width=width, height=height, encoding=encoding, step=step,
        data=pixels.tobytes(),
    )  # fmt: skip
    set_time(image.timestamp, frame.t_ns)
    return EncodedPicture(topic, frame.seq, frame.t_ns, serialised(image))
