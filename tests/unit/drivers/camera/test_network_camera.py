"""Network video from a real RTSP server on loopback."""

from __future__ import annotations

import itertools
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from companion.messages import Frame, Warned
from companion.timing.clock import FlightClock
from drivers.camera import camera_feed, network_camera
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.camera_source import Picture
from drivers.camera.network_camera import NetworkCamera, without_secrets
from tests.support.cameras import rtsp_server as server
from tests.support.cameras.http_camera import HttpCamera
from tests.support.waiting import PATIENCE_S, until

PASSWORD = "s3cret"


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten seconds of H.264: a texture that moves by a pixel from one picture to the next."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    texture = np.random.default_rng(1).integers(0, 255, (15, 63), np.uint8)
    texture = np.kron(texture, np.ones((16, 16), np.uint8))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        stream.options = {"preset": "ultrafast", "tune": "zerolatency", "g": "10"}
        for k in range(300):
            picture = np.dstack([texture[:, k : k + 320]] * 3)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.fixture(scope="module")
def port(film: Path) -> Iterator[int]:
    missing = server.missing()
    if missing:
        pytest.skip(missing)
    with server.rtsp_server(film) as port:
        yield port


def camera(port: int, path: str, **keys: str) -> NetworkCamera:
    return NetworkCamera(
        CameraConfig(source="network", url=f"rtsp://127.0.0.1:{port}/{path}", **keys)  # type: ignore[arg-type]
    )


def taken(source: NetworkCamera, n: int) -> list[Picture]:
    pictures: list[Picture] = []
    deadline_s = time.monotonic() + PATIENCE_S
    while len(pictures) < n:
        assert time.monotonic() < deadline_s
        picture = source.read(0.1)
        if picture is not None:
            pictures.append(picture)
    return pictures


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_h264_by_rtsp(port: int, transport: str) -> None:
    source = camera(port, "film", transport=transport)
    source.open()
    pictures = taken(source, 12)
    source.close()
    assert pictures[0].grey.shape == (240, 320)
    assert pictures[0].rgb.shape == (240, 320, 3)
    # each is the one before, moved by a pixel for each thirtieth of a second between them
    for before, after in itertools.pairwise(pictures):
        moved = round((after.monotonic_ns - before.monotonic_ns) * 30e-9)
        shifted = before.grey[:, moved:].astype(int)
        assert np.abs(shifted - after.grey[:, : 320 - moved]).mean() < 10
        assert np.abs(before.grey.astype(int) - after.grey).mean() > 2


@pytest.mark.real_time
@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_stamps_tell_when_pictures_were_made(port: int, transport: str) -> None:
    source = camera(port, "live", transport=transport)
    source.open()
    pictures = taken(source, 20)
    arrived_ns = time.monotonic_ns()
    source.close()
    off_ms = []
    for picture in pictures:
        told = server.told_ms(picture.grey[100].tobytes())
        off = (picture.monotonic_ns // 1_000_000 - told) % (1 << server.N_BARS)
        off_ms.append(off if off < 1 << 23 else off - (1 << 24))
    assert -2 <= min(off_ms)
    assert np.median(off_ms) < 30  # making and sending them; milliseconds where nothing else runs
    assert arrived_ns - pictures[-1].monotonic_ns < 500e6


def test_a_slow_reader_gets_the_newest(port: int) -> None:
    source = camera(port, "live")
    source.open()
    try:
        (first,) = taken(source, 1)
        n_before = source.n_dropped
        until(lambda: source.n_dropped >= n_before + 5)
        (picture,) = taken(source, 1)
    finally:
        source.close()
    assert picture.monotonic_ns - first.monotonic_ns > 4.5e9 / server.RATE_HZ
    assert source.n_dropped >= n_before + 5


@pytest.mark.real_time
def test_power_lost_and_back(film: Path) -> None:
    missing = server.missing()
    if missing:
        pytest.skip(missing)
    frames: list[Frame] = []
    warned: list[Warned] = []
    came = threading.Event()

    def deliver(frame: Frame) -> None:
        frames.append(frame)
        came.set()

    with server.rtsp_server(film) as port:
        config = CameraConfig(
            source="network", url=f"rtsp://pilot:{PASSWORD}@127.0.0.1:{port}/film"
        )
        feed = CameraFeed(NetworkCamera(config), FlightClock(), config, deliver, warned.append)
        feed.start()
        assert came.wait(PATIENCE_S)
    try:
        until(lambda: feed.health.state == "missing")
        with server.rtsp_server(film, port):
            back_s = time.monotonic()
            came.clear()
            assert came.wait(PATIENCE_S)
            assert time.monotonic() - back_s < 2
            assert feed.health.n_reopened == 1
            feed.stop()
    finally:
        feed.stop()
    assert warned[0].what == camera_feed.GONE
    assert warned[-1].what == camera_feed.BACK
    assert all(PASSWORD not in each.detail for each in warned)
    assert np.all(np.diff([frame.t_ns for frame in frames]) > 0)


def test_passwords_are_used_and_never_told(film: Path, capfd: pytest.CaptureFixture[str]) -> None:
    missing = server.missing()
    if missing:
        pytest.skip(missing)
    with server.rtsp_server(film, password=PASSWORD) as port:
        url = f"rtsp://pilot:{PASSWORD}@127.0.0.1:{port}/film"
        right = NetworkCamera(CameraConfig(source="network", url=url))
        right.open()
        taken(right, 1)
        right.close()
        told = [right.name]
        for wrong in (url.replace(":s3", ":wr0ng+s3"), url.replace("film", "none?pw=" + PASSWORD)):
            source = NetworkCamera(CameraConfig(source="network", url=wrong))
            with pytest.raises(SourceError) as raised:
                source.open()
            told += [source.name, str(raised.value)]
    assert "user or password is wrong" in told[2]
    assert "404" in told[4]
    out, err = capfd.readouterr()
    assert all(PASSWORD not in text for text in [*told, out, err])


def test_nobody_there_and_nobody_answering(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        port = deaf.getsockname()[1]
        monkeypatch.setattr(network_camera, "OPEN_S", 0.3)
        with pytest.raises(SourceError, match="nothing came in time"):
            camera(port, "x").open()
    with pytest.raises(SourceError, match="connection refused"):
        camera(port, "x").open()


@pytest.mark.parametrize(
    "answer",
    [
        b"\0" * 4000,
        b"RTSP/1.0 200 OK\r\nContent-Length: 99999\r\n\r\n",
        b"HTTP/1.1 500 no\r\n\r\n",
    ],
)
def test_whatever_answers_is_one_line(answer: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_camera, "OPEN_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as odd:

        def serve() -> None:
            connection, _ = odd.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(answer)

        thread = threading.Thread(target=serve)
        thread.start()
        with pytest.raises(SourceError) as raised:
            camera(odd.getsockname()[1], "x").open()
        thread.join()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("url", "told"),
    [
        ("rtsp://u:p@cam:8554/a/b", "rtsp://cam:8554/a/b"),
        ("rtsp://cam/a?user=u&password=p", "rtsp://cam/a?…"),
        ("rtsp://u:p%40q@[::1]:554/", "rtsp://[::1]:554/"),
        ("rtsp://u:p@cam:x/", "rtsp://…"),
        ("udp://@239.0.0.1:5000", "udp://239.0.0.1:5000"),
    ],
)
def test_what_is_printed_of_an_address(url: str, told: str) -> None:
    assert without_secrets(url) == told


@pytest.mark.parametrize("url", ["/home/film.mp4", "file:///home/film.mp4"])
def test_files_are_for_another_source(url: str) -> None:
    with pytest.raises(ConfigError, match=r"camera\.source"):
        NetworkCamera(CameraConfig(source="network", url=url))


def test_no_such_protocol() -> None:
    with pytest.raises(ConfigError, match=r"camera\.url: nonsense://cam/: not a protocol"):
        NetworkCamera(CameraConfig(source="network", url="nonsense://u:p@cam/")).open()


@pytest.mark.real_time
def test_pictures_without_stamps_are_stamped_as_they_come() -> None:
    """JPEG over HTTP has none, and FFmpeg would make some up for 25 pictures a second."""
    with HttpCamera() as sender:
        network = NetworkCamera(CameraConfig(source="network", url=sender.url))
        network.open()
        pictures = [network.read(1.0) for _ in range(15)]
        network.close()
        sent_ns = sender.sent_ns
    newest = pictures[-1]
    assert newest is not None
    assert (sent_ns - newest.monotonic_ns) * 1e-9 < 0.2


def test_a_bug_in_the_decoders_thread_keeps_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise AttributeError("a bug")

    monkeypatch.setattr(network_camera, "_Newest", broken)
    with HttpCamera() as sender:
        network = NetworkCamera(CameraConfig(source="network", url=sender.url))
        with pytest.raises(AttributeError) as raised:
            network.open()
            for _ in range(30):
                network.read(0.1)
        network.close()
    assert any(each.name == "_decode" for each in raised.traceback)
