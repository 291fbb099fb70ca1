"""Camera on a simulated vehicle, drawn live: what it would see, as a network camera.

    python -m tests.firmware.drawn_camera --state-port 14563 --serve-port 5600 --out DIR

The vehicle is where its firmware says over MAVLink (UDP to the state port). Each picture shows it
at its exposure, is handed over a latency later, and bears the time of the exposure. The companion
takes the least late pictures for new when they arrive, so that it is told of the latency, and of a
millisecond for the wire:

    [camera] source = "network"   url = "tcp://127.0.0.1:5600"   stamp_offset_ms = -41
             calibration = "DIR/lens.toml"
    [mount]  known = true         pitch_deg = -45

DIR gets lens.toml, camera.csv (exposure in Unix time, milliseconds of drawing and of lateness,
whether the client took it) and every two seconds last.jpg. Faults come by lines on standard input,
see camera_faults.py; `quit` ends it.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import TextIO

import cv2
import numpy as np

from companion.config import MountConfig
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose
from companion.messages import Bytes
from drivers.camera.live_calibration import body_from_camera
from drivers.images.calibration_file import assumed_camera
from tests.firmware.camera_faults import Faults, parse
from tests.firmware.landmarks import landmarks_of
from tests.firmware.looks import LOOKS
from tests.firmware.picture_server import Due, PictureServer
from tests.firmware.scene import Scene
from tests.firmware.true_state import TrueState

WIDTH, HEIGHT, HFOV_DEG = 640, 480, 75.0
WAIT_S = 0.03
"""For the state at an exposure; states come every 5 ms."""
LAST_EVERY_S = 2.0


class DrawnCamera:
    """See above."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self.faults = Faults()
        self.stop = threading.Event()
        self._random = random.Random(arguments.seed)
        self._out: Path = arguments.out
        self._out.mkdir(parents=True, exist_ok=True)
        self._camera = assumed_camera(WIDTH, HEIGHT, HFOV_DEG)
        write_lens(self._camera, self._out / "lens.toml")
        scale = arguments.lens_scale
        self._camera = replace(
            self._camera, fx=scale * self._camera.fx, fy=scale * self._camera.fy
        )  # fmt: skip
        mount = MountConfig(
            known=True, roll_deg=arguments.roll_deg, pitch_deg=arguments.pitch_deg,
            yaw_deg=arguments.yaw_deg, z_m=0.0,
        )  # fmt: skip
        self._body_from_camera = body_from_camera(mount)
        self._scene = Scene(
            arguments.seed, arguments.look, self._camera, arguments.photos,
            landmarks_of(arguments.landmarks),
        )  # fmt: skip
        self._drawn_ms: dict[int, float] = {}

    def run(self) -> None:
        """Film until stopped."""
        given = self._arguments
        origin = None if given.origin is None else GeoOrigin(*given.origin)
        with (
            TrueState(given.state_port, origin) as truth,
            (self._out / "camera.csv").open("w", encoding="utf-8", buffering=1) as self._log,
        ):
            print("seq,exposure_s,drawn_ms,late_ms,sent", file=self._log)
            server = PictureServer(given.serve_port, given.rate_hz, self._was_sent)
            print(f"drawn camera: {server.url}", flush=True)
            try:
                self._film(truth, server)
            finally:
                server.close()

    def _film(self, truth: TrueState, server: PictureServer) -> None:
        period_s, seq, kept_s = 1 / self._arguments.rate_hz, 0, 0.0
        last: Bytes | None = None
        while True:
            exposure_s = (int(time.time() / period_s) + 1) * period_s
            if self.stop.wait(exposure_s - time.time()):
                return
            self._come_or_go(server, exposure_s)
            world_from_body = truth.at(exposure_s, WAIT_S)
            if world_from_body is None:
                continue
            began_s = time.perf_counter()
            if last is None or not self.faults.holds("repeat", exposure_s):
                drawn = self._scene.draw(self._seen_from(world_from_body), exposure_s)
                last = self.faults.seen(drawn, exposure_s)
            seq += 1
            self._drawn_ms[seq] = 1e3 * (time.perf_counter() - began_s)
            latency_ms = self.faults.value("latency", exposure_s, self._arguments.latency_ms)
            due = Due(seq, last, exposure_s, exposure_s + 1e-3 * latency_ms)
            lost = self._random.random() < self.faults.value("drop", exposure_s, 0.0)
            if lost or self.faults.holds("freeze", exposure_s):
                self._was_sent(due, 0.0, False)
            else:
                server.give(due)
            if exposure_s - kept_s > LAST_EVERY_S:
                kept_s = exposure_s
                keep(last, self._out / "last.jpg")

    def _seen_from(self, world_from_body: Pose) -> Pose:
        lens = world_from_body @ self._body_from_camera
        return Pose(lens.rotation, lens.translation - [0.0, 0.0, self._arguments.above_m])

    def _come_or_go(self, server: PictureServer, now_s: float) -> None:
        if self.faults.holds("gone", now_s):
            server.shut_door()
        else:
            server.open_door()

    def _was_sent(self, due: Due, late_s: float, sent: bool) -> None:
        drawn_ms = self._drawn_ms.pop(due.seq)
        row = f"{due.seq},{due.exposure_s:.6f},{drawn_ms:.1f},{1e3 * late_s:.1f},{int(sent)}"
        self._log.write(row + "\n")  # at once: two threads write


def write_lens(camera: Camera, path: Path) -> None:
    """Calibration file that the companion takes."""
    keys = "width", "height", "fx", "fy", "cx", "cy"
    lines = [f"{key} = {getattr(camera, key)!r}" for key in keys]
    path.write_text("\n".join([*lines, 'distortion_model = "none"', ""]), "utf-8")


def keep(picture: Bytes, path: Path) -> None:
    """Write a JPEG, whole at any time."""
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]))
    assert done
    beside = path.with_suffix(".part")
    beside.write_bytes(bytes(data))
    beside.replace(path)


def obey(lines: TextIO, camera: DrawnCamera) -> None:
    """Take orders until there are none; the end of the lines ends nothing."""
    for line in lines:
        if line.strip() == "quit":
            camera.stop.set()
        elif line.strip():
            try:
                camera.faults.take(parse(line), time.time())
            except ValueError as error:
                print(f"drawn camera: {error}", file=sys.stderr, flush=True)


def triple(text: str) -> tuple[float, float, float]:
    """Latitude, longitude and altitude."""
    latitude, longitude, altitude = (float(each) for each in text.split(","))
    return latitude, longitude, altitude


def _southern(words: list[str]) -> list[str]:
    """The words, where a latitude south of the equator is not taken for an option."""
    if "--origin" not in words[:-1]:
        return words
    k = words.index("--origin")
    return [*words[:k], f"--origin={words[k + 1]}", *words[k + 2 :]]


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--state-port", type=int, required=True, help="UDP, of this computer")
    parser.add_argument("--serve-port", type=int, required=True, help="TCP; 0: a free one")
    parser.add_argument("--rate-hz", type=float, default=20.0)
    parser.add_argument("--pitch-deg", type=float, default=-45.0)
    parser.add_argument("--roll-deg", type=float, default=0.0)
    parser.add_argument("--yaw-deg", type=float, default=0.0)
    parser.add_argument("--lens-scale", type=float, default=1.0, help="focal length, really")
    parser.add_argument("--above-m", type=float, default=0.0, help="lens above the vehicle's place")
    parser.add_argument("--look", choices=sorted(LOOKS), default="day")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--landmarks", default="", help="marker:NORTH:EAST,wall:NORTH")
    parser.add_argument("--photos", type=Path, help="folder of aerial photographs for the ground")
    parser.add_argument(
        "--origin", type=triple, help="LAT,LON,ALT of the scene's middle; else the first place told"
    )
    parser.add_argument("--latency-ms", type=float, default=40.0)
    parser.add_argument("--out", type=Path, required=True)
    cv2.setNumThreads(1)
    camera = DrawnCamera(parser.parse_args(_southern(sys.argv[1:])))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit())  # an Event may be locked by this thread
    threading.Thread(target=obey, args=(sys.stdin, camera), daemon=True).start()
    camera.run()


if __name__ == "__main__":
    main()
