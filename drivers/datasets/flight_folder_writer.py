"""Writes any flight as a flight folder, which reads back equal."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2

from companion.errors import FlightError
from companion.geometry.transforms import quaternion_from_rotation
from companion.messages import Frame
from drivers.flight import Flight
from drivers.images.camera_document import camera_document
from drivers.images.frame_source import ImageFolder, Video
from drivers.images.frame_times import HEADER
from drivers.telemetry.telemetry_csv import NAME, telemetry_csv

PNG_FAST = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def write_flight_folder(flight: Flight, out: Path, on_progress: Callable[[int], None]) -> int:
    """Write all of a flight into folder `out`, which must not be there yet, or be empty.

    A video and image files are copied as they are, other images become PNG. Return the number of
    frames; `on_progress` takes the number done. FlightError where it cannot be written; then
    nothing is left.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FlightError(f"{out}: is there already; give a folder that is not, or empty")
    part = out.with_name(f".{out.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            n = _write(flight, part, on_progress)
            if out.exists():
                out.rmdir()
            os.replace(part, out)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
    except OSError as error:
        raise FlightError(f"{out}: cannot be written: {error.strerror}") from error
    return n


def _write(flight: Flight, folder: Path, on_progress: Callable[[int], None]) -> int:
    log = flight.telemetry()
    listed = _pictures(flight, folder, on_progress)
    rows = [HEADER, *(f"{number},{t_ns}" for number, t_ns in listed)]
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera.json").write_bytes(camera_document(flight.camera))
    if log.samples:
        with (folder / NAME).open("w", encoding="utf-8") as file:
            file.writelines(telemetry_csv(log, flight.warnings))
    truth = flight.truth()
    if truth:
        (folder / "truth").mkdir()
        lines = []
        for t_ns, pose in truth:
            w, x, y, z = quaternion_from_rotation(pose.rotation)
            place = " ".join(f"{v:.9f}" for v in pose.translation)
            stamp = f"{t_ns // 10**9}.{t_ns % 10**9:09d}"
            lines.append(f"{stamp} {place} {x:.9f} {y:.9f} {z:.9f} {w:.9f}")
        (folder / "truth" / "world_from_camera.tum").write_text("\n".join(lines) + "\n")
    return len(listed)


def _pictures(
    flight: Flight, folder: Path, on_progress: Callable[[int], None]
) -> list[tuple[int, int]]:
    """Number in the new folder and time of each frame."""
    source = flight.source
    frames = list(zip(flight.numbers, flight.times_ns, strict=True))
    if isinstance(source, Video):
        name = "camera" + source.path.suffix.lower()
        shutil.copyfile(source.path, folder / name)
        on_progress(len(frames))
        return frames
    (folder / "images").mkdir()
    listed: list[tuple[int, int]] = []
    if isinstance(source, ImageFolder):
        for number, t_ns in frames:
            file = source.file(number)
            if file.is_file():
                name = f"{len(listed):06d}{file.suffix.lower()}"
                shutil.copyfile(file, folder / "images" / name)
                listed.append((len(listed), t_ns))
                on_progress(len(listed))
        return listed
    for frame in flight.frames():
        if isinstance(frame, Frame):
            path = folder / "images" / f"{len(listed):06d}.png"
            if not cv2.imwrite(str(path), frame.rgb[..., ::-1], PNG_FAST):
                raise OSError(5, "the picture was not written")
            listed.append((len(listed), frame.t_ns))
            on_progress(len(listed))
    return listed
