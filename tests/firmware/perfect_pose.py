"""Poses that are the truth, sent instead of the companion's: what a firmware reaches with them."""

from __future__ import annotations

import socket
import threading
import time
from types import TracebackType
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Pose, rotation_from_quaternion
from drivers.mavlink.measurements.pose_messages import odometry_message
from drivers.mavlink.vehicle import Firmware
from tests.firmware.ground import COMPANION, Ground

SIGMA_M, SIGMA_M_S, SIGMA_RAD = 0.02, 0.05, 0.01
ORIGIN_AFTER_S = 6.0
"""As the companion, which first waits for what an autopilot finds by itself."""


class PerfectPose:
    """Sends them over the companion's side of the cable, as often as a camera would; `with`."""

    def __init__(
        self, ground: Ground, port: int, origin: GeoOrigin, rate_hz: float, firmware: Firmware
    ) -> None:
        self._ground, self._origin, self._period_s = ground, origin, 1.0 / rate_hz
        self._firmware: Firmware = firmware
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.05)
        self._codec = mavlink.MAVLink(None, *COMPANION)
        self._over = threading.Event()
        self._silent_until_s = 0.0
        self._thread = threading.Thread(target=self._run, name="perfect pose", daemon=True)

    def __enter__(self) -> PerfectPose:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._over.set()
        self._thread.join()
        self._socket.close()

    def be_silent(self, seconds: float) -> None:
        """Send no pose for so long, as a companion that sees nothing and reckons nothing."""
        self._silent_until_s = time.time() + seconds

    def _run(self) -> None:
        cable: tuple[str, int] | None = None
        began_s, said_s, asked_s = time.time(), 0.0, 0.0
        while not self._over.wait(self._period_s):
            while True:
                try:
                    _, cable = self._socket.recvfrom(1 << 16)
                except (TimeoutError, BlockingIOError):
                    break
                self._socket.settimeout(0.0)
            if cable is None:
                continue
            now_s = time.time()
            messages: list[Any] = []
            if now_s >= self._silent_until_s:
                messages.append(odometry_message(self._true_pose(), self._firmware))
            if now_s - said_s > 1.0:
                said_s = now_s
                messages.append(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
            if now_s - began_s > ORIGIN_AFTER_S and not asked_s:
                asked_s, at = now_s, self._origin
                messages.append(mavlink.MAVLink_set_gps_global_origin_message(
                    1, round(at.latitude_deg * 1e7), round(at.longitude_deg * 1e7),
                    round(at.altitude_m * 1e3),
                ))  # fmt: skip
            for each in messages:
                self._socket.sendto(each.pack(self._codec), cable)

    def _true_pose(self) -> PoseToSend:
        newest = self._ground.true[-1]
        pose = Pose(rotation_from_quaternion(newest.quaternion), newest.place_m)
        return PoseToSend(
            time.monotonic_ns(), pose, newest.velocity_m_s, SIGMA_M, SIGMA_M_S, SIGMA_RAD,
            SIGMA_RAD, 100, 0,
        )  # fmt: skip
