"""Layouts of folders with posed images, and their detection."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import (
    Array,
    Pose,
    interpolate_rotation,
    rotation_from_quaternion,
)
from companion.messages import Bytes, Floats, Frame
from drivers.datasets.flight_folder import open_flight_folder
from drivers.datasets.posed_images import PosedImages, pictures_of, read_depth, read_rgb
from drivers.images.calibration_file import read_calibration
from drivers.images.frame_source import IMAGE_SUFFIXES
from drivers.images.text_table import numbers_of, read_rows

REMODE_FOCAL_PX = (481.2, 480.0)
"""Camera of the test set, whose images are 640 x 480."""
TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": (535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0, 0.0)),
}
TUM_CAMERA = (525.0, 525.0, 319.5, 239.5, (0.0, 0.0, 0.0, 0.0, 0.0))
TUM_TIME_DIFFERENCE_S = 0.02
POSE_GAP_S = 0.5
"""Longest interval over which poses are interpolated."""


def open_posed_images(path: Path) -> PosedImages:
    """Folder of any known layout; FlightError for any other, or an incomplete one."""
    if not path.is_dir():
        raise FlightError(f"{path}: there is no such folder")
    sequences = sorted(path.glob("*input_sequence*.txt"))
    if sequences:
        return _remode(path, sequences[0])
    if (path / "rgb.txt").exists() and (path / "groundtruth.txt").exists():
        return _tum(path)
    if (path / "poses.txt").exists() and (path / "K.txt").exists():
        return _posed_video(path)
    if (path / "trajectory.tum").exists():
        return _flight(path)
    raise FlightError(
        f"{path}: no images with poses: wanted *input_sequence*.txt (REMODE), rgb.txt and "
        "groundtruth.txt (TUM RGB-D), poses.txt and K.txt, or a flight with trajectory.tum"
    )


def _remode(path: Path, sequence: Path) -> PosedImages:
    files, poses = [], []
    flip = np.diag([1.0, -1.0, 1.0])  # the set's y axis points up, in the world and the camera
    for words in read_rows(sequence, 8):
        file = path / "Images" / words[0]
        files.append(file if file.exists() else path / "images" / words[0])
        x, y, z, *turn = numbers_of(sequence, words[1:8])
        rotation = rotation_from_quaternion(np.array([turn[3], *turn[:3]]))
        poses.append(Pose(flip @ rotation @ flip, flip @ np.array([x, y, z])))
    height, width = _size(sequence, files)
    camera = _stated(path, width, height) or Camera(
        width, height, REMODE_FOCAL_PX[0] * width / 640, REMODE_FOCAL_PX[1] * height / 480,
        (width - 1) / 2, (height - 1) / 2,
    )  # fmt: skip
    ray_length = _ray_lengths(camera)

    def truth(position: int) -> Floats | None:
        distance = read_depth(path / "truth" / f"{files[position].stem}.png", 1e4)
        return None if distance is None else np.asarray(distance / ray_length, np.float32)

    return PosedImages(
        path, "REMODE", camera, tuple(range(len(files))), tuple(poses),
        pictures_of(files, camera), truth,
    )  # fmt: skip


def _tum(path: Path) -> PosedImages:
    listing = path / "rgb.txt"
    listed = read_rows(listing, 2)
    stamps = np.array([numbers_of(listing, words[:1])[0] for words in listed])
    files = [path / words[1] for words in listed]
    pose_s, known = _tum_poses(path / "groundtruth.txt")
    height, width = _size(listing, files)
    named = next((v for k, v in TUM_CAMERAS.items() if k in path.resolve().name), TUM_CAMERA)
    camera = _stated(path, width, height)
    if camera is None:
        distortion = Distortion.RADTAN if any(named[4]) else Distortion.NONE
        coefficients = named[4] if any(named[4]) else ()
        camera = Camera(width, height, *named[:4], distortion, coefficients)
    nearest = [int(np.abs(pose_s - stamp).argmin()) for stamp in stamps]
    poses = tuple(
        known[i] if abs(pose_s[i] - stamp) <= TUM_TIME_DIFFERENCE_S else None
        for stamp, i in zip(stamps, nearest, strict=True)
    )
    depth_rows = read_rows(path / "depth.txt", 2) if (path / "depth.txt").exists() else []
    depth_s = np.array([numbers_of(path / "depth.txt", words[:1])[0] for words in depth_rows])

    def truth(position: int) -> Floats | None:
        if len(depth_s) == 0:
            return None
        i = int(np.abs(depth_s - stamps[position]).argmin())
        if abs(depth_s[i] - stamps[position]) > TUM_TIME_DIFFERENCE_S:
            return None
        return read_depth(path / depth_rows[i][1], 5000.0)

    return PosedImages(
        path, "TUM RGB-D", camera, tuple(range(len(files))), poses, pictures_of(files, camera),
        truth,
    )  # fmt: skip


def _posed_video(path: Path) -> PosedImages:
    images = path / "images"
    files = sorted(p for p in images.glob("*") if p.suffix.lower() in IMAGE_SUFFIXES)
    try:
        matrix = np.loadtxt(path / "K.txt", ndmin=2)
        poses = np.loadtxt(path / "poses.txt", ndmin=2).reshape(-1, 4, 4)
    except ValueError as error:
        raise FlightError(f"{path}: K.txt or poses.txt is damaged: {error}") from error
    if len(poses) != len(files):
        raise FlightError(f"{path}: {len(files)} images but {len(poses)} lines in poses.txt")
    height, width = _size(images, files)
    camera = Camera(width, height, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    numbers = tuple(int(f.stem) if f.stem.isdigit() else i for i, f in enumerate(files))
    return PosedImages(
        path, "posed video", camera, numbers, tuple(Pose.from_matrix(m) for m in poses),
        pictures_of(files, camera),
        lambda i: read_depth(path / "depth" / f"{files[i].stem}.png", 1e3),
    )  # fmt: skip


def _flight(path: Path) -> PosedImages:
    flight = open_flight_folder(path, CameraConfig(), TelemetryConfig())
    pose_s, known = _tum_poses(path / "trajectory.tum")
    times_ns = flight.times_ns
    numbers = flight.numbers
    position_of = {number: i for i, number in enumerate(numbers)}

    def pictures(positions: Iterable[int]) -> Iterator[tuple[int, Bytes]]:
        wanted = sorted(positions)
        if not wanted:
            return
        for message in flight.frames(times_ns[wanted[0]], times_ns[wanted[-1]] + 1):
            if isinstance(message, Frame) and position_of[message.seq] in set(wanted):
                yield position_of[message.seq], message.rgb

    return PosedImages(
        path, "flight", flight.camera, tuple(numbers),
        tuple(_pose_at(pose_s, known, t * 1e-9) for t in times_ns), pictures,
        lambda i: read_depth(path / "truth" / "depth" / f"{numbers[i]:06d}.png", 200.0),
    )  # fmt: skip


def _pose_at(pose_s: Array, poses: list[Pose], t_s: float) -> Pose | None:
    after = int(np.searchsorted(pose_s, t_s - 1e-6))
    if after < len(pose_s) and abs(pose_s[after] - t_s) < 1e-6:
        return poses[after]
    if after == 0 or after == len(pose_s) or pose_s[after] - pose_s[after - 1] > POSE_GAP_S:
        return None
    a, b = poses[after - 1], poses[after]
    share = float((t_s - pose_s[after - 1]) / (pose_s[after] - pose_s[after - 1]))
    return Pose(
        interpolate_rotation(a.rotation, b.rotation, share),
        (1 - share) * a.translation + share * b.translation,
    )


def _tum_poses(path: Path) -> tuple[Array, list[Pose]]:
    rows = [numbers_of(path, words[:8]) for words in read_rows(path, 8)]
    table = np.array(sorted(rows))
    poses = [Pose(rotation_from_quaternion(r[[7, 4, 5, 6]]), r[1:4].copy()) for r in table]
    return table[:, 0], poses


def _stated(path: Path, width: int, height: int) -> Camera | None:
    file = path / "camera.json"
    return read_calibration(file, width, height) if file.exists() else None


def _size(of: Path, files: list[Path]) -> tuple[int, int]:
    if not files:
        raise FlightError(f"{of}: no images")
    height, width = read_rgb(files[0]).shape[:2]
    return height, width


def _ray_lengths(camera: Camera) -> Array:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    n = camera.normalise(np.stack([u, v], -1))
    out: Array = np.sqrt((n**2).sum(-1) + 1)
    return out
