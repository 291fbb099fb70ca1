"""Message log: the output of the stages in a flight, kept once and played in real time.

Playing it costs next to nothing, so that the link is measured and not the tracker.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from companion.config import Config
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import (
    DepthMap,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    PointChunk,
    Track,
    Warned,
)
from companion.runtime.in_order import InOrder, in_order_of_time
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stages import stage_named
from companion.streaming.reduced import reduced
from companion.telemetry import PositionSample
from drivers.open_flight import open_flight

KEPT = (Track, MapUpdate, PointChunk, DepthMap, KeyframeAdded, PositionSample, Warned)
LAP = 100_000
"""Keyframes of the second round have numbers so much higher."""


@dataclass(frozen=True, slots=True)
class _Jpeg:
    seq: int
    t_ns: int
    jpeg: bytes


class MessageLogWriter:
    """Writes the messages that viewers are shown to a file."""

    def __init__(self, path: Path, camera: Camera, origin: GeoOrigin | None) -> None:
        self._camera = camera
        self._file = path.open("wb")
        pickle.dump((camera, origin), self._file)

    def take(self, message: Message) -> None:
        """Keep a message, if viewers are shown it."""
        if isinstance(message, Frame):
            bgr = cv2.cvtColor(message.rgb, cv2.COLOR_RGB2BGR)
            _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 90])
            pickle.dump(_Jpeg(message.seq, message.t_ns, jpeg.tobytes()), self._file)
        elif isinstance(message, KEPT):
            pickle.dump(reduced(message, self._camera.width), self._file)

    def __enter__(self) -> MessageLogWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()


def write_message_log(flight_path: Path, path: Path, config: Config) -> None:
    """Replay a flight once, and keep all that a viewer is shown."""
    flight = open_flight(flight_path, config.camera, config.telemetry)
    log = flight.telemetry()
    setup = Setup(config, flight.camera, origin=log.origin, is_live=False)
    with MessageLogWriter(path, flight.camera, log.origin) as writer:
        stages = InOrder(map(stage_named, ("localisation", "depth")), setup, writer.take, print)
        start_ns, stop_ns = flight.start_ns, flight.stop_ns
        samples = [s for s in log.samples if start_ns - 10**10 <= s.t_ns <= stop_ns]
        for message in in_order_of_time(samples, flight.frames(start_ns, stop_ns)):
            stages.feed(message)
        stages.finish(lambda stage: Finish(hurry=False))


class MessageLog:
    """A message log, read back."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with path.open("rb") as log:
            self.camera: Camera
            self.origin: GeoOrigin | None
            self.camera, self.origin = pickle.load(log)

    def messages(self, seconds: float) -> Iterator[Any]:
        """Messages as their time comes, stamped with now; again from the start where it ends."""
        began_ns, lap = time.monotonic_ns(), 0
        epoch_ns = time.time_ns() - began_ns
        while True:
            first_ns = last_ns = None
            lap_ns = time.monotonic_ns()
            for message in self._messages():
                if isinstance(message, Frame):
                    first_ns = message.t_ns if first_ns is None else first_ns
                    last_ns = message.t_ns
                    due_ns = lap_ns + message.t_ns - first_ns
                    if due_ns - began_ns > seconds * 1e9:
                        return
                    time.sleep(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9))
                elif isinstance(message, MapUpdate) and message.t_ns - (last_ns or 0) > 10**9:
                    continue  # of the end, when there is time for all of it
                shift_ns = lap_ns + epoch_ns - (first_ns or message.t_ns)
                if isinstance(message, Track):  # whose age is measured: that it is late is not
                    shift_ns = time.monotonic_ns() + epoch_ns - message.t_ns
                yield _moved(message, shift_ns, lap * LAP)
            lap += 1

    def _messages(self) -> Iterator[Any]:
        with self._path.open("rb") as log:
            pickle.load(log)
            while True:
                try:
                    message = pickle.load(log)
                except EOFError:
                    return
                if isinstance(message, _Jpeg):
                    bgr = cv2.imdecode(np.frombuffer(message.jpeg, np.uint8), cv2.IMREAD_COLOR)
                    assert bgr is not None
                    rgb = np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)
                    message = Frame(message.seq, message.t_ns, rgb[..., 0], rgb)
                yield message


def _moved(message: Any, shift_ns: int, number: int) -> Any:
    changes: dict[str, Any] = {"t_ns": message.t_ns + shift_ns}
    if number and isinstance(message, MapUpdate):
        changes["map_from_camera"] = {
            k + number: pose for k, pose in message.map_from_camera.items()
        }
        changes["scale_of"] = {k + number: unit for k, unit in message.scale_of.items()}
    elif number and getattr(message, "keyframe_id", None) is not None:
        changes["keyframe_id"] = message.keyframe_id + number
    return replace(message, **changes)
