"""Video with exact stamps, as the driver of network cameras takes it."""

from __future__ import annotations

import socket
import threading
import time

import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import SourceError
from drivers.camera.network_camera import NetworkCamera
from tests.firmware.picture_server import Due, PictureServer

RATE_HZ, LATENCY_S = 25.0, 0.03


class Filmed:
    """A server, and pictures for it, each brighter than the last."""

    def __init__(self) -> None:
        self.taken: list[int] = []
        self.server = PictureServer(0, RATE_HZ, self._was_sent)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._film)

    def __enter__(self) -> Filmed:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()

    def _film(self) -> None:
        seq, began_s = 0, time.time()
        while not self._stop.wait(1 / RATE_HZ):
            seq += 1
            picture = np.full((48, 64, 3), 2 * seq, np.uint8)
            exposure_s = began_s + seq / RATE_HZ
            self.server.give(Due(seq, picture, exposure_s, time.time() + LATENCY_S))

    def _was_sent(self, due: Due, late_s: float, sent: bool) -> None:
        assert late_s > -0.001
        if sent:
            self.taken.append(due.seq)


def test_the_driver_reads_pictures_and_their_times() -> None:
    with Filmed() as filmed:
        camera = NetworkCamera(CameraConfig(source="network", url=filmed.server.url))
        camera.open()
        pictures = [camera.read(2.0) for _ in range(12)]
        now_ns = time.monotonic_ns()
        camera.close()
    assert all(picture is not None for picture in pictures)
    times = [picture.monotonic_ns for picture in pictures if picture is not None]
    # video has 219 levels between black and white
    seq = [round((picture.grey[20, 30] - 16) / 219 * 127.5) for picture in pictures if picture]
    assert 0 < now_ns - times[-1] < 1e9
    # by the stamps, whenever they came
    apart = np.diff(times) * 1e-9 / np.diff(seq)
    assert np.median(apart) == pytest.approx(1 / RATE_HZ, rel=0.02)
    assert len(filmed.taken) >= 12


def test_whoever_is_shut_out_comes_back() -> None:
    with Filmed() as filmed:
        camera = NetworkCamera(CameraConfig(source="network", url=filmed.server.url))
        camera.open()
        assert camera.read(2.0) is not None
        filmed.server.shut_door()
        with pytest.raises(SourceError):
            for _ in range(60):
                camera.read(0.1)
        with pytest.raises(SourceError):
            camera.open()
        filmed.server.open_door()
        camera.open()
        assert camera.read(2.0) is not None
        camera.close()


def test_a_client_that_takes_nothing_costs_pictures_only() -> None:
    with Filmed() as filmed:
        port = int(filmed.server.url.rsplit(":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)):
            time.sleep(0.5)
        camera = NetworkCamera(CameraConfig(source="network", url=filmed.server.url))
        camera.open()
        assert camera.read(2.0) is not None
        camera.close()
