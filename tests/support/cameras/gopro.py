"""Synthetic GoPro video: blank images, and gyroscope data in a GPMF track."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from companion.geometry.transforms import Array
from tests.support.flights.logs import klv

COUNTS_PER_RAD_S = 939
BLOCK_S = 1
MS = Fraction(1, 1000)


def gyro_block(rates: Array, name: str, orientation: str = "") -> bytes:
    """One block of the track; `rates` (N, 3) rad/s in the order of the fields."""
    stream = klv("STNM", "c", 1, name.encode())
    stream += klv("SCAL", "s", 2, struct.pack(">h", COUNTS_PER_RAD_S))
    if orientation:
        stream += klv("ORIN", "c", 1, orientation.encode())
    counts = np.rint(rates * COUNTS_PER_RAD_S).astype(">i2")
    stream += klv("GYRO", "s", 6, counts.tobytes())
    return klv("DEVC", "\0", 1, klv("STRM", "\0", 1, stream))


def write_gopro(path: Path, n_frames: int, rate_hz: int, blocks: list[bytes]) -> None:
    """Grey frames, and blocks of a second each."""
    with av.open(str(path), "w") as out:
        video = out.add_stream("libx264", rate=rate_hz)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        track = out.add_data_stream("bin_data")
        track.metadata["handler_name"] = "GoPro MET"
        track.time_base = MS
        for number, block in enumerate(blocks):
            packet = av.Packet(block)
            packet.stream, packet.time_base = track, MS
            packet.pts = packet.dts = number * BLOCK_S * 1000
            packet.duration = BLOCK_S * 1000
            out.mux(packet)
        for number in range(n_frames):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 128, np.uint8))
            frame.pts = number
            out.mux(video.encode(frame))
        out.mux(video.encode())
