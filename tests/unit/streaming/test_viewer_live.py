from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from companion.config import StreamConfig, ViewerConfig
from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.health import Health
from companion.messages import Frame
from companion.streaming.ground_link import GroundLink
from companion.streaming.items import Item, PictureItem, PointsItem, PoseItem, StatusItem
from companion.streaming.live_viewer import LiveViewer
from companion.streaming.onboard_viewer import GROUND
from companion.streaming.viewer.screen import DISPLAYS, GRPC_PORT, WEB_PORT, listens
from tests.support.flights import flown
from tests.support.waiting import until

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


def image(seq: int) -> Frame:
    rgb = np.random.default_rng(seq).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    return Frame(seq, flown.time_ns(2 * seq), rgb[..., 0].copy(), rgb)


@contextmanager
def hanging_peer() -> Iterator[str]:
    """The address of a server that accepts, and then neither reads nor answers."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(50)
        yield f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"


@pytest.mark.real_time
def test_a_viewer_that_hangs_neither_stalls_nor_outlives_the_flight() -> None:
    frames = [image(seq) for seq in range(30)]
    with hanging_peer() as address:
        with LiveViewer(ViewerConfig(jpeg_quality=95), CAMERA, address) as viewer:
            slowest = 0.0
            for n in range(1500):
                start = time.perf_counter()
                viewer.take(frames[n % 30])
                viewer.take(flown.track(n % flown.N_FRAMES))
                slowest = max(slowest, time.perf_counter() - start)
            assert viewer.onboard is not None
            children = [viewer.stage.pid, viewer.onboard.pid]
            start = time.perf_counter()
        assert time.perf_counter() - start < 10
        assert slowest < 0.5
        assert not any(os.path.exists(f"/proc/{child}") for child in children)


def test_an_exporter_that_dies_does_not_end_the_flight() -> None:
    with LiveViewer(ViewerConfig(), CAMERA) as viewer:
        assert viewer.stage.alive
        viewer.stage.interrupt()
        assert viewer.stage.wait(60)
        assert not viewer.stage.alive
        for seq in range(400):
            viewer.take(flown.frame(seq))
    assert viewer.n_dropped > 0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _whole(got: list[Item]) -> bool:
    """Whether the last state, all points and a picture are there; they come in any order."""
    points = {item.keyframe_id for item in got if isinstance(item, PointsItem)}
    return (
        points == set(range(12))
        and any(isinstance(item, PictureItem) for item in got)
        and any(isinstance(item, StatusItem) and item.facts.get("reduced") for item in got)
    )


def test_who_connects_sees_the_flight_of_all_of_it_the_newest() -> None:
    stream = StreamConfig(listen=f"127.0.0.1:{free_port()}")
    got: list[Item] = []
    with LiveViewer(
        ViewerConfig(), CAMERA, name="a", stream=stream, origin=GeoOrigin(47, 8, 400)
    ) as viewer:  # fmt: skip
        link = GroundLink("127.0.0.1", int(stream.listen.rsplit(":")[1]), lambda text: None)
        stop = threading.Event()
        reader = threading.Thread(target=lambda: got.extend(link.items(stop)))
        reader.start()
        viewer.take(flown.update())
        for message in flown.messages():
            viewer.take(message)
        viewer.take(Health(flown.time_ns(flown.N_FRAMES + 100), degraded="viewer off"))
        end = time.monotonic() + 20
        while time.monotonic() < end and not _whole(got):
            time.sleep(0.02)
        stop.set()
        reader.join()
    assert _whole(got)
    last = [item for item in got if isinstance(item, PoseItem)][-1]
    assert last.t_ns == flown.time_ns(flown.N_FRAMES - 1)
    true = flown.world_from_camera(flown.N_FRAMES - 1)
    assert last.world_from_camera is not None
    assert np.allclose(last.world_from_camera.translation, true.translation, atol=1e-3)
    assert np.allclose(last.world_from_camera.rotation, true.rotation, atol=1e-4)
    assert viewer.n_dropped == 0


def closed(viewer: LiveViewer) -> str:
    """Reason why nobody can connect, or ""."""
    return str(viewer.report.get("closed", ""))


def test_a_port_in_use_is_reported_and_opened_when_free() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with LiveViewer(
            ViewerConfig(), CAMERA, stream=StreamConfig(listen=f"127.0.0.1:{port}")
        ) as viewer:
            until(lambda: "in use" in closed(viewer))
            other.close()
            until(lambda: not closed(viewer))
            assert listens("127.0.0.1", port)


@pytest.mark.parametrize("where", ["rerun+http://127.0.0.1:1/proxy", "rerun+http:///proxy"])
def test_an_address_where_nothing_listens_is_bad_input(where: str) -> None:
    with pytest.raises(InputError, match="no viewer listens there") as raised:
        LiveViewer(ViewerConfig(), CAMERA, where)
    assert "\n" not in str(raised.value)


def free(port: int) -> bool:
    return not listens("127.0.0.1", port)


@pytest.mark.skipif(not (free(GRPC_PORT) and free(WEB_PORT)), reason="a viewer runs here")
def test_the_web_viewer_listens_on_loopback_only_and_ends_with_the_flight() -> None:
    with LiveViewer(ViewerConfig(), CAMERA, "web") as viewer:
        for seq in range(8):
            viewer.take(image(seq))
        assert viewer.page.startswith(f"http://127.0.0.1:{WEB_PORT}/?url=")
        with pytest.raises(InputError, match=f"port {GRPC_PORT} is taken"):
            LiveViewer(ViewerConfig(), CAMERA, "web")
        listening = {
            (line.split()[1].split(":")[0], int(line.split()[1].split(":")[1], 16))
            for table in ("tcp", "tcp6")
            for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
            if line.split()[3] == "0A"
        }
        ours = {place for place in listening if place[1] in (GRPC_PORT, WEB_PORT)}
        assert ours == {("0100007F", GRPC_PORT), ("0100007F", WEB_PORT)}  # 127.0.0.1
    assert viewer.n_dropped == 0
    assert free(GRPC_PORT) and free(WEB_PORT)


@pytest.mark.skipif(not (free(GRPC_PORT) and free(WEB_PORT)), reason="a viewer runs here")
def test_a_web_viewer_ends_with_what_it_started_where_its_caller_is_gone() -> None:
    """As where a stage is killed while its viewer starts."""
    command = [sys.executable, "-m", GROUND, "web", "1", "height", "127.0.0.1"]
    viewer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert viewer.stdout is not None and viewer.stderr is not None
    viewer.stdout.close()
    said = viewer.stderr.read()
    viewer.stderr.close()
    assert viewer.wait(60) == 1
    assert b"Traceback" not in said
    with pytest.raises(ProcessLookupError):  # of its group none is left
        os.killpg(viewer.pid, 0)


def test_view_refuses_what_is_no_host_and_what_is_no_viewer() -> None:
    for arguments, said in (
        (["drone:x", "--web"], "wanted HOST or HOST:PORT"),
        (["--viewer", "rerun+http://127.0.0.1:1/proxy"], "no viewer listens there"),
    ):
        run = subprocess.run(
            [sys.executable, "-m", "companion", "view", *arguments],
            capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert run.returncode == 2
        assert said in run.stderr and run.stderr.count("\n") == 1


@pytest.mark.skipif(not free(GRPC_PORT), reason="a viewer runs here")
@pytest.mark.parametrize("display", [{}, {"DISPLAY": ":4711"}])
def test_view_without_a_display_says_so(display: dict[str, str]) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "companion", "view", "127.0.0.1:1"],
        env={name: value for name, value in os.environ.items() if name not in DISPLAYS} | display,
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert run.returncode == 2
    assert "a window wants one" in run.stderr and "Traceback" not in run.stderr
