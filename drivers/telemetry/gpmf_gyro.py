"""Rotation of a GoPro camera by its own gyroscope, on the clock of its video.

A block holds the samples of its span of the video, evenly spread (GYRO, rad/s). The axes differ
from model to model. They are given by ORIN, a letter for each, lower case where it points the other
way, or by the name of the stream, as in "Gyroscope (z,x,y)"; X is left, Y back, Z up (found on a
HERO5's video by comparison with its images, not tried on others).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.geometry.transforms import Array
from drivers.telemetry.gpmf_records import GpmfError, read_streams

STEP_S = 0.02
"""Sampling interval of the result."""
LONGEST_STEP_S = 0.1
"""Longer intervals are gaps, over which the rotation is unknown."""
LEAST = 100
CAMERA_FROM_GOPRO = np.array([[-1.0, 0, 0], [0, 0, -1.0], [0, -1.0, 0]])
NAMED = re.compile(r"\(([xyzXYZ]),([xyzXYZ]),([xyzXYZ])\)")


@dataclass(frozen=True, slots=True, eq=False)
class GyroRotation:
    """Rotation `angle_rad` (N, 3), integrated from the first of `t_ns` (N,) of the video's time.

    About the camera's axes where `axes_known`, else about three orthogonal ones.
    """

    t_ns: Array
    angle_rad: Array
    axes_known: bool


def gyro_rotation(blocks: Sequence[tuple[int, int, bytes]]) -> GyroRotation | None:
    """Rotation by the gyroscope; `blocks` are begin and end in ns, and content. None without data.

    Damaged blocks are gaps.
    """
    times, rates, orders = [], [], set()
    for begin_ns, end_ns, block in blocks:
        try:
            found = [s for s in read_streams(block) if s.key == "GYRO" and s.rows.shape[1] == 3]
        except GpmfError:
            continue  # counted where telemetry is read
        for stream in found:
            n = len(stream.rows)
            at = begin_ns + (np.arange(n) + 0.5) * (end_ns - begin_ns) / n
            good = np.isfinite(stream.rows).all(1)
            times.append(at[good])
            rates.append(stream.rows[good])
            orders.add(stream.orientation or _in_name(stream.name))
    t_ns = np.concatenate(times) if times else np.zeros(0)
    if len(t_ns) < LEAST:
        return None
    t_ns, first = np.unique(t_ns, return_index=True)
    gyro = np.concatenate(rates)[first]
    camera_from_rows = _camera_from_rows(orders.pop()) if len(orders) == 1 else None
    if camera_from_rows is not None:
        gyro = gyro @ camera_from_rows.T
    steps_s = np.diff(t_ns) * 1e-9
    turns = 0.5 * (gyro[1:] + gyro[:-1]) * np.where(steps_s > LONGEST_STEP_S, 0, steps_s)[:, None]
    angle = np.vstack([np.zeros(3), np.cumsum(turns, axis=0)])
    even_ns = np.arange(t_ns[0], t_ns[-1], STEP_S * 1e9)
    return GyroRotation(
        even_ns, np.stack([np.interp(even_ns, t_ns, a) for a in angle.T], 1),
        camera_from_rows is not None,
    )  # fmt: skip


def _in_name(name: str) -> str:
    found = NAMED.search(name)
    return "".join(found.groups()).upper() if found else ""


def _camera_from_rows(letters: str) -> Array | None:
    """Rotation (3, 3) by the letters of the three fields; None where unknown."""
    if sorted(letters.upper()) != ["X", "Y", "Z"]:
        return None
    gopro_from_rows = np.zeros((3, 3))
    for field, letter in enumerate(letters):
        gopro_from_rows["XYZ".index(letter.upper()), field] = 1.0 if letter.isupper() else -1.0
    out: Array = CAMERA_FROM_GOPRO @ gopro_from_rows
    return out if np.linalg.det(out) > 0 else None
