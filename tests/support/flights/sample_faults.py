"""The sample flight with faults."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
TIMESYNC = 111


@dataclass(frozen=True)
class Record:
    """One MAVLink message of a telemetry log, with the time of its arrival."""

    unix_us: int
    packet: bytes

    @property
    def message_id(self) -> int:
        """Of MAVLink 2."""
        return int.from_bytes(self.packet[7:10], "little")


def make_flight(
    folder: Path,
    sample: Path,
    *,
    frames: range,
    missing: Collection[int] = (),
    edit: Callable[[int, Image], Image] | None = None,
    keep: Callable[[Record, float], bool] | None = None,
) -> Path:
    """Write a flight of some frames of the sample.

    Frames are counted from the first of `frames`. Those in `missing` are neither in the video nor
    in the list; `edit` gets a frame's number and RGB image and returns what is filmed instead;
    `keep` says whether a record, so many seconds after the first frame, is in the log.
    """
    folder.mkdir()
    shutil.copyfile(sample / "camera.json", folder / "camera.json")
    stamps = [
        int(line.split(",")[1]) for line in (sample / "frames.csv").read_text().splitlines()[1:]
    ][frames.start : frames.stop]
    kept = [number for number in range(len(frames)) if number not in missing]
    rows = [f"{index},{stamps[number]}\n" for index, number in enumerate(kept)]
    (folder / "frames.csv").write_text("index,unix_ns\n" + "".join(rows))
    _write_video(folder / "camera.mp4", sample / "camera.mp4", frames, kept, edit)
    start_s = stamps[0] * 1e-9
    with (folder / "telemetry.tlog").open("wb") as log:
        for record in read_tlog(sample / "telemetry.tlog"):
            after_s = record.unix_us * 1e-6 - start_s
            if after_s < len(frames) / 10 + 1 and (keep is None or keep(record, after_s)):
                log.write(struct.pack(">Q", record.unix_us) + record.packet)
    return folder


def read_tlog(path: Path) -> Iterator[Record]:
    """Records of a log of unsigned MAVLink 2."""
    data = path.read_bytes()
    at = 0
    while at < len(data):
        (unix_us,) = struct.unpack_from(">Q", data, at)
        assert data[at + 8] == 0xFD
        assert not data[at + 10] & 1
        end = at + 8 + 12 + data[at + 9]
        yield Record(unix_us, data[at + 8 : end])
        at = end


def _write_video(
    path: Path,
    source: Path,
    frames: range,
    kept: Collection[int],
    edit: Callable[[int, Image], Image] | None,
) -> None:
    with av.open(str(source)) as reader, av.open(str(path), "w") as writer:
        stream = writer.add_stream("libx264", rate=10, options={"crf": "20", "preset": "ultrafast"})
        stream.width, stream.height, stream.pix_fmt = 640, 480, "yuv420p"
        written = 0
        for index, frame in enumerate(reader.decode(video=0)):
            if index >= frames.stop:
                break
            if index - frames.start not in kept:
                continue
            image = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
            if edit is not None:
                image = edit(index - frames.start, image)
            filmed = av.VideoFrame.from_ndarray(image, format="rgb24")
            filmed.pts, filmed.time_base = written, Fraction(1, 10)
            written += 1
            writer.mux(stream.encode(filmed))
        writer.mux(stream.encode(None))
