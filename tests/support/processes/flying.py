"""A daemon in flight: a camera and an autopilot with the same trajectory, and checks of poses.

    with Flying(tmp_path) as flying:
        flying.take_off()
        flying.camera.on = False
        ...
        flying.assert_true_poses()

The camera is an `HttpCamera`, whose every pose is known; the autopilot is on UDP unless `url` is
given. `daemon` is started at once, or by `start` where something is to be missing at first.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from companion.geometry.transforms import Pose
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_flight import MadeUpFlight
from tests.support.autopilot.received_poses import KINDS, Array, Poses, poses_of
from tests.support.cameras.http_camera import RATE_HZ, HttpCamera, world_from_body
from tests.support.processes.daemon_process import PROGRAM, Daemon
from tests.support.processes.strain import Strain
from tests.support.waiting import PATIENCE_S

FlyingT = TypeVar("FlyingT", bound="Flying")
PathOf = Callable[[int], Pose]
"""`world_from_body` by CLOCK_MONOTONIC, ns."""
RANGE, IMU = ("DISTANCE_SENSOR",), ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU")
STOP_S = 3.0
MOST_AWAY_M, MOST_TURNED_DEG = 1.0, 5.0
"""What a pose may be wrong by: a tenth of the distance to the ground."""
MOST_LATE_S = 0.2
"""The camera states no times, and a picture that comes so late is taken for a newer one."""
BACK_S = 2.0
"""What returns is taken up again in this time;"""
PROOF_S = 1.0
"""but a pose is believed for so long before it is sent, also after a pause of frames longer than"""
BRIDGED_S = 0.2
"""what is bridged."""
CEASE_S = 0.3
"""Poses that are no longer believed cease in this time,"""
LATENCY_S = 0.06
"""on a machine that gives the pose of a frame in this."""
N_FEATURES = 450
"""Of pictures of a quarter of the usual size, which have hardly more than these."""


class Flying:
    """See above. Settings are as after `--set`, over those that a flight needs."""

    def __init__(
        self,
        folder: Path,
        *settings: str,
        url: str = "udpin:127.0.0.1:0",
        camera_on: bool = True,
        start: bool = True,
        program: tuple[str, ...] = PROGRAM,
        path: PathOf = world_from_body,
        has_imu: bool = False,
        camera_hz: int = RATE_HZ,
    ) -> None:
        self._path = path
        self.camera = HttpCamera(on=camera_on, world_from_body=path, rate_hz=camera_hz)
        self.strain = Strain()
        # a rangefinder would tell the scale sooner, but no place to compare with the truth; and an
        # IMU is a tenth of a core, here and in the daemon, that what is measured does not need
        self.autopilot = FakeAutopilot(
            "ardupilot", url, flight_of(path), lacks=RANGE + IMU * (not has_imu)
        )
        # the flight's clock is the monotonic one, and so is what the camera films
        self.autopilot.fly(at_monotonic_ns=0, arm=False)
        calibration = self.camera.write_calibration(folder / "camera.json")
        self._folder, self._program = folder, program
        self._settings = (
            "camera.source=network", f"camera.url={self.camera.url}",
            f"camera.rate_hz={camera_hz}", f"camera.calibration={calibration}",
            f"link.url={self.autopilot.url}",
            "feedback.mode=odometry", "depth.enabled=false",
            f"expert.features.n_features={N_FEATURES}", *settings,
        )  # fmt: skip
        self.daemon = self._made()
        self._start = start
        self._open = ExitStack()

    def __enter__(self: FlyingT) -> FlyingT:
        with ExitStack() as entering:
            parts = [self.strain, self.camera, self.autopilot]
            for part in parts + [self.daemon] * self._start:
                entering.enter_context(part)  # type: ignore[arg-type]
            self._open = entering.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._open.close()

    def _made(self) -> Daemon:
        """Make a daemon, to be started."""
        return Daemon(self._folder, *self._settings, program=self._program)

    def start(self) -> None:
        """Start the daemon, where that was left for later."""
        self._open.enter_context(self.daemon)

    def start_again(self, number: signal.Signals = signal.SIGTERM) -> int:
        """End the daemon by a signal, and start another; when it was sent."""
        sent_ns = time.monotonic_ns()
        self.daemon.send(number)
        run = self.daemon.ended(60)
        assert number is not signal.SIGTERM or run.status == 0, run.status
        self.daemon = self._made()
        self.start()
        return sent_ns

    def take_off(self) -> None:
        """Arm, and wait until the autopilot has poses to fly on."""
        self.autopilot.arm()
        self.until_sending()

    def until_sending(self, timeout_s: float = PATIENCE_S) -> None:
        """Wait until poses are sent, and have come for half a second."""
        self.daemon.until(
            lambda health: health["feedback"]["sending"], "poses", timeout_s=timeout_s
        )
        now_ns = time.monotonic_ns()
        self.autopilot.wait_for("ODOMETRY", 15, PATIENCE_S, lambda got: got.monotonic_ns >= now_ns)

    def until_source(self, name: str, *states: str) -> dict[str, Any]:
        """Wait until a source is in one of these states; its part of the status."""
        health = self.daemon.until(
            lambda health: source(health, name)["state"] in states, f"{name} {states}"
        )
        return source(health, name)

    def until_stage(self, name: str, such: Any, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """Wait until a stage is as wanted; its part of the status."""
        health = self.daemon.until(
            lambda health: stage(health, name) is not None and such(stage(health, name)),
            f"{name} as wanted", timeout_s=timeout_s,
        )  # fmt: skip
        return stage(health, name) or {}

    def until_told(self, text: str, after_ns: int = 0) -> int:
        """Wait until the pilot has been told of something since a time; when that was."""
        (told,) = self.autopilot.wait_for(
            "STATUSTEXT", 1, PATIENCE_S,
            lambda got: got.monotonic_ns >= after_ns and text in got.message.text,
        )  # fmt: skip
        return told.monotonic_ns

    # -- poses -----------------------------------------------------------------------------------

    @property
    def poses(self) -> Poses:
        """All that the autopilot got."""
        return poses_of(self.autopilot.of(*KINDS))

    def errors(self, poses: Poses) -> tuple[Array, Array]:
        """What each is wrong by, metres and degrees; see `MOST_LATE_S`."""
        away_m, turned_deg = np.full((2, len(poses.stamp_us)), np.inf)
        epoch_ns = time.time_ns() - time.monotonic_ns()
        for late_s in np.arange(0.0, MOST_LATE_S, 0.02):
            stamps_ns = poses.stamp_us * 1000 - epoch_ns - round(late_s * 1e9)
            true = [self._path(int(stamp_ns)) for stamp_ns in stamps_ns]
            places = np.array([pose.translation for pose in true]).reshape(-1, 3)
            turns = np.array([pose.rotation for pose in true]).reshape(-1, 3, 3)
            cosine = (np.einsum("nij,nij->n", poses.rotations, turns) - 1) / 2
            away = np.linalg.norm(poses.place - places, axis=1)
            turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
            better = away < away_m
            away_m[better], turned_deg[better] = away[better], turned[better]
        return away_m, turned_deg

    def assert_true_poses(self) -> None:
        """None of the poses that ever left is far from the truth, and none has an old stamp."""
        poses = self.poses
        away_m, turned_deg = self.errors(poses)
        print(
            f"{len(away_m)} poses, wrong by {away_m.max(initial=0):.2f} m and"
            f" {turned_deg.max(initial=0):.1f} deg at most"
        )
        if len(away_m):
            at = int(np.argmax(away_m))
            print(
                f"worst at {poses.came_s[at] - poses.came_s[0]:.2f} s, which is said to be certain"
                f" to {poses.sigma_m[at]:.2f} m; median {np.median(away_m):.2f} m"
            )
        assert away_m.max(initial=0) < MOST_AWAY_M
        assert turned_deg.max(initial=0) < MOST_TURNED_DEG
        assert (np.diff(poses.stamp_us) > 0).all()

    def assert_ceased(self, from_ns: int, limit_s: float = CEASE_S) -> None:
        """After what happened at a time the poses cease, soon, and the pilot is told."""
        # which may have happened already, on a machine that has too much to do
        self.daemon.until(lambda health: not health["feedback"]["sending"], "no poses")
        self.daemon.until(lambda _: not self._is_told_on(), "the pilot is told")
        took_s = self.poses.last_before_pause_s(from_ns)
        late_s = 1e-3 * (self.daemon.status()["pose_latency_p95_ms"] or 0.0)
        allowed_s = self.strain.allowed_s(limit_s, from_ns) + max(0.0, late_s - LATENCY_S)
        print(f"ceased after {took_s:.3f} s of {allowed_s:.3f} s")
        assert took_s < allowed_s

    def _is_told_on(self) -> bool:
        """Whether the pilot was last told that there are poses; so it is before the first."""
        told = [t for t in self.autopilot.texts() if "vision position" in t]
        return not told or told[-1].endswith(" on")

    def assert_resumed(self, from_ns: int) -> None:
        """What returned at a time soon leads to poses again."""
        self.until_sending()
        first_ns = from_ns + round(self.poses.first_after_s(from_ns) * 1e9)
        self.assert_soon(from_ns, first_ns, BACK_S + PROOF_S)

    def assert_went_on(self, from_ns: int, longest_s: float = 0.5) -> None:
        """Since a time there was no pause between poses worth the name, and they still come."""
        self.until_sending()
        came_s = self.poses.came_s
        came_s = came_s[came_s >= from_ns * 1e-9]
        at = int(np.argmax(np.diff(came_s)))
        pause_s = float(came_s[at + 1] - came_s[at])
        allowed_s = self.strain.allowed_s(longest_s, round(came_s[at] * 1e9))
        if allowed_s - longest_s > BRIDGED_S:
            allowed_s += PROOF_S
        print(f"{len(came_s)} poses, longest pause {pause_s:.3f} s of {allowed_s:.3f} s")
        assert pause_s < allowed_s

    def assert_soon(self, from_ns: int, to_ns: int, limit_s: float = BACK_S) -> None:
        """What happened at a time was answered soon, as soon goes on this machine."""
        took_s = (to_ns - from_ns) * 1e-9
        allowed_s = self.strain.allowed_s(limit_s, from_ns)
        print(f"answered after {took_s:.3f} s of {allowed_s:.3f} s")
        assert took_s < allowed_s

    def assert_stops(self) -> None:
        """SIGTERM ends it well, and soon."""
        told_ns = time.monotonic_ns()
        took_s = self.daemon.stop()
        self.assert_soon(told_ns, told_ns + round(took_s * 1e9), STOP_S)


def source(health: dict[str, Any], name: str) -> dict[str, Any]:
    """A source's part of the status."""
    (found,) = (each for each in health["sources"] if each["name"] == name)
    return dict(found)


def stage(health: dict[str, Any], name: str) -> dict[str, Any] | None:
    """A stage's part of the status; None between flights."""
    return next((each for each in health["stages"] if each["name"] == name), None)


def flight_of(path: PathOf) -> MadeUpFlight:
    """A flight along a path, without end."""
    return MadeUpFlight(lambda t_s: path(round(t_s * 1e9)), duration_s=math.inf)
