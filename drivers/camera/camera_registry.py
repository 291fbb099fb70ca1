"""Registry of the kinds of camera that `camera.source` names."""

from __future__ import annotations

from collections.abc import Callable

from companion.config import CameraConfig
from companion.errors import ConfigError
from drivers.camera.camera_source import CameraSource


def camera_source(config: CameraConfig) -> CameraSource:
    """The configured camera, not yet opened; ConfigError where a required key is missing.

    Its library is loaded here and not before: a machine needs only the library of its own camera.
    """
    return _MAKERS[config.source](config)


def _v4l2(config: CameraConfig) -> CameraSource:
    from drivers.camera.v4l2_camera import V4l2Camera

    return V4l2Camera(config)


def _gstreamer(config: CameraConfig) -> CameraSource:
    from drivers.camera.gstreamer_camera import GstreamerCamera

    _require(config.pipeline, "camera.pipeline", 'for example "nvarguscamerasrc ! nvvidconv"')
    return GstreamerCamera(config)


def _network(config: CameraConfig) -> CameraSource:
    from drivers.camera.network_camera import NetworkCamera

    _require(config.url, "camera.url", 'for example "rtsp://192.168.1.10/stream"')
    return NetworkCamera(config)


def _file(config: CameraConfig) -> CameraSource:
    from drivers.camera.file_camera import FileCamera

    _require(config.path, "camera.path", "a flight folder, a folder of images, or a video")
    return FileCamera(config)


def _pattern(config: CameraConfig) -> CameraSource:
    from drivers.camera.pattern_camera import PatternCamera

    return PatternCamera(config)


def _require(value: str, key: str, example: str) -> None:
    if not value.strip():
        raise ConfigError(f"{key} is not set: give {example}")


_MAKERS: dict[str, Callable[[CameraConfig], CameraSource]] = {
    "v4l2": _v4l2,
    "gstreamer": _gstreamer,
    "network": _network,
    "file": _file,
    "pattern": _pattern,
}
