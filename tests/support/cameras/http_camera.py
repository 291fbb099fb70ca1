"""Simulated network camera: JPEG images over HTTP, valid or not.

    with HttpCamera() as camera:
        ... camera.url, camera.write_calibration(path)
        camera.frozen = True

What it films is the test pattern, from where it is told to be, or else from where every pose is
known: `world_from_body(monotonic_ns)`, which goes round faster than the pattern camera's own, so
that scale is found sooner.

    on            False: nobody answers at its port, and whoever was connected is cut off
    stalled       True: the connection stays, and nothing comes
    frozen        True: the same picture again and again
    size          (width, height) of what it sends
    markers_m     edge of landing markers that lie on its way; 0: none
    covered       True: it is dark, but for the sensor's noise
    shown         a function that gives the picture to be seen instead: grey, of any size; it comes
                  with the sensor's noise, without which a camera would be taken for a frozen one
    lost          the share of pictures that never leave it, evenly spread
    sent_ns       CLOCK_MONOTONIC of the last picture that a client was sent
"""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import cv2
import numpy as np

from companion.config import CameraConfig
from companion.geometry.transforms import Pose
from companion.messages import Bytes
from drivers.camera import pattern_camera
from drivers.camera.pattern_camera import BODY_FROM_CAMERA, PatternScene, pattern_optics
from tests.support.flights.marker_ground import CELL_PX, drawn_marker

RATE_HZ = 10
FASTER = 2.0
ROUND_S = 20
"""After this it is where it was: `world_from_body` repeats itself."""
PHASE_NS = time.monotonic_ns()
"""Pictures are due at multiples of the interval after this, which is another in each process:
flights beside each other are not to have all their pictures at once."""
ROUND: dict[tuple[tuple[int, int], int, int], bytes] = {}
"""Pictures of one round as they are sent, by size, rate and number: drawn once in a process, they
cost all further rounds and flights nothing."""
MOST_LATE_NS = 20_000_000
"""A picture that could not be sent at the time that it shows is left out."""
MARKERS_NED_M = ((6.0, 0.0), (-6.0, 0.0))
"""Places of landing markers: where its circle crosses the north axis."""
BOUNDARY = b"picture"
HEAD = (
    b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=" + BOUNDARY + b"\r\n"
    b"Cache-Control: no-cache\r\n\r\n"
)


def world_from_body(monotonic_ns: int) -> Pose:
    """Where what carries it is, in local NED."""
    return pattern_camera.world_from_body(round(monotonic_ns * FASTER))


class HttpCamera:
    """See above. One client at a time; `on` may be set before it is started."""

    def __init__(
        self, width: int = 320, height: int = 240, on: bool = True,
        world_from_body: Callable[[int], Pose] = world_from_body, rate_hz: int = RATE_HZ,
    ) -> None:  # fmt: skip
        self._world_from_body, self._rate_hz = world_from_body, rate_hz
        self._full_size = width, height
        self.heal()
        self.on = on
        self.sent_ns = 0
        self._optics = pattern_optics(CameraConfig(width=width, height=height))
        self._scene = PatternScene()
        self._last = b""
        self._noise, self._to_lose = np.random.default_rng(1), 0.0
        self._stop, self._there = threading.Event(), threading.Event()
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._port = int(probe.getsockname()[1])
        self.url = f"http://127.0.0.1:{self._port}/stream"
        self._thread = threading.Thread(target=self._live, name="http camera", daemon=True)
        self.fault: BaseException | None = None

    def __enter__(self) -> HttpCamera:
        self._thread.start()
        if self.on:
            self._there.wait(10.0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._stop.set()
        self._thread.join()
        if self.fault is not None:
            raise self.fault

    def heal(self) -> None:
        """Be there, and do as a camera should."""
        self.size, self.on, self.lost = self._full_size, True, 0.0
        self.stalled = self.frozen = self.covered = False
        self.markers_m = 0.0
        self.shown: Callable[[], Bytes] | None = None

    def write_calibration(self, path: Path, mounted: bool = True) -> Path:
        """As the daemon is given it; unless `mounted`, without the mount."""
        c, mount = self._optics, BODY_FROM_CAMERA.matrix().tolist()
        content = {
            "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
            "distortion_model": "none", "body_from_camera": mount,
        }  # fmt: skip
        if not mounted:
            del content["body_from_camera"]
        path.write_text(json.dumps(content))
        return path

    def _live(self) -> None:
        try:
            while not self._stop.is_set():
                if self.on:
                    self._be_there()
                else:
                    self._stop.wait(0.01)
        except BaseException as error:
            self.fault = error

    def _be_there(self) -> None:
        with socket.socket() as door:
            door.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            door.bind(("127.0.0.1", self._port))
            door.listen(1)
            self._there.set()
            door.settimeout(0.05)
            while self.on and not self._stop.is_set():
                try:
                    client, _ = door.accept()
                except TimeoutError:
                    continue
                with client:
                    try:
                        client.settimeout(2.0)
                        client.recv(4096)
                        client.sendall(HEAD)
                        self._film(client)
                    except OSError:
                        continue  # it has gone

    def _film(self, client: socket.socket) -> None:
        number = 0
        while self.on and not self._stop.is_set():
            # drawn beforehand for the time at which it is sent: whoever gets it takes that for its
            passed_ns = time.monotonic_ns() - PHASE_NS
            number = max(number + 1, -(-passed_ns * self._rate_hz // 10**9))
            due_ns = PHASE_NS + number * 10**9 // self._rate_hz
            picture = self._picture(number, due_ns)
            self._stop.wait((due_ns - time.monotonic_ns()) * 1e-9)
            self._to_lose += self.lost
            if self.stalled or self._to_lose >= 1.0:
                self._to_lose %= 1.0
                continue
            if time.monotonic_ns() - due_ns > MOST_LATE_NS:
                continue
            head = b"--" + BOUNDARY + b"\r\nContent-Type: image/jpeg\r\nContent-Length: "
            data = head + str(len(picture)).encode() + b"\r\n\r\n" + picture + b"\r\n"
            if self.on:  # which may have changed meanwhile
                client.sendall(data)
                self.sent_ns = time.monotonic_ns()

    def _picture(self, number: int, due_ns: int) -> bytes:
        if self.frozen and self._last:
            return self._last
        altered = self.shown or self.covered or self.markers_m or self.size != self._full_size
        if altered or self._world_from_body is not world_from_body:
            self._last = self._drawn(due_ns)
            return self._last
        key = self.size, self._rate_hz, number % (ROUND_S * self._rate_hz)
        if key not in ROUND:
            ROUND[key] = self._drawn(due_ns)
        self._last = ROUND[key]
        return self._last

    def _drawn(self, monotonic_ns: int) -> bytes:
        pose = self._world_from_body(monotonic_ns) @ BODY_FROM_CAMERA
        if self.covered:
            width, height = self._full_size
            seen = np.asarray(self._noise.integers(0, 8, (height, width, 3), np.uint8))
        elif self.shown is not None:
            still = cv2.resize(self.shown(), self.size, interpolation=cv2.INTER_AREA)
            noisy = still.astype(np.int16) + self._noise.integers(-1, 2, still.shape, np.int16)
            grey = np.clip(noisy, 0, 255).astype(np.uint8)
            seen = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.uint8)
        else:
            seen = self._scene.picture(self._optics, pose)[1]
            if self.markers_m:
                seen = self._with_markers(seen, pose)
        if seen.shape[1::-1] != self.size:
            seen = np.asarray(cv2.resize(seen, self.size), np.uint8)
        done, data = cv2.imencode(".jpg", seen[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])
        assert done
        return bytes(data)

    def _with_markers(self, picture: Bytes, pose: Pose) -> Bytes:
        """The picture with markers flat on the ground, whose tops point north."""
        sheet = np.repeat(drawn_marker("apriltag_36h11", 0)[..., None], 3, axis=2)
        n = len(sheet)
        half = n * self.markers_m / (n - 2 * CELL_PX) / 2
        corners = half * np.array([[1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0]])
        texels = np.array([[0, 0], [n, 0], [n, n], [0, n]], np.float32) - 0.5
        for north, east in MARKERS_NED_M:
            there = pose.inverse().apply(corners + [north, east, 0.0])
            if there[:, 2].min() <= 0.1:
                continue
            turned = cv2.getPerspectiveTransform(
                texels, self._optics.project(there).astype(np.float32)
            )
            size = picture.shape[1::-1]
            drawn = cv2.warpPerspective(sheet, turned, size, flags=cv2.INTER_AREA)
            mask = cv2.warpPerspective(np.full((n, n), 255, np.uint8), turned, size)
            picture = np.where(mask[..., None] > 127, drawn, picture)
        return picture
