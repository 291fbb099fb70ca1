"""Simulated drone that flies by the poses it is sent, and nothing else.

    with FlownByVision() as drone, HttpCamera(world_from_body=drone.world_from_body) as camera:
        ... a daemon that sees `camera` and talks to `drone`
        drone.take_off(6.0)
        drone.go_to(north_m, east_m)     # from where it was when it first had a pose

Its physics are those of a point that leans into where it is told to go, in gusts. What flies it
knows its attitude, its height by barometer, and the acceleration that it feels, with a bias.
Position and velocity it takes from ODOMETRY alone, fused at the time of its stamp, as autopilots
do. As ArduPilot it takes the height of the first pose for its own, and its barometer from there.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.geometry.transforms import (
    Array,
    Pose,
    quaternion_from_euler,
    rotation_from_quaternion,
)
from drivers.camera.pattern_camera import PatternScene
from tests.support.autopilot.fake_autopilot import FakeAutopilot, Received
from tests.support.autopilot.fake_flight import MadeUpFlight

STEP_S = 0.01
GRAVITY_M_S2 = 9.80665
MAX_ACCEL_M_S2 = 2.5
MAX_SPEED_M_S = 1.5
LEAN_S = 0.15
"""Time constant of its attitude."""
DRAG_HZ = 0.15
GUST_M_S2, GUST_S = 0.25, 2.0
ACCEL_BIAS_M_S2 = np.array([0.06, -0.04, 0.0])
ACCEL_NOISE_M_S2 = 0.2
PLACE_GAIN, SPEED_GAIN, SPEED_FROM_PLACE = 0.08, 0.08, 0.06
GATE_M = 3.0
BARO_GAIN = 0.05
FORGOTTEN_S = 1.0
"""So long after the last pose it does not know where it is any more."""
KEPT_S = 1.0
LEGS_M = 0.2


@dataclass(frozen=True, slots=True)
class Moment:
    """What was true, what was believed, and what was wanted at a time."""

    monotonic_ns: int
    place: Array
    velocity: Array
    rotation: Array
    believed: Array
    wanted: Array
    has_pose: bool


class OverPattern(MadeUpFlight):
    """Over the test pattern: its rangefinder sees what its camera sees."""

    def __init__(self, world_from_body: Callable[[float], Pose]) -> None:
        super().__init__(world_from_body)
        self._tops = PatternScene().tops

    def _distance_sensor(self, t_s: float) -> Any:
        pose = self._pose(t_s)
        below = [
            height
            for height, corner, side in self._tops
            if ((pose.translation[:2] > corner) & (pose.translation[:2] < corner + side)).all()
        ]
        self._ground_m = -max(below, default=0.0)
        return super()._distance_sensor(t_s)


class FlownByVision(FakeAutopilot):
    """See above."""

    def __init__(self, firmware: str = "ardupilot", url: str = "udpin:127.0.0.1:0") -> None:
        # its way is computed in steps, whose second differences are no accelerations
        lacks = ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU")
        super().__init__(firmware, url, OverPattern(self._pose_at), gps=False, lacks=lacks)
        self._chance = np.random.default_rng(5)
        self._gust = np.zeros(3)
        self._place, self._velocity = np.array([0.0, 0.0, -LEGS_M]), np.zeros(3)
        self._lean = np.zeros(2)
        self._believed = np.array([0.0, 0.0, -LEGS_M, 0.0, 0.0, 0.0])
        self._past: deque[tuple[int, Array]] = deque(maxlen=round(KEPT_S / STEP_S))
        self._on_the_way_ns: deque[int] = deque(maxlen=100)
        self._pose_ns = 0
        self._resets: int | None = None
        self._home: Array | None = None
        self._goal = np.zeros(2)
        self._height_m = 0.0
        self._flying = False
        self._baro_shift_m = 0.0
        """What the barometer's height is taken to be off by, down."""
        self.n_refused = 0
        self.moments: list[Moment] = []
        self._stop_flying = threading.Event()
        self._pilot = threading.Thread(target=self._pilot_it, name="pilot", daemon=True)

    # -- what is asked of it ---------------------------------------------------------------------

    def start(self) -> None:
        super().start()
        self.fly(arm=False)
        self._pilot.start()

    def stop(self) -> None:
        self._stop_flying.set()
        self._pilot.join()
        super().stop()

    def take_off(self, height_m: float) -> None:
        """Arm and climb, level."""
        self.arm()
        self._height_m, self._flying = height_m, True

    def go_to(self, north_m: float, east_m: float, height_m: float | None = None) -> None:
        """Fly there, counted from where the first pose was."""
        self._goal = np.array([north_m, east_m])
        if height_m is not None:
            self._height_m = height_m

    @property
    def knows_its_place(self) -> bool:
        """Whether it flies by poses just now."""
        return self._home is not None and time.monotonic_ns() - self._pose_ns < FORGOTTEN_S * 1e9

    def world_from_body(self, monotonic_ns: int) -> Pose:
        """Where it truly is; the newest there is."""
        return self._pose_at((monotonic_ns - (self._fly_ns or 0)) * 1e-9)

    # -- physics ---------------------------------------------------------------------------------

    def _pose_at(self, flight_s: float) -> Pose:
        """At about now: for anything else its velocity is all there is to go by."""
        if not self.moments:
            return Pose(np.eye(3), np.array([0.0, 0.0, -LEGS_M]))
        newest = self.moments[-1]
        ahead_s = flight_s - (newest.monotonic_ns - (self._fly_ns or 0)) * 1e-9
        return Pose(newest.rotation, newest.place + newest.velocity * max(-0.1, min(ahead_s, 0.1)))

    def _pilot_it(self) -> None:
        due_ns = time.monotonic_ns()
        while not self._stop_flying.is_set():
            due_ns += round(STEP_S * 1e9)
            wait_s = (due_ns - time.monotonic_ns()) * 1e-9
            if wait_s > 0:
                time.sleep(wait_s)
            with self._lock:
                self._step(due_ns)

    def _step(self, now_ns: int) -> None:
        command = self._command_now(now_ns) if self._flying else np.zeros(3)
        lean = np.arctan2(command[:2], GRAVITY_M_S2)
        self._lean += (lean - self._lean) * STEP_S / LEAN_S
        normal = self._chance.standard_normal
        kick = GUST_M_S2 * math.sqrt(2 * STEP_S / GUST_S)
        self._gust += -self._gust * STEP_S / GUST_S + kick * normal(3)
        accel = np.append(GRAVITY_M_S2 * np.tan(self._lean), command[2])
        if self._flying:
            accel = accel + self._gust - DRAG_HZ * self._velocity
            self._velocity = self._velocity + accel * STEP_S
            self._place = self._place + self._velocity * STEP_S
        rotation = rotation_from_quaternion(
            quaternion_from_euler(float(self._lean[1]), -float(self._lean[0]), 0.0)
        )
        felt = accel + ACCEL_BIAS_M_S2 + ACCEL_NOISE_M_S2 * normal(3)
        self._believe(now_ns, felt)
        home = self._home if self._home is not None else np.zeros(2)
        wanted = np.append(self._goal + home, -self._height_m)
        self.moments.append(
            Moment(
                now_ns, self._place, self._velocity, rotation, self._believed[:3].copy(), wanted,
                self.knows_its_place,
            )
        )  # fmt: skip

    def _command_now(self, now_ns: int) -> Array:
        """Acceleration, from what is believed."""
        up = 1.2 * (-self._height_m - self._believed[2]) - 1.8 * self._believed[5]
        command = np.array([0.0, 0.0, float(np.clip(up, -1.5, 1.5))])
        if self.knows_its_place:
            assert self._home is not None
            way = self._goal + self._home - self._believed[:2]
            speed = 0.9 * way
            speed *= min(1.0, MAX_SPEED_M_S / max(float(np.linalg.norm(speed)), 1e-6))
            wanted = 1.6 * (speed - self._believed[3:5])
            size = max(float(np.linalg.norm(wanted)), 1e-6)
            command[:2] = wanted * min(1.0, MAX_ACCEL_M_S2 / size)
        return command

    # -- what it believes ------------------------------------------------------------------------

    def _believe(self, now_ns: int, felt: Array) -> None:
        self._believed[:3] += self._believed[3:] * STEP_S
        self._believed[3:] += felt * STEP_S
        height_error = self._place[2] + self._baro_shift_m - self._believed[2]  # by barometer
        self._believed[2] += BARO_GAIN * height_error
        self._believed[5] += BARO_GAIN * height_error
        if not self.knows_its_place:
            self._believed[3:5] *= 0.98  # nothing tells
        self._past.append((now_ns, self._believed.copy()))

    def _down(self, true: Any) -> tuple[float, float]:
        return float(self._believed[2]), float(self._believed[5])

    def _on_odometry(self, got: Received) -> None:
        super()._on_odometry(got)
        m = got.message
        taken_ns = self._taken_ns(got)
        if taken_ns is None or not self._past:
            return
        then = min(self._past, key=lambda each: abs(each[0] - taken_ns))[1]
        r = rotation_from_quaternion(np.array(m.q))
        seen = np.r_[m.x, m.y, m.z, r @ [m.vx, m.vy, m.vz]]
        error = seen - then
        begins = not self.knows_its_place
        self._pose_ns = got.monotonic_ns
        if begins or m.reset_counter != self._resets:
            self._resets = m.reset_counter
            before = self._believed[:2].copy()
            self._believed[:2] += error[:2]
            self._believed[3:5] += error[3:5]
            if begins and self.firmware == "ardupilot":
                self._believed[2] += error[2]
                self._baro_shift_m += float(error[2])
            if self._home is None:
                self._home = self._believed[:2].copy()
            elif not begins:
                self._home = self._home + self._believed[:2] - before
            self._past.clear()
            return
        if float(np.linalg.norm(error[:2])) > GATE_M:
            self.n_refused += 1
            return
        self._believed[:2] += PLACE_GAIN * error[:2]
        self._believed[3:5] += SPEED_GAIN * error[3:5] + SPEED_FROM_PLACE * error[:2]

    def _taken_ns(self, got: Received) -> int | None:
        """When the picture was taken, by CLOCK_MONOTONIC, as the firmware would have it."""
        stamp_ns = got.message.time_usec * 1000
        if self.firmware == "px4":
            offset_ns = self.peer_minus_boot_ns()
            return None if offset_ns is None else self.monotonic_ns(stamp_ns - offset_ns)
        # ArduPilot: whatever clock that is, the message that took least time took VISO_DELAY_MS
        self._on_the_way_ns.append(got.monotonic_ns - stamp_ns)
        delay_ns = round(self.parameters["VISO_DELAY_MS"] * 1e6)
        return int(stamp_ns) + min(self._on_the_way_ns) - delay_ns
