"""Images of a recording as video: H.264, encoded and decoded."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import av
import av.error
import numpy as np
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from google.protobuf.message import DecodeError

from companion.config import RecorderConfig
from companion.messages import Bytes, Frame
from drivers.recording.picture_codec import FRAME_ID, EncodedPicture
from drivers.recording.recording_codec import serialised, set_time
from drivers.recording.recording_topics import VIDEO
from drivers.video.h264_encoder import H264Encoder, H264Picture, is_intra


class H264:
    """Video without reordering: each image comes out as it goes in."""

    def __init__(self, config: RecorderConfig, width: int, height: int, rate_hz: float) -> None:
        self._encoder = H264Encoder(config, width, height, rate_hz)
        self.name = self._encoder.name

    def encode(self, frame: Frame) -> list[EncodedPicture]:
        """See `PictureEncoder`."""
        return list(map(_message, self._encoder.encode(frame.seq, frame.t_ns, frame.rgb)))

    def request_intra(self) -> None:
        """See `PictureEncoder`."""
        self._encoder.request_intra()

    def finish(self) -> list[EncodedPicture]:
        """See `PictureEncoder`."""
        return list(map(_message, self._encoder.finish()))


def _message(picture: H264Picture) -> EncodedPicture:
    video = CompressedVideo(frame_id=FRAME_ID, format="h264", data=picture.data)
    set_time(video.timestamp, picture.t_ns)
    return EncodedPicture(VIDEO, picture.seq, picture.t_ns, serialised(video), picture.intra)


class VideoDecoder:
    """Decoder of a video, image by image; starts with an intra picture."""

    def __init__(self) -> None:
        self._codec: Any = av.CodecContext.create("h264", "r")
        self._codec.thread_count = 1
        self._codec.options = {"flags": "low_delay"}

    def pictures(
        self, messages: Iterable[tuple[int, bytes, bool]]
    ) -> Iterator[tuple[int, Bytes | None]]:
        """Number and RGB of each; None where it, or one that it needs, cannot be decoded.

        Each message is a number, the bytes, and whether something before it is missing.
        """
        waiting: list[int] = []
        broken = False
        for number, data, lost in messages:
            video = h264_of(data)
            broken = (broken or lost or video is None) and not is_intra(video or b"")
            waiting.append(number)
            if broken or video is None:
                continue  # it would be smeared with what it lacks
            packet: Any = av.Packet(video)
            packet.pts = packet.dts = number
            yield from self._given(waiting, packet)
        yield from self._given(waiting, None)
        for number in waiting:
            yield number, None

    def _given(self, waiting: list[int], packet: Any) -> Iterator[tuple[int, Bytes | None]]:
        try:
            frames = self._codec.decode(packet)
        except av.error.FFmpegError:
            frames = []
        for frame in frames:
            while waiting and frame.pts is not None and waiting[0] < frame.pts:
                yield waiting.pop(0), None
            if waiting and waiting[0] == frame.pts:
                rgb = None if frame.is_corrupt else frame.to_ndarray(format="rgb24")
                yield waiting.pop(0), None if rgb is None else np.asarray(rgb, np.uint8)


def h264_of(data: bytes) -> bytes | None:
    """Video of one message; None where there is none in it."""
    try:
        video: bytes = CompressedVideo.FromString(data).data
    except (ValueError, DecodeError):
        return None
    return video or None
