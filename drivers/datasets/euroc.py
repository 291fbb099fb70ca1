"""EuRoC MAV sequences and others in ASL format: folders in `mav0/`.

The body is the frame that the sequence calls so, which is its IMU's; its axes need not be forward,
right and down, and nothing here turns them. What the sequence was measured with from outside
(`state_groundtruth_estimate0`, `leica0`, `vicon0`) is truth, not telemetry.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.estimation.attitude.attitude_by_imu import attitudes_by_imu
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose
from companion.messages import Warned
from companion.telemetry import AttitudeSample, ImuSample
from drivers.datasets.flight_folder import camera_of
from drivers.flight import Flight, TruePose
from drivers.images.calibration_file import MODELS, body_from_camera_of
from drivers.images.listed_images import listed_images
from drivers.images.picture_file import read_grey
from drivers.images.stereo_pair import Depths, StereoPair
from drivers.images.text_table import ns_of_whole, numbers_of, pose_of, read_rows
from drivers.telemetry.log_readers import aligned, unchanged
from drivers.telemetry.measured_depths import with_depths
from drivers.telemetry.telemetry_log import LogContent, Pictures, TelemetryCollector, TelemetryLog

MAX_YAML_BYTES = 100_000
SAME_EXPOSURE_NS = 1_000_000
"""Between stamps of two cameras of one exposure."""


def is_euroc(path: Path) -> bool:
    """True if a folder is an EuRoC sequence."""
    return (_mav(path) / "cam0" / "data.csv").is_file()


def open_euroc(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Camera cam0 and IMU imu0 of a sequence, depths where there is a cam1.

    FlightError where it is incomplete.
    """
    mav = _mav(path)
    listing = mav / "cam0" / "data.csv"
    rows = read_rows(listing, 2)
    stamped = [(ns_of_whole(listing, t), mav / "cam0" / "data" / name) for t, name, *_ in rows]
    source, numbers, times_ns, warnings = listed_images(listing, stamped)
    sensor = mav / "cam0" / "sensor.yaml"
    if sensor.is_file():
        camera = _camera(sensor, source.width, source.height)
    else:
        camera, assumed = camera_of(path / "camera.json", source, config, times_ns[0])
        warnings += assumed

    def read_log(pictures: Pictures) -> TelemetryLog:
        log = aligned(_imu(mav), pictures, telemetry)
        if not (mav / "cam1" / "data.csv").is_file() or "depth" not in telemetry.use:
            return log
        return _with_second(mav, log, camera, stamped)

    return Flight(
        path, camera, source, numbers, times_ns, warnings, read_log, lambda: _truth(mav, camera)
    )


def _with_second(
    mav: Path, log: TelemetryLog, camera: Camera, stamped: Sequence[tuple[int, Path]]
) -> TelemetryLog:
    """The log with depths by the second camera of a stereo pair."""
    listing = mav / "cam1" / "data.csv"
    second = [
        (ns_of_whole(listing, t), mav / "cam1" / "data" / name)
        for t, name, *_ in read_rows(listing, 2)
    ]
    sensor = mav / "cam1" / "sensor.yaml"
    other = _camera(sensor, *_size_of(sensor))
    try:
        pair = StereoPair(camera, other)
    except FlightError as error:
        why_not = Warned(stamped[0][0], "cam1 is not used", str(error))
        return replace(log, warnings=(*log.warnings, why_not))

    def measure(here: Path, there: Path) -> Depths | None:
        first = read_grey(here, camera.width, camera.height)
        grey = read_grey(there, other.width, other.height)
        return None if first is None or grey is None else pair.depths(first, grey)

    return with_depths(log, stamped, second, SAME_EXPOSURE_NS, "cam1", measure)


def _mav(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _size_of(sensor: Path) -> list[int]:
    return [int(n) for n in _list(sensor, _yaml(sensor), "resolution", 2)]


def _camera(sensor: Path, width: int, height: int) -> Camera:
    said, size = _yaml(sensor), _size_of(sensor)
    if size != [width, height]:
        raise FlightError(
            f"{sensor}: it is for pictures of {size[0]} x {size[1]}, those that are there are "
            f"{width} x {height}"
        )
    if said.get("camera_model", "pinhole") != "pinhole":
        raise FlightError(f"{sensor}: camera_model {said['camera_model']!r} is not known: pinhole")
    fx, fy, cx, cy = _list(sensor, said, "intrinsics", 4)
    if min(fx, fy) <= 0:
        raise FlightError(f"{sensor}: focal lengths must be positive, they are {fx:g} and {fy:g}")
    name = str(said.get("distortion_model", "none"))
    model = {**MODELS, "radial-tangential": Distortion.RADTAN}.get(name)
    if model is None:
        raise FlightError(f"{sensor}: distortion_model {name!r} is not known")
    given = [] if model is Distortion.NONE else _list(sensor, said, "distortion_coefficients", 4)
    more = [0.0] if model is Distortion.RADTAN else []  # the format has no k3
    return Camera(
        width, height, fx, fy, cx, cy, model, (*given, *more), _body_from_sensor(sensor, said)
    )


def _body_from_sensor(path: Path, said: Mapping[str, Any]) -> Pose | None:
    mounted = said.get("T_BS")
    matrix = _list(path, mounted, "data", 16) if isinstance(mounted, dict) else None
    return body_from_camera_of(path, None if matrix is None else np.reshape(matrix, (4, 4)))


def _yaml(path: Path) -> Mapping[str, Any]:
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise FlightError(f"{path}: too long for a sensor's description")
        # some of these files begin with a directive of OpenCV that no other parser takes
        text = path.read_text("utf-8").removeprefix("%YAML:1.0")
        said = YAML(typ="safe", pure=True).load(text)
    except OSError as error:
        raise FlightError(f"{path}: cannot be read: {error.strerror}") from error
    except (YAMLError, ValueError) as error:
        line = str(error).splitlines()[0]
        raise FlightError(f"{path}: cannot be read as YAML: {line}") from error
    if not isinstance(said, dict):
        raise FlightError(f"{path}: wanted keys and values")
    return said


def _list(path: Path, said: Mapping[str, Any], key: str, n: int) -> list[float]:
    value = said.get(key)
    if not isinstance(value, list) or len(value) != n:
        raise FlightError(f"{path}: {key} must be a list of {n} numbers, it is {value!r}"[:300])
    return numbers_of(path, [str(each) for each in value])


def _imu(mav: Path) -> LogContent:
    """Rates and accelerations, and the attitudes that follow: the format has no others."""
    listing = mav / "imu0" / "data.csv"
    collected = TelemetryCollector("imu0")
    if not listing.is_file():
        return LogContent(collected, unchanged)
    rows = read_rows(listing, 7)
    t_ns = np.array([ns_of_whole(listing, t) for t, *_ in rows], np.int64)
    values = np.array([numbers_of(listing, words[:6]) for _, *words in rows]).reshape(-1, 6)
    order = np.argsort(t_ns, kind="stable")
    t_ns, values = t_ns[order], values[order]
    finite = np.isfinite(values).all(1)
    for t, each in zip(t_ns.tolist(), values, strict=True):
        collected.add(t, 0, ImuSample(0, each[:3], each[3:]))
    if finite.any():
        found = attitudes_by_imu(t_ns[finite], values[finite, :3], values[finite, 3:])
        for t, attitude, rates in zip(t_ns[finite].tolist(), *found, strict=True):
            collected.add(t, 0, AttitudeSample(0, attitude, rates))
    return LogContent(collected, unchanged)


def _truth(mav: Path, camera: Camera) -> list[TruePose]:
    """The sequence's own estimate of its path, or else what Vicon measured."""
    listing, sensor_from_body = mav / "state_groundtruth_estimate0" / "data.csv", Pose.identity()
    if not listing.is_file():
        listing = mav / "vicon0" / "data.csv"
        if not listing.is_file():
            return []
        sensor = mav / "vicon0" / "sensor.yaml"
        sensor_from_body = (_body_from_sensor(sensor, _yaml(sensor)) or Pose.identity()).inverse()
    sensor_from_camera = sensor_from_body @ (camera.body_from_camera or Pose.identity())
    out = []
    for t, *words in read_rows(listing, 8):
        values = numbers_of(listing, words[:7])
        world_from_sensor = pose_of(listing, values[:3], values[3:])
        out.append(TruePose(ns_of_whole(listing, t), world_from_sensor @ sensor_from_camera))
    return out
