"""Time span of a recording as a recording of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from companion.errors import FlightError
from drivers.recording.growing_file import GrowingFile
from drivers.recording.mcap_file import McapMessage
from drivers.recording.mcap_writer import McapWriter
from drivers.recording.recording_reader import RecordingReader
from drivers.recording.recording_topics import (
    FROM_PICTURES,
    LASTING,
    PICTURES,
    PROFILE,
    open_channels,
)

LEAD_NS = 10_000_000_000
"""Messages other than images and what was made of them are kept from this long before the first, as
a replay uses them."""
CHUNK_BYTES = 4 << 20


def trim(
    recording: RecordingReader,
    start_ns: int,
    stop_ns: int,
    out: Path,
    on_progress: Callable[[int], None],
) -> int:
    """Write start_ns <= time < stop_ns to a new file; the number of images in it.

    A video begins with the last intra picture before the span. State that holds at its begin
    (LASTING) is repeated there. FlightError where nothing is left, or the file exists or cannot be
    written. `on_progress` takes the bytes read.
    """
    first_ns = max(
        (p.t_ns for p in recording.pictures if p.intra and p.t_ns <= start_ns), default=start_ns
    )
    wanted = {(p.chunk, p.message) for p in recording.pictures if first_ns <= p.t_ns < stop_ns}
    if not any(start_ns <= p.t_ns < stop_ns for p in recording.pictures):
        raise FlightError(f"{recording.path}: there is no picture in this part")
    try:
        file = GrowingFile(out)
    except OSError as error:
        raise FlightError(f"{out}: cannot be written: {error.strerror}") from error
    try:
        _copy(recording, wanted, (first_ns, stop_ns), McapWriter(file.append, PROFILE), on_progress)
        file.sync()
    except BaseException as error:
        file.discard()
        if isinstance(error, OSError):
            raise FlightError(f"{out}: cannot be written: {error.strerror}") from error
        raise
    file.close()
    return len(wanted)


def _copy(
    recording: RecordingReader, pictures: set[tuple[int, int]], span_ns: tuple[int, int],
    writer: McapWriter, on_progress: Callable[[int], None],
) -> None:  # fmt: skip
    channels = open_channels(writer)
    found = recording.found
    for index in found.contents.attachments:
        data = found.attachments[index.name]
        writer.attach(index.name, index.media_type, data, index.log_time)
    for name, words in found.metadata.items():
        writer.note(name, words)
    writer.note("trimmed", {"from": recording.path.name})
    first_ns, stop_ns = span_ns
    lead_ns = first_ns - LEAD_NS
    held: dict[str, McapMessage] = {}

    def put(message: McapMessage, t_ns: int, publish_ns: int) -> None:
        channel, data = channels[message.channel.topic], bytes(message.data)
        writer.add(channel, t_ns, data, publish_ns, message.sequence)

    for number, chunk in enumerate(found.chunks):
        for at, message in enumerate(recording.messages(number)):
            topic = message.channel.topic
            if topic in PICTURES:
                keep = (number, at) in pictures
            else:
                from_ns = first_ns if topic in FROM_PICTURES else lead_ns
                keep = from_ns <= message.t_ns < stop_ns
            if topic in LASTING and message.t_ns < lead_ns:
                held[topic] = message
            elif keep and topic in channels:
                for before in held.values():
                    put(before, lead_ns, lead_ns)
                held.clear()
                put(message, message.t_ns, message.publish_ns)
        if writer.n_waiting_bytes > CHUNK_BYTES:
            writer.flush()
        on_progress(chunk.end)
    writer.finish()
