"""ROS bag as a flight: selects the topics of camera and telemetry."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array, Pose
from companion.messages import Warned
from companion.telemetry import Telemetry
from drivers.datasets.bag_frames import StaticFrames
from drivers.datasets.bag_pictures import BagPictures, rgb_of
from drivers.datasets.bag_reader import Bag, BagMessage, open_bag_file
from drivers.datasets.bag_samples import (
    FRD_FROM_FLU,
    fix_samples,
    imu_samples,
    odometry_samples,
    pose_samples,
    pressure_samples,
)
from drivers.datasets.flight_folder import camera_of
from drivers.flight import Flight
from drivers.telemetry.log_readers import aligned, unchanged
from drivers.telemetry.telemetry_log import GeodeticFix, LogContent, TelemetryCollector

PICTURES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
CAMERA_INFO = "sensor_msgs/CameraInfo"
IMU, FIX, ODOMETRY = "sensor_msgs/Imu", "sensor_msgs/NavSatFix", "nav_msgs/Odometry"
POSE, PRESSURE = "geometry_msgs/PoseStamped", "sensor_msgs/FluidPressure"
TRANSFORMS = "tf2_msgs/TFMessage"
BODY_FRAMES = ("base_link", "base_footprint", "body", "fcu")
MODELS = {
    "plumb_bob": Distortion.RADTAN, "rational_polynomial": Distortion.RADTAN,
    "equidistant": Distortion.EQUIDISTANT, "fisheye": Distortion.EQUIDISTANT,
}  # fmt: skip


def is_ros2_folder(path: Path) -> bool:
    """True if a folder has the metadata file of a ROS 2 bag."""
    return (path / "metadata.yaml").is_file()


def is_bag(path: Path) -> bool:
    """True if a file is a bag by its name, or a folder holds ROS 1 bags."""
    if path.is_dir():
        return any(path.glob("*.bag"))
    return path.suffix.lower() in (".bag", ".db3", ".mcap")


def open_bag(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Read a bag without its images; FlightError where there are none, or it is damaged."""
    with open_bag_file(path) as bag:
        return _Opening(path, bag, config, telemetry).flight()


class _Opening:
    """One pass through a bag."""

    def __init__(
        self, path: Path, bag: Bag, config: CameraConfig, telemetry: TelemetryConfig
    ) -> None:
        self._path, self._bag = path, bag
        self._config, self._telemetry_config = config, telemetry
        self._of_kind: dict[str, list[str]] = {}
        self._counts: dict[str, int] = {}
        for topic, (kind, n) in sorted(bag.topics().items()):
            self._of_kind.setdefault(kind, []).append(topic)
            self._counts[topic] = n
        self._remarks: list[tuple[str, str]] = []
        self._frames = StaticFrames()
        self._infos: list[Any] = []
        self._frame_id = ""
        self._size: tuple[int, int] | None = None
        self._recorded_ns: list[int] = []
        self._stamps_ns: list[int] = []
        self._held: list[tuple[str, BagMessage]] = []
        self._body: str | None = None

    def flight(self) -> Flight:
        camera_topic = self._chosen("image topics", *PICTURES, wanted=self._config.topic)
        if camera_topic is None:
            kinds = ", ".join(sorted(self._of_kind)) or "nothing"
            raise FlightError(f"{self._path}: no topic of images in this bag; there are: {kinds}")
        self._read(camera_topic)
        if self._size is None:
            raise FlightError(f"{self._path}: no picture of {camera_topic} can be decoded")
        source = BagPictures(
            self._path, camera_topic, self._recorded_ns, self._stamps_ns, self._size
        )
        self._body = self._frames.first_known(BODY_FRAMES)
        numbers, times_ns = self._in_order()
        start_ns = times_ns[0]
        camera, warnings = self._camera(camera_topic, source, start_ns)
        content = self._content()
        warnings += [Warned(start_ns, what, detail) for what, detail in self._remarks]
        return Flight(
            self._path, camera, source, numbers, times_ns, warnings,
            lambda pictures: aligned(content, pictures, self._telemetry_config),
        )  # fmt: skip

    def _chosen(self, what: str, *kinds: str, wanted: str = "") -> str | None:
        """Topic of these types with most messages."""
        found = [topic for kind in kinds for topic in self._of_kind.get(kind, [])]
        if wanted:
            if wanted not in found:
                raise FlightError(
                    f"{self._path}: expert.camera.topic {wanted!r} is none of its {what}: "
                    + (", ".join(found) or "there are none")
                )
            return wanted
        found = [topic for topic in found if self._counts[topic]]
        if not found:
            return None
        taken = max(found, key=lambda topic: self._counts[topic])
        if len(found) > 1:
            self._remarks.append((f"several {what}", f"{', '.join(found)}; taken: {taken}"))
        return taken

    def _read(self, camera_topic: str) -> None:
        fixes = self._chosen("topics of satellite fixes", FIX)
        odometry = self._chosen("odometry topics", ODOMETRY)
        poses = None if odometry else self._chosen("topics of poses", POSE)
        local = odometry or poses
        if fixes and local:
            # the heading of an odometry's frame is anybody's, that of satellite fixes north
            detail = f"{local}; places are those of {fixes}"
            self._remarks.append(("odometry beside satellite fixes is not used", detail))
            local = None
        wanted = {
            topic: kind
            for topic, kind in (
                (fixes, FIX), (local, ODOMETRY if odometry else POSE),
                (self._chosen("IMU topics", IMU), IMU),
                (self._chosen("topics of pressure", PRESSURE), PRESSURE),
            )
            if topic is not None
        }  # fmt: skip
        infos = [topic for topic in self._of_kind.get(CAMERA_INFO, [])
                 if _place(topic) == _place(camera_topic)]  # fmt: skip
        statics = [t for t in self._of_kind.get(TRANSFORMS, []) if t.endswith("tf_static")]
        try:
            for message in self._bag.messages([camera_topic, *wanted, *infos, *statics]):
                if message.topic == camera_topic:
                    self._picture(message)
                elif message.topic in wanted:
                    self._held.append((wanted[message.topic], message))
                elif message.topic in statics or not self._infos:
                    decoded = self._bag.decoded(message)
                    if decoded is not None and message.topic in statics:
                        self._frames.take(decoded)
                    elif decoded is not None:
                        self._infos.append(decoded)
        except FlightError as error:
            if not self._recorded_ns:
                raise
            self._remarks.append(("the bag is damaged and ends early", str(error)))

    def _picture(self, message: BagMessage) -> None:
        self._recorded_ns.append(message.recorded_ns)
        self._stamps_ns.append(self._bag.stamp_ns(message))
        if self._size is None:
            decoded = self._bag.decoded(message)
            try:
                rgb = rgb_of(decoded) if decoded is not None else None
            except FlightError as error:
                raise FlightError(f"{self._path}: {message.topic}: {error}") from error
            if rgb is not None and decoded is not None:
                self._size = rgb.shape[1], rgb.shape[0]
                self._frame_id = str(decoded.header.frame_id)

    def _in_order(self) -> tuple[list[int], list[int]]:
        numbers: list[int] = []
        times_ns: list[int] = []
        for number, t_ns in enumerate(self._stamps_ns):
            if not times_ns or t_ns > times_ns[-1]:
                numbers.append(number)
                times_ns.append(t_ns)
        left_out = len(self._stamps_ns) - len(numbers)
        if left_out:
            self._remarks.append(("frames out of order left out", f"{left_out} in the bag"))
        return numbers, times_ns

    def _camera(
        self, topic: str, source: BagPictures, start_ns: int
    ) -> tuple[Camera, list[Warned]]:
        beside = self._path.with_suffix(".json")
        info = self._infos[0] if self._infos else None
        if beside.exists() or info is None or not np.any(_field(info, "k")):
            return camera_of(beside, source, self._config, start_ns)
        if (info.width, info.height) != (source.width, source.height):
            raise FlightError(
                f"{self._path}: its camera_info is for pictures of {info.width} x {info.height}, "
                f"those of {topic} are {source.width} x {source.height}; give {beside.name}"
            )
        rectified = "rect" in topic.rsplit("/", 2)[-1] or "rect" in topic.rsplit("/", 2)[-2]
        matrix = np.reshape(_field(info, "p"), (3, 4)) if rectified else _field(info, "k")
        m = np.asarray(matrix, np.float64).reshape(3, -1)
        model, given = self._lens(info, rectified)
        fx, fy, cx, cy = float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2])
        if not (np.isfinite(m).all() and min(fx, fy) > 0):
            raise FlightError(f"{self._path}: its camera_info has no focal length")
        camera = Camera(
            source.width, source.height, fx, fy, cx, cy, model, given, self._body_from_camera()
        )
        return camera, []

    def _lens(self, info: Any, rectified: bool) -> tuple[Distortion, tuple[float, ...]]:
        given = tuple(float(v) for v in _field(info, "d"))
        if rectified or not any(given):
            return Distortion.NONE, ()
        model = MODELS.get(str(info.distortion_model))
        n = 4 if model is Distortion.EQUIDISTANT else 5
        if model is None or any(given[n:]) or not np.isfinite(given).all():
            raise FlightError(
                f"{self._path}: lens model {str(info.distortion_model)[:40]!r} with {len(given)} "
                f"coefficients is not known; give {self._path.with_suffix('.json').name}"
            )
        return model, (*given[:n], *([0.0] * (n - len(given))))

    def _body_from_camera(self) -> Pose | None:
        if self._body is None:
            return None
        found = self._frames.between(self._body, self._frame_id)
        return None if found is None else Pose(FRD_FROM_FLU, np.zeros(3)) @ found

    def _content(self) -> LogContent:
        collected = TelemetryCollector(self._path.name)
        with_fixes = any(kind == FIX for kind, _ in self._held)
        with_local = any(kind in (ODOMETRY, POSE) for kind, _ in self._held)
        if with_fixes:
            what = "heights of NavSatFix are above the ellipsoid"
            self._remarks.append((what, "they are taken for heights above the sea"))
        for kind, message in self._held:
            decoded = self._bag.decoded(message)
            if decoded is None:
                collected.count("damaged messages in the bag left out")
                continue
            for sample in self._samples(kind, decoded, not with_local):
                collected.add(self._bag.stamp_ns(message), 0, sample)
        self._held.clear()
        return LogContent(collected, unchanged)

    def _samples(
        self, kind: str, message: Any, imu_attitude: bool
    ) -> Iterator[Telemetry | GeodeticFix]:
        if kind == IMU:
            turn = self._body_from(str(message.header.frame_id)).rotation
            yield from imu_samples(message, turn, imu_attitude)
        elif kind == ODOMETRY:
            yield from odometry_samples(message, self._body_from(str(message.child_frame_id)))
        elif kind == POSE:
            yield from pose_samples(message)
        elif kind == FIX:
            yield from fix_samples(message)
        else:
            yield from pressure_samples(message)

    def _body_from(self, frame: str) -> Pose:
        found = self._frames.between(self._body, frame) if self._body and frame else None
        return found or Pose.identity()


def _place(topic: str) -> str:
    """Namespace of a camera: compressed images lie one level deeper."""
    topic = topic.removesuffix("/compressed")
    return topic.rpartition("/")[0]


def _field(info: Any, name: str) -> Array:
    """A field of CameraInfo: ROS 1 has upper-case names."""
    return np.asarray(getattr(info, name, getattr(info, name.upper(), ())), np.float64)
