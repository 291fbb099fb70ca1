"""Pictures and attitudes of the flight that goes on now, read from its recording as it grows.

So a program beside the daemon sees what the camera sees, while the daemon has the camera.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel

from companion.errors import FlightError, SourceError
from companion.geometry.camera import Camera
from companion.messages import Frame
from companion.telemetry import Telemetry
from drivers.images.camera_document import camera_of
from drivers.recording.flights_folder import recordings_in
from drivers.recording.mcap_file import DAMAGED, RECORD, McapFile, McapMessage, as_stream
from drivers.recording.mcap_writer import MAGIC
from drivers.recording.picture_codec import grey_of, still
from drivers.recording.recorder import CAMERA_JSON
from drivers.recording.recording_codec import is_sample_topic, sample_of
from drivers.recording.recording_topics import PICTURES, VIDEO
from drivers.system.status_socket import ask_status


class RecordingTail:
    """Messages added to a recording from now on; FlightError where it is none.

    `camera` is that of the flight.
    """

    def __init__(self, path: Path) -> None:
        self._file = McapFile(path)
        self._at = len(MAGIC)
        self._channels: dict[int, Channel] = {}
        self._camera: Camera | None = None
        try:
            for _ in self._new_records(decoded=False):
                pass
        except BaseException:
            self.close()
            raise

    @property
    def camera(self) -> Camera:
        """Camera of the flight; FlightError where the recording does not name it."""
        if self._camera is None:
            raise FlightError(f"{self._file.path}: its camera.json is missing")
        return self._camera

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def read(self, only_newest: bool = False) -> list[Frame | Telemetry]:
        """Frames and samples added since the last call, in order of time.

        With `only_newest` at most one frame: the others are not decoded. FlightError for pictures
        that need those before them.
        """
        messages = [each for chunk in self._new_records(decoded=True) for each in chunk]
        pictures = [each for each in messages if each[0] in PICTURES]
        if only_newest:
            pictures = pictures[-1:]
        frames = (_frame(*each) for each in pictures)
        out: list[Frame | Telemetry] = [each for each in frames if each is not None]
        for topic, _, t_ns, data in messages:
            if is_sample_topic(topic):
                out.append(sample_of(topic, t_ns, data))
        out.sort(key=lambda each: each.t_ns)
        return out

    def _new_records(self, decoded: bool) -> Iterator[list[tuple[str, int, int, bytes]]]:
        """Messages of each chunk that is whole now: topic, number, time and bytes."""
        self._file.size = os.fstat(self._file.fd).st_size
        while (record := self._file.record_at(self._at)) is not None:
            opcode, at, end = record
            try:
                if opcode == Opcode.CHANNEL:
                    channel = Channel.read(as_stream(self._file.bytes_at(at + RECORD.size, end)))
                    self._channels[channel.id] = channel
                elif opcode == Opcode.ATTACHMENT:
                    each = Attachment.read(as_stream(self._file.bytes_at(at + RECORD.size, end)))
                    if each.name == CAMERA_JSON:
                        self._camera = camera_of(each.data)
                elif opcode == Opcode.CHUNK and decoded:
                    yield [
                        _copied(message)
                        for message in self._file.messages(self._file.chunk_at(at), self._channels)
                    ]
            except DAMAGED:
                pass  # a chunk whose checksum is wrong; the next one is another
            self._at = end


def running_recording(socket: Path) -> Path:
    """Recording of the flight that the daemon at a status socket records now.

    SourceError where no daemon runs, where its motors are armed, or where it records nothing.
    """
    status = ask_status(socket)
    if status.get("armed"):
        raise SourceError("the motors are armed: nothing is set up now")
    if not status.get("recording"):  # of a flight that is not kept either, before arming
        raise SourceError("no flight is recorded now: the camera is not there")
    found = recordings_in(Path(str(status["recording"])))
    if not found:
        raise SourceError("nothing is recorded, of which it would be seen: recorder.enabled = true")
    return found[-1]


def _copied(message: McapMessage) -> tuple[str, int, int, bytes]:
    return message.channel.topic, message.sequence, message.t_ns, bytes(message.data)


def _frame(topic: str, seq: int, t_ns: int, data: bytes) -> Frame | None:
    """Frame of an image by itself; None for a damaged one."""
    if topic == VIDEO:
        raise FlightError("recorder.codec is h264: set it to mjpeg while setting up")
    rgb = still(topic, data)
    return None if rgb is None else Frame(seq, t_ns, grey_of(rgb), rgb)
