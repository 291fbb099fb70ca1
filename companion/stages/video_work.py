"""Stage `video`: the camera's pictures as RTSP, for pilots; encoded only while somebody watches."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from companion.errors import ConfigError
from companion.messages import Frame, Message
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_work import Work
from companion.streaming.video_overlay import VideoOverlay
from drivers.system.file_pages import give_back_library_pages
from drivers.system.heap import give_back_heap
from drivers.video.rtsp_server import RtspServer

if TYPE_CHECKING:
    from drivers.video.h264_encoder import H264Encoder

NOT_WATCHED = "nobody watches"


class _Video(Work):
    def __init__(self, setup: Setup) -> None:
        super().__init__()
        config = setup.config
        self._config = replace(config.recorder, h264_kbit_s=config.video.kbit_s)
        self._rate_hz = config.camera.rate_hz
        self._overlay = VideoOverlay(config.video.overlay, setup.camera)
        self._server = RtspServer(config.video.listen)
        self._is_live = setup.is_live
        self._encoder: H264Encoder | None = None
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
            if self._encoder is not None:
                self._encoder = None
                give_back_heap()
            self.device = self._server.problem or NOT_WATCHED
            return []
        height, width = message.rgb.shape[:2]
        if self._encoder is None or self._size != (width, height):
            try:
                self._encoder = self._opened(width & ~1, height & ~1)
            except ConfigError as error:
                self.device = str(error)
                return []
            self._size = (width, height)
            self.device = f"watched, by {self._encoder.name}"
        rgb = self._overlay.drawn(message.rgb, message.t_ns)
        even = rgb[: height & ~1, : width & ~1]
        for picture in self._encoder.encode(message.seq, message.t_ns, even):
            if not self._server.send(picture.data):
                self._n_left_out += 1
                self._encoder.request_intra()
        return []

    def _opened(self, width: int, height: int) -> H264Encoder:
        """An encoder; ConfigError where there is none for these images."""
        from drivers.video.h264_encoder import H264Encoder  # FFmpeg, 20 MB, once somebody watches

        encoder = H264Encoder(self._config, width, height, self._rate_hz)
        if self._is_live:  # in a process of its own
            give_back_library_pages()
        return encoder

    def finish(self, finish: Finish) -> Iterable[Message]:
        self._server.close()
        return []


work = _Video
"""The stage for a setup."""
