"""Live video by RTSP, as FFmpeg sees it: what was exposed is decoded soon after."""

from __future__ import annotations

import statistics
import threading
import time
from pathlib import Path

import av
import av.error
import numpy as np
import pytest

from companion.config import CameraConfig, Config, RecorderConfig, VideoConfig
from companion.geometry.camera import Camera
from companion.messages import Bytes, Frame
from companion.runtime.stage_protocol import Finish, Setup
from companion.stages.video_work import NOT_WATCHED, work
from drivers.video.rtsp_server import RtspServer
from tests.support.cameras.rtsp_server import missing
from tests.support.waiting import until

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())
WIDTH, HEIGHT, RATE_HZ = 640, 480, 30
N_BARS = 24
BAR_PX = WIDTH // N_BARS


def picture(ms: int) -> Bytes:
    """It tells a time by its bars, over a picture that is hard to encode."""
    rgb = np.random.default_rng(1).integers(90, 160, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for bit in range(N_BARS):
        rgb[: HEIGHT // 2, bit * BAR_PX : (bit + 1) * BAR_PX] = 255 * (ms >> bit & 1)
    return rgb


def told_ms(grey: Bytes) -> int:
    row = grey[HEIGHT // 4]
    return sum(int(row[BAR_PX * bit + BAR_PX // 2] > 127) << bit for bit in range(N_BARS))


@pytest.mark.real_time
def test_a_stage_shows_what_it_is_given_and_works_only_while_somebody_watches() -> None:
    config = Config(
        camera=CameraConfig(rate_hz=RATE_HZ), video=VideoConfig(listen="127.0.0.1:0"),
        recorder=RecorderConfig(h264_encoder="libx264"),
    )  # fmt: skip
    stage = work(Setup(config, Camera(WIDTH, HEIGHT, 500, 500, 320, 240)))
    server: RtspServer = stage._server
    over = threading.Event()

    def film() -> None:
        due_s, number = time.monotonic(), 0
        while not over.is_set():
            now_ns = time.monotonic_ns()
            rgb = picture(now_ns // 1_000_000 & 0xFFFFFF)
            list(stage.step(Frame(number, now_ns, rgb[..., 0], rgb)))
            number, due_s = number + 1, due_s + 1 / RATE_HZ
            over.wait(max(0.0, due_s - time.monotonic()))

    filming = threading.Thread(target=film)
    try:
        until(lambda: bool(server.port))
        filming.start()
        until(lambda: stage.device == NOT_WATCHED)
        late_ms = []
        options = {"rtsp_transport": "tcp", "fflags": "nobuffer", "flags": "low_delay"}
        options |= {"probesize": "32", "analyzeduration": "0"}
        url = f"rtsp://127.0.0.1:{server.port}/camera"
        with av.open(url, options=options, timeout=10) as film_seen:
            film_seen.streams.video[0].codec_context.thread_count = 1
            for frame in film_seen.decode(video=0):
                grey = np.asarray(frame.to_ndarray(format="gray"), np.uint8)
                assert grey.shape == (HEIGHT, WIDTH)
                late_ms.append((time.monotonic_ns() // 1_000_000 - told_ms(grey)) & 0xFFFFFF)
                if len(late_ms) == 60:
                    break
        middle_ms = statistics.median(late_ms[10:])
        print(f"{middle_ms} ms from exposure to decoded, {max(late_ms[10:])} ms at most")
        assert middle_ms < 200
        until(lambda: stage.device == NOT_WATCHED)
    finally:
        over.set()
        if filming.ident:
            filming.join()
        list(stage.finish(Finish(hurry=True)))


def test_a_port_that_is_taken_is_told() -> None:
    first = RtspServer("127.0.0.1:0")
    try:
        until(lambda: bool(first.port))
        second = RtspServer(f"127.0.0.1:{first.port}")
        try:
            until(lambda: "cannot be opened" in second.problem)
        finally:
            second.close()
        with pytest.raises(av.error.FFmpegError):
            av.open(f"rtsp://127.0.0.1:{first.port}/other", timeout=5)
    finally:
        first.close()


@pytest.mark.real_time
def test_pictures_never_wait_for_a_server_that_is_stopped() -> None:
    server = RtspServer("127.0.0.1:0")
    try:
        until(lambda: bool(server.port))
        child = server._child
        assert child is not None
        child.send_signal(19)  # SIGSTOP
        stat = Path(f"/proc/{child.pid}/stat")
        until(lambda: stat.read_text().rpartition(")")[2].split()[0] == "T")
        began_s = time.monotonic()
        taken = [server.send(bytes(100_000)) for _ in range(100)]
        assert time.monotonic() - began_s < 5.0
        # what passes its buffers to the system may come late: by number, not by which
        assert taken[0] and sum(taken) < 20
    finally:
        server.close()
