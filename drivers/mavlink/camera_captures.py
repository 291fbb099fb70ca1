"""Images and recordings on the word of a ground station, told as they are.

A recording is that of the flight, which the daemon makes anyway: to start one keeps it, whether the
motors are armed or not. To stop it ends its flight, which is denied while the motors are armed.
The protocol: https://mavlink.io/en/services/camera.html.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.pilot_messages import RECORDING_GOES_ON, RECORDING_NO_FLIGHT, PilotText
from drivers.images.still_pictures import Still, Storage
from drivers.mavlink.camera_messages import CAPTURE_STATUS, SETTINGS, STORAGE
from drivers.mavlink.ground.command_server import ACCEPTED, BUSY, DENIED, FAILED, Command, Done, Job
from drivers.mavlink.status_text import status_text

CAPABILITIES: int = (
    mavlink.CAMERA_CAP_FLAGS_CAPTURE_IMAGE
    | mavlink.CAMERA_CAP_FLAGS_CAPTURE_VIDEO
    | mavlink.CAMERA_CAP_FLAGS_CAN_CAPTURE_IMAGE_IN_VIDEO_MODE
)
URL_BYTES = 205
SINGLE = 1.0
NO_STORAGE = Storage(0.0, 0.0, 0.0)


class Stills(Protocol):
    """Keeps single images; see `StillPictures`."""

    @property
    def n_taken(self) -> int:
        """Number of the newest image."""

    @property
    def storage(self) -> Storage | None:
        """Disk of the images; None where it is not known."""

    def request(self, done: Callable[[Still], None]) -> bool:
        """Keep the next frame."""


@dataclass(frozen=True, slots=True)
class FlightRecording:
    """Recording of the flight: whether one is kept, and how to keep and to end one.

    `keep` returns None or why it cannot be; `end` False where the flight must go on.
    """

    is_kept: Callable[[], bool]
    keep: Callable[[], PilotText | None]
    end: Callable[[], bool]


NOTHING_RECORDED = FlightRecording(lambda: False, RECORDING_NO_FLIGHT, lambda: False)


class CameraCaptures:
    """Commands that take images and keep recordings; `tell` sends a message, from any thread."""

    def __init__(
        self, stills: Stills, recording: FlightRecording, boot_ms: Callable[[], int],
        unix_us: Callable[[int], int], tell: Callable[[Any], None],
    ) -> None:  # fmt: skip
        self._stills, self._recording = stills, recording
        self._boot_ms, self._unix_us, self._tell = boot_ms, unix_us, tell
        self._since_ms: int | None = None
        self._is_taking = False

    @property
    def commands(self) -> dict[int, Command]:
        """Handlers of the commands."""
        return {
            mavlink.MAV_CMD_IMAGE_START_CAPTURE: Command(self._image),
            mavlink.MAV_CMD_IMAGE_STOP_CAPTURE: Command(lambda _: Done(ACCEPTED)),
            mavlink.MAV_CMD_VIDEO_START_CAPTURE: Command(self._record),
            mavlink.MAV_CMD_VIDEO_STOP_CAPTURE: Command(self._stop),
        }

    @property
    def messages(self) -> dict[int, Callable[[], Any]]:
        """Messages that can be asked for."""
        return {CAPTURE_STATUS: self._status, STORAGE: self._storage, SETTINGS: self._settings}

    def step(self) -> None:
        """Note since when a flight is recorded; to be called once a second."""
        if not self._recording.is_kept():
            self._since_ms = None
        elif self._since_ms is None:
            self._since_ms = self._boot_ms()

    def _image(self, parameters: Sequence[float]) -> Done | Job:
        if parameters[2] not in (SINGLE, 0.0) or (parameters[2] == 0.0 and parameters[1] > 0.0):
            return Done(DENIED)  # a series of images is the recording
        job = Job()

        def done(still: Still) -> None:
            self._is_taking = False
            job.result = FAILED if still.why else ACCEPTED
            self._tell(self._captured(still))

        if not self._stills.request(done):
            return Done(BUSY)
        self._is_taking = True
        return job

    def _record(self, parameters: Sequence[float]) -> Done:
        why = self._recording.keep()
        if why is not None:
            return Done(FAILED, [status_text(why)])
        self.step()
        return Done(ACCEPTED, [self._status()])

    def _stop(self, parameters: Sequence[float]) -> Done:
        if self._recording.is_kept() and not self._recording.end():
            return Done(DENIED, [status_text(RECORDING_GOES_ON()), self._status()])
        self.step()
        return Done(ACCEPTED, [self._status()])

    def _captured(self, still: Still) -> Any:
        """CAMERA_IMAGE_CAPTURED; place and attitude are in the recording, and not told here."""
        return mavlink.MAVLink_camera_image_captured_message(
            self._boot_ms() & 0xFFFFFFFF, self._unix_us(still.t_ns), 0, 0, 0, 0, 0, [math.nan] * 4,
            still.number, 0 if still.why else 1, still.path.name.encode()[:URL_BYTES],
        )  # fmt: skip

    def _status(self) -> Any:
        now_ms, since_ms = self._boot_ms(), self._since_ms
        storage = self._stills.storage or NO_STORAGE
        return mavlink.MAVLink_camera_capture_status_message(
            now_ms & 0xFFFFFFFF, int(self._is_taking), int(since_ms is not None), 0.0,
            0 if since_ms is None else (now_ms - since_ms) & 0xFFFFFFFF,
            storage.available_mib, self._stills.n_taken,
        )  # fmt: skip

    def _storage(self) -> Any:
        """STORAGE_INFORMATION, sizes in MiB; the speeds of the disk are not known."""
        storage, status = self._stills.storage, mavlink.STORAGE_STATUS_READY
        if storage is None:  # then a ground station is to heed no sizes
            storage, status = NO_STORAGE, mavlink.STORAGE_STATUS_NOT_SUPPORTED
        return mavlink.MAVLink_storage_information_message(
            self._boot_ms() & 0xFFFFFFFF, 1, 1, status, storage.total_mib, storage.used_mib,
            storage.available_mib, math.nan, math.nan, mavlink.STORAGE_TYPE_OTHER, b"companion",
        )  # fmt: skip

    def _settings(self) -> Any:
        return mavlink.MAVLink_camera_settings_message(
            self._boot_ms() & 0xFFFFFFFF, mavlink.CAMERA_MODE_VIDEO, math.nan, math.nan
        )
