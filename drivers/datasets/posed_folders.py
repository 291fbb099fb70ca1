"""Folders of images with poses but without times, as flights: their poses are ground truth.

| layout | recognised by | poses |
|---|---|---|
| REMODE | `first_200_frames_traj_over_table_input_sequence.txt` or another `*input_sequence*.txt` | world from camera, y up |
| deep-video-mvs | `poses.txt`, `K.txt`, `images/` | world from camera, 4 x 4 a line |

A `camera.json` in the folder goes before the camera of its layout.
"""  # noqa: E501

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_quaternion
from companion.messages import Warned
from drivers.flight import Flight, TruePose
from drivers.images.calibration_file import read_calibration, read_matrix
from drivers.images.frame_source import IMAGE_SUFFIXES, ImageFolder
from drivers.images.text_table import numbers_of, read_rows
from drivers.telemetry.telemetry_log import no_telemetry

REMODE_FOCAL_PX = (481.2, 480.0)
"""Camera of the test set, whose images are 640 x 480."""
REMODE, POSED_VIDEO = "REMODE", "posed video"


def is_posed_folder(path: Path) -> bool:
    """True if a folder has one of these layouts."""
    posed_video = (path / "K.txt").is_file() and (path / "poses.txt").is_file()
    return posed_video or any(path.glob("*input_sequence*.txt"))


def open_posed_folder(path: Path, config: CameraConfig, telemetry: TelemetryConfig) -> Flight:
    """Open such a folder; FlightError where it is incomplete."""
    sequences = sorted(path.glob("*input_sequence*.txt"))
    files, poses = _remode(path, sequences[0]) if sequences else _posed_video(path)
    source = ImageFolder(path, files)
    camera = _camera(path, source.width, source.height)
    times_ns = source.own_times_ns()
    layout = REMODE if sequences else POSED_VIDEO
    warned = Warned(times_ns[0], "no times: images are taken to come at 10/s", layout)
    truth = [TruePose(*each) for each in zip(times_ns, poses, strict=True)]
    return Flight(
        path, camera, source, list(range(len(files))), times_ns, [warned], no_telemetry,
        lambda: truth,
    )  # fmt: skip


def _remode(path: Path, sequence: Path) -> tuple[list[Path], list[Pose]]:
    files, poses = [], []
    flip = np.diag([1.0, -1.0, 1.0])  # the set's y axis points up, in the world and the camera
    for words in read_rows(sequence, 8):
        file = path / "Images" / words[0]
        files.append(file if file.exists() else path / "images" / words[0])
        x, y, z, *turn = numbers_of(sequence, words[1:8])
        rotation = rotation_from_quaternion(np.array([turn[3], *turn[:3]]))
        poses.append(Pose(flip @ rotation @ flip, flip @ np.array([x, y, z])))
    return files, poses


def _posed_video(path: Path) -> tuple[list[Path], list[Pose]]:
    files = sorted(p for p in (path / "images").glob("*") if p.suffix.lower() in IMAGE_SUFFIXES)
    try:
        matrices = np.loadtxt(path / "poses.txt", ndmin=2).reshape(-1, 4, 4)
    except ValueError as error:
        raise FlightError(f"{path}: poses.txt is damaged: {error}") from error
    if len(matrices) != len(files):
        raise FlightError(f"{path}: {len(files)} images but {len(matrices)} lines in poses.txt")
    return files, [Pose.from_matrix(matrix) for matrix in matrices]


def _camera(path: Path, width: int, height: int) -> Camera:
    if (path / "camera.json").exists():
        return read_calibration(path / "camera.json", width, height)
    if (path / "K.txt").exists():
        return read_matrix(path / "K.txt", width, height)
    return Camera(
        width, height, REMODE_FOCAL_PX[0] * width / 640, REMODE_FOCAL_PX[1] * height / 480,
        (width - 1) / 2, (height - 1) / 2,
    )  # fmt: skip
