"""A few seconds of the sample flight in the formats of other data sets.

Written by the formats' published descriptions, with none of the readers' code.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from companion.config import CameraConfig
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose, quaternion_from_rotation
from companion.messages import Frame
from companion.telemetry import ImuSample, Telemetry
from drivers.open_flight import open_flight
from tests.support.reference.scoring import read_tum

SAMPLE = Path(__file__).parents[3] / "sample" / "survey"


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Part of a flight: frames, their true poses, the camera, and telemetry of that time."""

    frames: list[Frame]
    truth: list[Pose]
    camera: Camera
    samples: list[Telemetry]

    def without_lens(self) -> Piece:
        """The same with pictures of an ideal lens."""
        camera = self.camera.pinhole()
        k1, k2, p1, p2, k3 = self.camera.coefficients
        lens = np.array([k1, k2, p1, p2, k3])
        pictures = [cv2.undistort(f.rgb, camera.matrix(), lens) for f in self.frames]
        frames = [
            Frame(f.seq, f.t_ns, cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), rgb)  # type: ignore[arg-type]
            for f, rgb in zip(self.frames, pictures, strict=True)
        ]
        return replace(self, frames=frames, camera=camera)

    def part(self, n_frames: int) -> Piece:
        """Its first frames only."""
        return replace(self, frames=self.frames[:n_frames], truth=self.truth[:n_frames])


@cache
def piece(start_s: float = 12.0, n_frames: int = 30) -> Piece:
    """Frames of the sample from this second on."""
    flight = open_flight(SAMPLE, CameraConfig())
    start_ns = flight.start_ns + int(start_s * 1e9)
    found = (f for f in flight.frames(start_ns) if isinstance(f, Frame))
    frames = list(islice(found, n_frames))
    known = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
    nearest = [int(np.abs(known.t_s - f.t_ns * 1e-9).argmin()) for f in frames]
    truth = [Pose(known.rotations[i], known.centres[i]) for i in nearest]
    begin_ns, end_ns = frames[0].t_ns - 10**9, frames[-1].t_ns + 10**9
    samples = [s for s in flight.telemetry().samples if begin_ns <= s.t_ns <= end_ns]
    *four, _ = flight.camera.coefficients  # not every format has room for the fifth
    camera = replace(flight.camera, coefficients=(*four, 0.0))
    return Piece(frames, truth, camera, samples)


def write_flight_folder(folder: Path, flown: Piece, grey: bool = False) -> None:
    """Our own layout, with images and without telemetry."""
    (folder / "images").mkdir(parents=True)
    for i, frame in enumerate(flown.frames):
        _write(folder / "images" / f"{i:06d}.png", frame, grey)
    rows = "".join(f"{i},{frame.t_ns}\n" for i, frame in enumerate(flown.frames))
    (folder / "frames.csv").write_text("index,unix_ns\n" + rows)
    c = flown.camera
    said: dict[str, object] = {
        "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
        "distortion_model": c.distortion.value,
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), c.coefficients, strict=False)),
    }  # fmt: skip
    if c.body_from_camera is not None:
        said["body_from_camera"] = c.body_from_camera.matrix().tolist()
    (folder / "camera.json").write_text(json.dumps(said))


def write_euroc_camera(place: Path, frames: Sequence[Frame], c: Camera) -> None:
    """A camera of the ASL layout: its images, their times and its calibration."""
    (place / "data").mkdir(parents=True)
    lines = ["#timestamp [ns],filename"]
    for frame in frames:
        lines.append(f"{frame.t_ns},{frame.t_ns}.png")
        _write(place / "data" / f"{frame.t_ns}.png", frame, grey=True)
    (place / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    assert c.body_from_camera is not None
    assert c.distortion is Distortion.RADTAN
    data = ", ".join(repr(float(v)) for v in c.body_from_camera.matrix().ravel())
    (place / "sensor.yaml").write_text(
        "# comment\nsensor_type: camera\ncomment: test\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n"
        f"rate_hz: 20\nresolution: [{c.width}, {c.height}]\ncamera_model: pinhole\n"
        f"intrinsics: [{c.fx!r}, {c.fy!r}, {c.cx!r}, {c.cy!r}] #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\n"
        f"distortion_coefficients: [{', '.join(map(repr, c.coefficients[:4]))}]\n"
    )


def write_euroc(folder: Path, flown: Piece, measured: Sequence[ImuSample] = ()) -> None:
    """ASL layout: cam0, imu0 and the true states, which are the body's.

    Without an IMU that `measured` anything there are made-up numbers.
    """
    mav, c = folder / "mav0", flown.camera
    assert c.body_from_camera is not None
    write_euroc_camera(mav / "cam0", flown.frames, c)
    (mav / "imu0").mkdir()
    (mav / "state_groundtruth_estimate0").mkdir()
    imu = ["#timestamp [ns],w_RS_S_x [rad s^-1],w y,w z,a_RS_S_x [m s^-2],a y,a z"]
    for each in measured:
        numbers = ",".join(f"{v:.9f}" for v in (*each.gyro_rad_s, *each.accel_m_s2))
        imu.append(f"{each.t_ns},{numbers}")
    for k in range(0 if measured else 200):
        t_ns = flown.frames[0].t_ns + k * 5_000_000
        imu.append(f"{t_ns},{0.01 * k},-0.2,0.3,9.25,0.5,-3.125")
    (mav / "imu0" / "data.csv").write_text("\n".join(imu) + "\n")
    rows = ["#timestamp, p_RS_R_x [m], p y, p z, q_RS_w [], q x, q y, q z, v, bw, ba"]
    for frame, pose in zip(flown.frames, flown.truth, strict=True):
        body = pose @ c.body_from_camera.inverse()
        w, x, y, z = quaternion_from_rotation(body.rotation)
        place = ",".join(f"{v:.9f}" for v in body.translation)
        rows.append(f"{frame.t_ns},{place},{w},{x},{y},{z},0,0,0,0,0,0,0,0,0")
    (mav / "state_groundtruth_estimate0" / "data.csv").write_text("\n".join(rows) + "\n")


def write_tum_rgbd(folder: Path, flown: Piece) -> None:
    """The benchmark's layout; times with microseconds, as there."""
    (folder / "rgb").mkdir(parents=True)
    lines = ["# color images", "# file: 'test.bag'", "# timestamp filename"]
    truth = ["# ground truth trajectory", "# timestamp tx ty tz qx qy qz qw"]
    for frame, pose in zip(flown.frames, flown.truth, strict=True):
        stamp = f"{frame.t_ns // 1000 / 1e6:.6f}"
        lines.append(f"{stamp} rgb/{stamp}.png")
        _write(folder / "rgb" / f"{stamp}.png", frame, grey=False)
        w, x, y, z = quaternion_from_rotation(pose.rotation)
        tx, ty, tz = pose.translation
        truth.append(f"{stamp} {tx:.6f} {ty:.6f} {tz:.6f} {x:.9f} {y:.9f} {z:.9f} {w:.9f}")
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")


def write_kitti(root: Path, flown: Piece, shift_m: float = -0.06) -> Path:
    """`sequences/07` and `poses/07.txt`; the colour camera is shifted by this from the grey one."""
    folder = root / "sequences" / "07"
    (folder / "image_2").mkdir(parents=True)
    (root / "poses").mkdir()
    c = flown.camera
    start_ns = flown.frames[0].t_ns
    times, poses = [], []
    grey_from_colour = Pose(np.eye(3), np.array([shift_m, 0.0, 0.0]))
    first = flown.truth[0] @ grey_from_colour.inverse()
    for i, (frame, pose) in enumerate(zip(flown.frames, flown.truth, strict=True)):
        times.append(f"{(frame.t_ns - start_ns) * 1e-9:.6e}")
        _write(folder / "image_2" / f"{i:06d}.png", frame, grey=False)
        grey = first.inverse() @ pose @ grey_from_colour.inverse()
        poses.append(" ".join(f"{v:.9e}" for v in grey.matrix()[:3].ravel()))
    (folder / "times.txt").write_text("\n".join(times) + "\n")
    (root / "poses" / "07.txt").write_text("\n".join(poses) + "\n")
    lines = []
    for number in range(4):
        p = np.hstack([c.matrix(), np.zeros((3, 1))])
        if number == 2:
            p[0, 3] = -c.fx * shift_m
        lines.append(f"P{number}: " + " ".join(f"{v:.12e}" for v in p.ravel()))
    (folder / "calib.txt").write_text("\n".join([*lines, "Tr: " + lines[0][4:]]) + "\n")
    return folder


def write_remode(folder: Path, flown: Piece) -> None:
    """REMODE's layout: world and camera with y upwards, no times."""
    (folder / "Images").mkdir(parents=True)
    mirror = np.diag([1.0, -1.0, 1.0])
    lines = []
    for i, (frame, pose) in enumerate(zip(flown.frames, flown.truth, strict=True)):
        _write(folder / "Images" / f"scene_{i:03d}.png", frame, grey=True)
        w, x, y, z = quaternion_from_rotation(mirror @ pose.rotation @ mirror)
        tx, ty, tz = mirror @ pose.translation
        lines.append(f"scene_{i:03d}.png {tx:.9f} {ty:.9f} {tz:.9f} {x} {y} {z} {w}")
    (folder / "first_9_frames_traj_over_table_input_sequence.txt").write_text(
        "\n".join(lines) + "\n"
    )


def write_posed_video(folder: Path, flown: Piece) -> None:
    """Images, an intrinsic matrix and camera-to-world matrices, no times."""
    (folder / "images").mkdir(parents=True)
    for i, frame in enumerate(flown.frames):
        _write(folder / "images" / f"{i:05d}.png", frame, grey=False)
    np.savetxt(folder / "K.txt", flown.camera.matrix())
    np.savetxt(folder / "poses.txt", [pose.matrix().ravel() for pose in flown.truth])


def _write(path: Path, frame: Frame, grey: bool) -> None:
    image = frame.grey if grey else frame.rgb[..., ::-1]
    assert cv2.imwrite(str(path), image)
