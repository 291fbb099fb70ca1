"""An open recording: index of its images, its samples, and its gaps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

from companion.errors import FlightError
from companion.messages import Bytes, Warned
from companion.telemetry import Telemetry
from drivers.recording.mcap_file import DAMAGED, ChunkPlace, McapMessage
from drivers.recording.picture_codec import still
from drivers.recording.recording_codec import is_sample_topic, sample_of
from drivers.recording.recording_topics import GREY, HEALTH, PICTURES, PROFILE, VIDEO
from drivers.recording.repair import n_cut_bytes, opened, was_cut
from drivers.video.h264_encoder import is_intra

CUT, DAMAGE = "the recording was cut short", "the recording is damaged"


class PicturePlace(NamedTuple):
    """Place of an image: its chunk, and the message in it."""

    seq: int
    t_ns: int
    chunk: int
    message: int
    intra: bool


class RecordingReader:
    """An open recording and its content; FlightError if invalid."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file, self.found = opened(path)
        self.pictures: list[PicturePlace] = []
        """In order of time, each number once."""
        self.greys: dict[int, tuple[int, int]] = {}
        """Chunk and message of a separate grey image, by the time of the image."""
        self.samples: list[Telemetry] = []
        self.health: dict[str, Any] = {}
        """Newest health document."""
        self.n_bad_messages = 0
        self.counts: dict[str, int] = {}
        """Number of readable messages, by topic."""
        self._bad: set[int] = set()
        self._held: tuple[int, list[McapMessage]] = (-1, [])
        if self.found.profile not in ("", PROFILE):
            self.file.close()
            raise FlightError(f"{path}: an MCAP file, but not a recording of companion")
        for number, chunk in enumerate(self.found.chunks):
            self._index(number, chunk)
        self.pictures = _once_in_order(self.pictures)
        self.samples.sort(key=lambda sample: sample.t_ns)

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    @property
    def warnings(self) -> tuple[Warned, ...]:
        """Warnings about missing data."""
        t_ns = self.pictures[0].t_ns if self.pictures else 0
        out = []
        n_cut, found = n_cut_bytes(self.found), self.found
        if was_cut(found):
            out.append(Warned(t_ns, CUT, f"{n_cut} bytes at its end were not whole"))
        n_lost = found.n_lost_bytes - found.n_cut_bytes
        if n_lost > 0 or self.n_bad_messages:
            detail = f"{n_lost} bytes in {found.n_lost_places} places left out"
            if self.n_bad_messages:
                detail += f", {self.n_bad_messages} messages that cannot be read"
            out.append(Warned(t_ns, DAMAGE, detail))
        return tuple(out)

    def messages(self, number: int) -> list[McapMessage]:
        """All messages of a chunk; none of a damaged one."""
        if self._held[0] != number:
            self._held = -1, []
            try:
                channels = dict(self.found.contents.channels)
                self._held = number, self.file.messages(self.found.chunks[number], channels)
            except DAMAGED:
                return []
        return self._held[1]

    def picture_data(self, place: PicturePlace) -> tuple[str, bytes]:
        """Topic and bytes of an image."""
        message = self.messages(place.chunk)[place.message]
        return message.channel.topic, bytes(message.data)

    def grey(self, t_ns: int) -> Bytes | None:
        """Grey image recorded with the one of this time, if any."""
        place = self.greys.get(t_ns)
        if place is None:
            return None
        found = self.messages(place[0])
        return still(GREY, found[place[1]].data) if place[1] < len(found) else None

    def _index(self, number: int, chunk: ChunkPlace) -> None:
        messages = self.messages(number)
        if not messages:
            self.found.n_lost_bytes += chunk.end - chunk.at
            self.found.n_lost_places += 1
            self._bad.add(number)
        for at, message in enumerate(messages):
            topic = message.channel.topic
            try:
                self._take(topic, number, at, message)
            except (ValueError, TypeError, KeyError, RecursionError):
                self.n_bad_messages += 1
                continue
            self.counts[topic] = self.counts.get(topic, 0) + 1

    def _take(self, topic: str, number: int, at: int, message: McapMessage) -> None:
        if topic in PICTURES:
            intra = topic != VIDEO or is_intra(message.data[:512])
            self.pictures.append(PicturePlace(message.sequence, message.t_ns, number, at, intra))
        elif topic == GREY:
            self.greys[message.t_ns] = number, at
        elif is_sample_topic(topic):
            self.samples.append(sample_of(topic, message.t_ns, bytes(message.data)))
        elif topic == HEALTH:
            document = json.loads(bytes(message.data))
            if isinstance(document, dict):
                self.health = document

    def lost_before(self, number: int) -> bool:
        """True if data is missing just before a chunk."""
        return self.found.chunks[number].after_loss or number - 1 in self._bad


def with_pictures(path: Path) -> RecordingReader:
    """Open a recording; FlightError where it is invalid, or has no images."""
    recording = RecordingReader(path)
    if not recording.pictures:
        recording.close()
        raise FlightError(f"{path}: there are no pictures in it")
    return recording


def _once_in_order(pictures: list[PicturePlace]) -> list[PicturePlace]:
    """Images whose number and time are both larger than those of the one before."""
    out: list[PicturePlace] = []
    for place in sorted(pictures, key=lambda each: each.seq):
        if not out or (place.seq > out[-1].seq and place.t_ns > out[-1].t_ns):
            out.append(place)
    return out
