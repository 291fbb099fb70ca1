"""Images with known camera poses, for measurements of the depth engine.

| layout | recognised by | poses | truth, for scoring only |
|---|---|---|---|
| REMODE | `first_200_frames_traj_over_table_input_sequence.txt` or another `*input_sequence*.txt` | world from camera, y up | `truth/`: distance, 0.1 mm |
| TUM RGB-D | `rgb.txt`, `groundtruth.txt` | nearest within 20 ms | `depth.txt`: depth, 0.2 mm |
| deep-video-mvs | `poses.txt`, `K.txt`, `images/` | world from camera, 4 x 4 a line | `depth/`: depth, mm |
| flight | `trajectory.tum` | interpolated to the frame's time | `truth/depth/`: depth, 5 mm |

A `camera.json` in the folder says what the camera is; without one a layout's usual camera is taken.
"""  # noqa: E501

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from companion.errors import FlightError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose
from companion.messages import Bytes, Floats


def _no_truth(index: int) -> Floats | None:
    return None


@dataclass(frozen=True, slots=True, eq=False)
class PosedImages:
    """Images in order, with the pose `world_from_camera` of each; None where unknown.

    `numbers` are the frames' numbers in their folder. `pictures` reads RGB images (H, W, 3) by
    ascending positions in `numbers`. `truth` gives the true depth (H, W) f32 along z of a frame by
    position, 0 where unknown, or None.
    """

    path: Path
    layout: str
    camera: Camera
    numbers: tuple[int, ...]
    poses: tuple[Pose | None, ...]
    pictures: Callable[[Iterable[int]], Iterator[tuple[int, Bytes]]]
    truth: Callable[[int], Floats | None] = field(default=_no_truth)

    def __len__(self) -> int:
        return len(self.numbers)

    def position(self, number: int) -> int:
        """Position in `numbers` of a frame with a pose; FlightError where it is none."""
        if number not in self.numbers:
            known = f"they are {min(self.numbers)} to {max(self.numbers)}"
            raise FlightError(f"{self.path}: there is no frame {number}; {known}")
        position = self.numbers.index(number)
        if self.poses[position] is None:
            raise FlightError(f"{self.path}: frame {number} has no pose")
        return position


def read_rgb(path: Path) -> Bytes:
    """Image file as RGB (H, W, 3); FlightError if invalid."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FlightError(f"{path}: not an image that can be read")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(path: Path, units_per_m: float) -> Floats | None:
    """16-bit depth image (H, W) in metres, 0 where unknown; None without a file."""
    if not path.exists():
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2:
        raise FlightError(f"{path}: not a depth image of one channel")
    return np.asarray(image, np.float32) / np.float32(units_per_m)


def pictures_of(files: list[Path], camera: Camera) -> Callable[..., Iterator[tuple[int, Bytes]]]:
    """Reader of files by position; FlightError for an image of another size than the camera's."""

    def pictures(positions: Iterable[int]) -> Iterator[tuple[int, Bytes]]:
        for position in positions:
            rgb = read_rgb(files[position])
            if rgb.shape[:2] != (camera.height, camera.width):
                raise FlightError(
                    f"{files[position]}: {rgb.shape[1]} x {rgb.shape[0]} pixels; "
                    f"the camera has {camera.width} x {camera.height}"
                )
            yield position, rgb

    return pictures
