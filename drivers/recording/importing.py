"""Imports any flight as a recording: its frames and samples, without loss unless asked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

from companion.config import RecorderConfig
from companion.errors import FlightError
from companion.messages import Frame, Warned
from companion.runtime.in_order import in_order_of_time
from drivers.flight import Flight
from drivers.images.camera_document import camera_document
from drivers.recording.growing_file import GrowingFile
from drivers.recording.mcap_writer import McapWriter
from drivers.recording.picture_codec import picture_encoder
from drivers.recording.recorder import CAMERA_JSON, NOTES
from drivers.recording.recording_codec import (
    calibration_bytes,
    event_bytes,
    json_bytes,
    sample_bytes,
    sample_topic,
)
from drivers.recording.recording_topics import CALIBRATION, EVENTS, HEALTH, PROFILE, open_channels

CHUNK_BYTES = 4_000_000
LOSSLESS = RecorderConfig(codec="png")
RATE_HZ = 30.0
"""Frame rate given to the encoder; irrelevant for still images."""


def write_recording(
    flight: Flight, out: Path, on_progress: Callable[[int], None],
    encoding: RecorderConfig = LOSSLESS,
) -> int:  # fmt: skip
    """Write a flight as the recording `out`, which must not exist; return the number of frames.

    `on_progress` takes the number of frames done; `encoding` is that of the pictures. FlightError
    where it cannot be written; then nothing is left.
    """
    if out.exists():
        raise FlightError(f"{out}: is there already; give another name")
    part = out.with_name(f".{out.name}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        part.unlink(missing_ok=True)
        file = GrowingFile(part)
        try:
            n = _write(flight, file, on_progress, encoding)
            file.sync()
            part.rename(out)
        except BaseException:
            file.discard()
            raise
        file.close()
    except OSError as error:
        raise FlightError(f"{out}: cannot be written: {error.strerror}") from error
    return n


def _write(
    flight: Flight, file: GrowingFile, on_progress: Callable[[int], None], encoding: RecorderConfig
) -> int:
    log = flight.telemetry()
    camera, start_ns = flight.camera, flight.start_ns
    encoder = picture_encoder(encoding, camera.width, camera.height, RATE_HZ)
    writer = McapWriter(file.append, PROFILE)
    channels = open_channels(writer)
    writer.attach(CAMERA_JSON, "application/json", camera_document(camera), 0)
    writer.note(NOTES, {"pictures": encoder.name, "imported from": flight.path.name})

    def put(topic: str, t_ns: int, data: bytes, sequence: int | None = None) -> None:
        writer.add(channels[topic], t_ns, data, t_ns, sequence)
        if writer.n_waiting_bytes > CHUNK_BYTES:
            writer.flush()

    known = {
        "clock": None if log.clock is None else dataclasses.asdict(log.clock),
        "origin": None if log.origin is None else dataclasses.asdict(log.origin),
        "warnings": [
            {"t_ns": warned.t_ns, "what": warned.what, "detail": warned.detail}
            for warned in (*flight.warnings, *log.warnings)
        ],
    }
    put(HEALTH, start_ns, json_bytes(known))
    put(CALIBRATION, start_ns, calibration_bytes(camera, start_ns))
    for warned in (*flight.warnings, *log.warnings):
        put(EVENTS, warned.t_ns, event_bytes(warned))
    n = 0
    for message in in_order_of_time(log.samples, flight.frames()):
        if isinstance(message, Frame):
            for picture in encoder.encode(message):
                put(picture.topic, picture.t_ns, picture.data, picture.seq)
            n += 1
            on_progress(n)
        elif isinstance(message, Warned):
            put(EVENTS, message.t_ns, event_bytes(message))
        else:
            put(sample_topic(message), message.t_ns, sample_bytes(message))  # type: ignore[arg-type]
    for picture in encoder.finish():
        put(picture.topic, picture.t_ns, picture.data, picture.seq)
    writer.finish()
    return n
