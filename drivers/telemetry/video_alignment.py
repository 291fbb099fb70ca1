"""Time alignment of a log and a video by rotation, where no clock gives it.

The camera's rotation comes from its own gyroscope, where the video has that, else from the images.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from companion.config import Measurement, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, rotation_from_quaternion, vector_from_rotation
from companion.messages import ClockReport, Frame, Warned
from companion.telemetry import AttitudeSample, ImuSample, Telemetry, is_believed
from companion.timing.image_rotation import RotationMeter
from companion.timing.rotation_alignment import RotationRecord, TimeAlignment, align_rotations
from drivers.telemetry.gpmf_gyro import gyro_rotation
from drivers.telemetry.gpmf_track import blocks_of
from drivers.telemetry.log_readers import aligned, read_log_file, read_telemetry
from drivers.telemetry.telemetry_log import Pictures, TelemetryLog

MAX_FRAMES = 6000
LEAST_SAMPLES = 20
Frames = Callable[[], Iterator[Frame | Warned]]


def read_unaligned(
    paths: Sequence[Path], pictures: Pictures, config: TelemetryConfig, camera: Camera,
    frames: Frames,
) -> TelemetryLog:  # fmt: skip
    """Log of a video with times of its own; of several the one whose rotation correlates best.

    As `expert.telemetry.align` says. FlightError where no log correlates well enough.
    """
    if not paths or config.align == "never" or config.offset_s:
        return read_telemetry(paths, pictures, config)
    free = dataclasses.replace(config, starts_with_video=True)
    logs = [(path, aligned(read_log_file(path), pictures, free)) for path in paths]
    reasons: list[str] = []
    for see in (_from_gyro, _from_images):
        seen = see(camera, frames, pictures)
        found = None if seen is None else _best(seen, logs, pictures.start_ns, config.use, reasons)
        if seen is not None and found is not None:
            return _moved(*found, seen.by_what, pictures)
    raise FlightError(
        f"{pictures.path}: no log can be put on its time by rotation ({'; '.join(reasons)}); "
        "say the shift by --offset S, seconds added to the log's times, or give frames.csv, or "
        "--set expert.telemetry.align=never to trust the clocks"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Rotation:
    by_what: str
    record: RotationRecord
    body_from_camera: Array | None
    """Rotation (3, 3), if it and the axes are known."""


def _best(
    seen: _Rotation, logs: Sequence[tuple[Path, TelemetryLog]], start_ns: int,
    use: Collection[Measurement], reasons: list[str],
) -> tuple[TelemetryLog, TimeAlignment, Path] | None:  # fmt: skip
    found = []
    for path, log in logs:
        logged = _from_log([s for s in log.samples if is_believed(s, use)], start_ns)
        if logged is None:
            reasons.append(f"{path.name} has neither rates nor attitude{_left_out(use)}")
            continue
        t_s = seen.record.t_s
        step_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
        by_turns = None
        if step_s > 0:
            by_turns = align_rotations(seen.record, logged, step_s, seen.body_from_camera)
        if by_turns is None:
            reasons.append(f"{path.name}: too little is in both")
        elif by_turns.why_not is not None:
            reasons.append(f"{path.name}: {by_turns.why_not}")
        else:
            found.append((log, by_turns, path))
    return max(found, key=lambda each: each[1].score, default=None)


def _moved(
    log: TelemetryLog, by_turns: TimeAlignment, path: Path, by_what: str, pictures: Pictures
) -> TelemetryLog:
    shift_ns = round(by_turns.offset_s * 1e9)
    samples = [dataclasses.replace(sample, t_ns=sample.t_ns + shift_ns) for sample in log.samples]
    clock = ClockReport(
        f"rotation of {by_what}", by_turns.offset_s, 0.0, by_turns.sigma_s * 1e3,
        log.clock.n_reboots if log.clock is not None else 0,
    )  # fmt: skip
    how = f"put on the time of {pictures.path.name} by rotation of {by_what}"
    remark = f"{path.name} {how}: {by_turns}"
    warnings = tuple(w for w in log.warnings if "begin with the video" not in w.what)
    return dataclasses.replace(
        log, samples=samples, clock=clock, warnings=warnings, remarks=(remark,)
    )


def _mount(camera: Camera) -> Array | None:
    return None if camera.body_from_camera is None else camera.body_from_camera.rotation


def _from_gyro(camera: Camera, frames: Frames, pictures: Pictures) -> _Rotation | None:
    """Rotation by the camera's gyroscope; None where the video has no such data."""
    turns = gyro_rotation(blocks_of(pictures.path)) if pictures.path.is_file() else None
    if turns is None:
        return None
    host_ns = pictures.host_from_file_ns(np.rint(turns.t_ns).astype(np.int64))
    t_s = np.asarray((host_ns - pictures.start_ns) * 1e-9, np.float64)
    mount = _mount(camera) if turns.axes_known else None
    return _Rotation("the camera's gyro", RotationRecord(t_s, turns.angle_rad), mount)


def _from_images(camera: Camera, frames: Frames, pictures: Pictures) -> _Rotation:
    """Rotation by the images."""
    meter = RotationMeter(camera)
    times_s: list[float] = []
    angles: list[Array] = []
    angle = np.zeros(3)
    for frame in frames():
        if not isinstance(frame, Frame):
            continue
        turn = meter.rotation(frame)
        angle = angle if turn is None else angle + turn
        times_s.append((frame.t_ns - pictures.start_ns) * 1e-9)
        angles.append(angle)
        if len(times_s) == MAX_FRAMES:
            break
    record = RotationRecord(np.array(times_s), np.array(angles).reshape(-1, 3))
    return _Rotation("the pictures", record, _mount(camera))


def _from_log(samples: Sequence[Telemetry], start_ns: int) -> RotationRecord | None:
    """Rotation by the most frequent kind of sample; times after `start_ns`."""
    rates = [(s.t_ns, s.gyro_rad_s) for s in samples if isinstance(s, ImuSample)]
    attitudes = [s for s in samples if isinstance(s, AttitudeSample)]
    if max(len(rates), len(attitudes)) < LEAST_SAMPLES:
        return None
    if len(rates) >= len(attitudes):
        t_s, gyro = _ascending([(t_ns - start_ns) * 1e-9 for t_ns, _ in rates],
                               [rate for _, rate in rates])  # fmt: skip
        turns = 0.5 * (gyro[1:] + gyro[:-1]) * np.diff(t_s)[:, None]
    else:
        t_s, quaternions = _ascending(
            [(s.t_ns - start_ns) * 1e-9 for s in attitudes], [s.ned_from_body for s in attitudes]
        )
        turned = [rotation_from_quaternion(q) for q in quaternions]
        turns = np.array([
            vector_from_rotation(a.T @ b) for a, b in pairwise(turned)
        ])  # fmt: skip
    return RotationRecord(t_s, np.vstack([np.zeros(3), np.cumsum(turns, axis=0)]))


def _left_out(use: Collection[Measurement]) -> str:
    return "" if {"imu", "attitude"} <= set(use) else " that telemetry.use lets count"


def _ascending(t_s: Sequence[float], values: Sequence[Array]) -> tuple[Array, Array]:
    times, first = np.unique(np.array(t_s), return_index=True)
    return times, np.stack(values)[first]
