"""True depth of the images of a data set, metres along z, 0 where unknown.

| data set | where | unit |
|---|---|---|
| REMODE | `truth/`: distance from the camera | 0.1 mm |
| TUM RGB-D | `depth.txt`: the nearest within 20 ms | 0.2 mm |
| deep-video-mvs | `depth/` | 1 mm |
| a rendered flight | `truth/depth/` | 5 mm |
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array
from companion.messages import Floats
from drivers.images.frame_source import ImageFolder
from drivers.images.text_table import ns_of_seconds, read_rows
from drivers.posed_images import PosedImages

TIME_DIFFERENCE_NS = 20_000_000


def true_depth(images: PosedImages, position: int) -> Floats | None:
    """True depth (H, W) of an image; None without."""
    path, number, source = images.path, images.numbers[position], images.flight.source
    if (path / "depth.txt").exists():
        return _of_list(path / "depth.txt", images.flight.times_ns[position])
    if any(path.glob("*input_sequence*.txt")) and isinstance(source, ImageFolder):
        distance = _read(path / "truth" / f"{source.file(number).stem}.png", 1e4)
        return None if distance is None else np.asarray(distance / _rays(images.camera), np.float32)
    if (path / "depth").is_dir() and isinstance(source, ImageFolder):
        return _read(path / "depth" / f"{source.file(number).stem}.png", 1e3)
    return _read(path / "truth" / "depth" / f"{number:06d}.png", 200.0)


def _of_list(listing: Path, t_ns: int) -> Floats | None:
    rows = read_rows(listing, 2)
    away_ns = [abs(ns_of_seconds(listing, words[0]) - t_ns) for words in rows]
    nearest = int(np.argmin(away_ns))
    if away_ns[nearest] > TIME_DIFFERENCE_NS:
        return None
    return _read(listing.parent / rows[nearest][1], 5000.0)


def _read(path: Path, units_per_m: float) -> Floats | None:
    """16-bit depth image (H, W) in metres, 0 where unknown; None without a file."""
    if not path.exists():
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2:
        raise FlightError(f"{path}: not a depth image of one channel")
    return np.asarray(image, np.float32) / np.float32(units_per_m)


def _rays(camera: Camera) -> Array:
    """Length (H, W) of the rays whose z is 1."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    n = camera.normalise(np.stack([u, v], -1))
    out: Array = np.sqrt((n**2).sum(-1) + 1)
    return out
