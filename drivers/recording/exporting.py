"""Exports a recording as a flight folder: images, their times, camera and telemetry.

Images are not encoded again: JPEG and PNG become files as they are, a video a video. Raw images
become PNG. Telemetry is the link's packets; where none were recorded, as of an import, it is the
samples.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error
import cv2
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo

from companion.config import TelemetryConfig
from companion.errors import FlightError
from drivers.mavlink.wire.packet_stream import MavlinkStream
from drivers.recording.flights_folder import TLOG
from drivers.recording.picture_codec import still
from drivers.recording.recording_as_flight import telemetry_of
from drivers.recording.recording_reader import PicturePlace, RecordingReader
from drivers.recording.recording_topics import IMAGE, RECEIVED, SENT, VIDEO, MavlinkBytes
from drivers.telemetry.telemetry_csv import NAME, telemetry_csv

MICROSECONDS = Fraction(1, 1_000_000)
NAMES = {"jpeg": "jpg", "png": "png"}


def export(recording: RecordingReader, out: Path, on_progress: Callable[[int], None]) -> None:
    """Write a recording with images as the folder `out`; `on_progress` takes the images done.

    FlightError where it cannot be written, or is not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FlightError(f"{out}: is there already; give a folder that is not, or empty")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, data in recording.found.attachments.items():
            (out / Path(name).name).write_bytes(data)
        places = recording.pictures
        packets = tlog(recording)
        if packets:
            (out / TLOG).write_bytes(packets)
        elif recording.samples:
            table = "".join(telemetry_csv(telemetry_of(recording, TelemetryConfig())))
            (out / NAME).write_text(table, encoding="utf-8")
        if recording.picture_data(places[0])[0] == VIDEO:
            places = _video(recording, out / "camera.mp4", on_progress)
        else:
            _images(recording, out / "images", on_progress)
    except OSError as error:
        raise FlightError(f"{out}: cannot be written: {error.strerror}") from error
    lines = ["index,unix_ns", *(f"{number},{place.t_ns}" for number, place in enumerate(places))]
    (out / "frames.csv").write_text("\n".join(lines) + "\n")


def tlog(recording: RecordingReader) -> bytes:
    """All packets of the link, in both directions, in the format of ground stations."""
    streams = {RECEIVED: MavlinkStream(), SENT: MavlinkStream()}
    out = []
    for number in range(len(recording.found.chunks)):
        for message in recording.messages(number):
            stream = streams.get(message.channel.topic)
            if stream is None:
                continue
            try:
                taken = MavlinkBytes.FromString(bytes(message.data))
            except ValueError:
                continue
            out += [
                struct.pack(">Q", message.t_ns // 1000) + packet.raw
                for packet in stream.feed(taken.data, taken.monotonic_ns)
            ]
    return b"".join(out)


def _images(recording: RecordingReader, folder: Path, on_progress: Callable[[int], None]) -> None:
    folder.mkdir()
    for number, place in enumerate(recording.pictures):
        topic, data = recording.picture_data(place)
        if topic == IMAGE:
            image = CompressedImage.FromString(data)
            (folder / f"{number:06d}.{NAMES.get(image.format, 'jpg')}").write_bytes(image.data)
        else:
            rgb = still(topic, data)
            if rgb is not None:
                _, png = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
                (folder / f"{number:06d}.png").write_bytes(png.tobytes())
        on_progress(number + 1)


def _video(
    recording: RecordingReader, path: Path, on_progress: Callable[[int], None]
) -> list[PicturePlace]:
    """Remux the images of a video, from the first intra picture on, into an MP4 file."""
    places = recording.pictures
    places = places[next((k for k, p in enumerate(places) if p.intra), len(places)) :]
    stream = b"".join(CompressedVideo.FromString(recording.picture_data(p)[1]).data for p in places)
    if not stream:
        raise FlightError(f"{recording.path}: none of its pictures stands alone")
    try:
        with (
            av.open(io.BytesIO(stream), "r", format="h264") as given,
            av.open(str(path), "w") as made,
        ):
            video: Any = made.add_stream_from_template(given.streams.video[0])
            number = 0
            for packet in given.demux(given.streams.video[0]):
                if not packet.size or number == len(places):
                    continue
                us = (places[number].t_ns - places[0].t_ns) // 1000
                packet.stream, packet.time_base = video, MICROSECONDS
                packet.pts = packet.dts = us
                made.mux(packet)
                number += 1
                on_progress(number)
    except (av.error.FFmpegError, ValueError) as error:
        raise FlightError(f"{path}: the video cannot be written: {error}") from error
    return places[:number]
