"""Frames of a flight for exports of its run."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path

from companion.config import Config
from companion.messages import Bytes, Frame
from companion.products.export.flight_pictures import FlightPictures
from companion.products.run_folder import FinishedRun
from drivers.open_flight import open_flight


def open_pictures(path: Path, config: Config) -> Iterator[tuple[int, Bytes]]:
    """All images of the flight at `path`, with their times; FlightError where it is none."""
    flight = open_flight(path, config.camera, config.telemetry, config.mount)
    return ((frame.t_ns, frame.rgb) for frame in flight.frames() if isinstance(frame, Frame))


def pictures_of(run: FinishedRun, path: Path, config: Config) -> FlightPictures:
    """Pictures of the flight at `path`, of which `run` is a replay; FlightError where none."""
    flight = open_flight(path, config.camera, config.telemetry, config.mount)

    def frames(wanted: Collection[int]) -> Iterator[tuple[int, Bytes]]:
        if not wanted:
            return
        for frame in flight.frames(min(wanted), max(wanted) + 1):
            if isinstance(frame, Frame) and frame.t_ns in wanted:
                yield frame.t_ns, frame.rgb

    return FlightPictures(run, path, frames)
