"""`companion mount`: how a camera sits on the vehicle, by the rotations of both.

Of a recorded flight, or of the running daemon's while the vehicle is turned by hand. Nothing is
known of the mount: that of calibration and settings does not count.
"""

from __future__ import annotations

import dataclasses
import math
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.app.progress import Progress
from companion.app.replay.replay_command import RecordedInput
from companion.config import Config
from companion.errors import InputError, SourceError
from companion.estimation.attitude.mount_search import AXES, MountSearch, MountSearched
from companion.estimation.localisation import LocalisationStage
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Frame, Message, Track, TrackState
from companion.telemetry import AttitudeSample
from companion.timing.clock import StageTimes, monotonic_s, wait_s
from drivers.images.calibration_file import FORWARD_UPRIGHT
from drivers.recording.recording_tail import RecordingTail, running_recording

LOOK_EVERY_S, SILENT_S = 0.1, 6.0
MOST_BEHIND_NS = 1_500_000_000
"""Frames that are older than the newest by more are left out."""
SAY_EVERY = 5
"""Frames between two results: an estimate takes some ten milliseconds."""
HOW = {
    "roll": "lean it to the left, then to the right",
    "pitch": "lift its nose, then lower it",
    "yaw": "turn it to the left, then to the right",
}
BEGIN = "move it slowly by a hand's breadth, so that the camera sees something with texture pass"
TOO_LITTLE = "it turns too little, or not about all axes, or was tracked for too short a time"
NO_ATTITUDE = "the autopilot's attitude does not come"
NOT_RIGID = (
    "the camera does not turn as the autopilot does: is it fixed to the vehicle, and calibrated?"
)
ON_GIMBAL = "the camera is on a gimbal: there is no mount to be found"


@dataclass(frozen=True, slots=True)
class Mount:
    """A mount found: angles as in [mount], degrees."""

    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    sigma_deg: float
    delay_ms: float
    """Delay of the autopilot's stamps."""

    def __str__(self) -> str:
        """Text for the terminal: lines of a file of settings."""
        return (
            f"[mount]\nknown = true\nroll_deg = {self.roll_deg:.1f}\n"
            f"pitch_deg = {self.pitch_deg:.1f}\nyaw_deg = {self.yaw_deg:.1f}\n"
            f"# within {self.sigma_deg:.1f} degrees; the autopilot's stamps are "
            f"{self.delay_ms:+.0f} ms late"
        )


def mount_of_flight(path: Path, config: Config, progress: Progress) -> Mount:
    """Mount by a recorded flight; InputError where its rotations do not tell."""
    given = RecordedInput(path, config)
    if given.flight.camera.gimbal is not None:
        raise InputError(f"{path}: {ON_GIMBAL}")
    progress.start(given.n_frames)
    seeking = _Seeking(config, given.flight.camera)
    for message in given.messages():
        seeking.take(message)
        if isinstance(message, Frame):
            progress.update(seeking.n_frames, seeking.state.value, len(seeking.search))
    progress.finish()
    found = seeking.search.result()
    if not found.is_certain:
        why = NOT_RIGID if found.estimate is not None and not found.fits else TOO_LITTLE
        raise InputError(f"{path}: the mount is not found: {why}")
    return _mount(found)


def mount_by_hand(socket: Path, config: Config, progress: Progress) -> Mount:
    """Mount while the vehicle is turned by hand before a running daemon; as soon as it is known.

    SourceError where the daemon records nothing, or is armed.
    """
    tail = RecordingTail(running_recording(socket))
    try:
        if tail.camera.gimbal is not None:
            raise InputError(ON_GIMBAL)
        seeking = _Seeking(config, tail.camera)
        progress.start(0)
        for message in _live(tail):
            seeking.take(message)
            if not isinstance(message, Frame) or seeking.n_frames % SAY_EVERY:
                continue
            found = seeking.search.result()
            wanted = _wanted(found) if seeking.has_attitude else NO_ATTITUDE
            if seeking.state is not TrackState.TRACKING:
                wanted = BEGIN
            progress.show(**_facts(found))
            progress.update(seeking.n_frames, wanted, found.n_samples)
            if found.is_found:
                return _mount(found)
    finally:
        tail.close()
        progress.finish()
    raise SourceError("its flight has ended; begin again")


class _Seeking:
    """Localisation without a mount, and the search by its rotations."""

    def __init__(self, config: Config, camera: Camera) -> None:
        plain = dataclasses.replace(camera, body_from_camera=None)
        self._localisation = LocalisationStage(config, plain, StageTimes())
        self.search = MountSearch()
        self.n_frames = 0
        self.has_attitude = False
        self._n_maps = 0
        self.state = TrackState.INITIALISING

    def take(self, message: Message) -> None:
        """Take a frame or an attitude."""
        if isinstance(message, AttitudeSample):
            self.has_attitude = True
            self.search.add(message)
        elif isinstance(message, Frame):
            self.n_frames += 1
            for out in self._localisation.step(message):
                if isinstance(out, Track) and not out.backfilled:
                    self._tracked(out)

    def _tracked(self, track: Track) -> None:
        if track.state is TrackState.INITIALISING and self.state is not track.state:
            self._n_maps += 1
        self.state = track.state
        if track.map_from_camera is not None:
            self.search.take(track.t_ns, track.map_from_camera.rotation, self._n_maps)


def _live(tail: RecordingTail) -> Iterator[Message]:
    """All that is recorded from now on, until nothing more comes."""
    never, came_s = threading.Event(), monotonic_s()
    while True:
        new = tail.read()
        frames = [each for each in new if isinstance(each, Frame)]
        if not frames and monotonic_s() - came_s > SILENT_S:
            return
        # where this process gets too little time the newest second is enough: the map may be lost
        since_ns = frames[-1].t_ns - MOST_BEHIND_NS if frames else 0
        yield from (m for m in new if not isinstance(m, Frame) or m.t_ns > since_ns)
        if frames:
            came_s = monotonic_s()  # once they are taken, which may last longer than SILENT_S
        wait_s(never, LOOK_EVERY_S)


def _wanted(found: MountSearched) -> str:
    """Words on what is to be done next; "" where nothing is."""
    if found.estimate is None and not found.turned_rad.any():
        return BEGIN
    if found.missing:
        return HOW[found.missing[0]]
    if found.is_found:
        return ""
    return "turn it some more about all axes" if found.fits else NOT_RIGID


def _facts(found: MountSearched) -> dict[str, Any]:
    estimate = found.estimate
    known = {} if estimate is None else {
        "residual_deg": round(math.degrees(estimate.residual_rad), 2),
        "sigma_deg": np.degrees(estimate.sigma_turn_rad).round(2).tolist(),
    }  # fmt: skip
    turned = dict(zip(AXES, np.degrees(found.turned_rad).round(1).tolist(), strict=True))
    return {
        "turned_deg": turned,
        "missing": list(found.missing),
        "fits": found.fits,
        "found": known,
    }


def _mount(found: MountSearched) -> Mount:
    assert found.estimate is not None
    angles = euler_of_mount(found.estimate.body_from_camera)
    sigma_deg = math.degrees(float(np.linalg.norm(found.estimate.sigma_turn_rad)))
    return Mount(*angles, sigma_deg, found.estimate.offset_s * 1e3)


def euler_of_mount(body_from_camera: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of [mount], degrees, of a rotation (3, 3).

    Straight up or down the roll is zero: yaw then says all.
    """
    turned = body_from_camera @ FORWARD_UPRIGHT.T
    pitch = math.asin(float(np.clip(-turned[2, 0], -1.0, 1.0)))
    if abs(turned[2, 0]) > 0.99999:
        roll, yaw = 0.0, math.atan2(-turned[0, 1], turned[1, 1])
    else:
        roll = math.atan2(turned[2, 1], turned[2, 2])
        yaw = math.atan2(turned[1, 0], turned[0, 0])
    return math.degrees(roll), math.degrees(pitch), math.degrees(yaw)
