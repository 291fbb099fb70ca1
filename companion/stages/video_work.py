"""Stage `video`: the camera's pictures as RTSP, for pilots; encoded only while somebody watches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from companion.errors import ConfigError
from companion.messages import Frame, Message
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_work import Work
from companion.streaming.video_overlay import VideoOverlay
from drivers.recording.video_codec import H264, h264_of
from drivers.video.rtsp_server import RtspServer

NOT_WATCHED = "nobody watches"


class _Video(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        config = setup.config
        self._config = replace(config.recorder, h264_kbit_s=config.video.kbit_s)
        self._rate_hz = config.camera.rate_hz
        self._overlay = VideoOverlay(config.video.overlay, setup.camera)
        self._server = RtspServer(config.video.listen)
        self._encoder: H264 | None = None
        self._size = (0, 0)
        self._n_left_out = 0
        self.device = NOT_WATCHED

    @property
    def n_rejected(self) -> int:
        """Pictures left out, as the server did not take them."""
        return self._n_left_out

    def step(self, message: Any) -> Iterable[Message]:
        if not isinstance(message, Frame):
            self._overlay.take(message)
            return []
        if not self._server.is_watched or not message.rgb.size:
            self._encoder = None
            self.device = self._server.problem or NOT_WATCHED
            return []
        height, width = message.rgb.shape[:2]
        if self._encoder is None or self._size != (width, height):
            try:
                self._encoder = H264(self._config, width & ~1, height & ~1, self._rate_hz)
            except ConfigError as error:
                self.device = str(error)
                return []
            self._size = (width, height)
            self.device = f"watched, by {self._encoder.name}"
        rgb = self._overlay.drawn(message.rgb, message.t_ns)
        even = rgb[: height & ~1, : width & ~1]
        for picture in self._encoder.encode(replace(message, rgb=even)):
            if not self._server.send(h264_of(picture.data) or b""):
                self._n_left_out += 1
                self._encoder.request_intra()
        return []

    def finish(self, finish: Finish) -> Iterable[Message]:
        self._server.close()
        return []


def work(setup: Setup) -> Work:
    """The stage for a setup."""
    return _Video(setup)
