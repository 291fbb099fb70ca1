"""Thumbnail of a flight."""

from __future__ import annotations

from pathlib import Path

import cv2

from companion.config import CameraConfig
from companion.messages import Frame
from drivers.open_flight import open_flight

WIDTH_PX, QUALITY = 240, 80


def thumbnail(flight: Path, config: CameraConfig) -> bytes:
    """JPEG of the middle frame; empty where none can be decoded. FlightError likewise."""
    opened = open_flight(flight, config)
    middle_ns = opened.times_ns[opened.n_frames // 2]
    for frame in opened.frames(middle_ns):
        if isinstance(frame, Frame):
            height, width = frame.grey.shape
            size = WIDTH_PX, max(1, round(height * WIDTH_PX / width))
            small = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
            bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
            return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
    return b""
