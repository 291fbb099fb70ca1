"""TUM RGB-D with depth images: depths beside the pictures, and a scale without any attitude."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.config import CameraConfig, TelemetryConfig
from companion.geometry.transforms import Pose
from companion.messages import Frame
from companion.telemetry import DepthSample
from drivers.datasets.tum_rgbd import open_tum_rgbd
from tests.support.flights.rendered_flight import Terrain
from tests.support.flights.scene import leaves
from tests.support.flights.sequences import Piece, write_flight_folder, write_tum_rgbd
from tests.support.flights.stereo_flight import FIRST, ned_from_body
from tests.support.processes.program import replay_here
from tests.support.reference.scoring import read_tum, score

SECONDS, RATE_HZ, LATE_S = 8.0, 10.0, 0.006
CAMERA = FIRST.pinhole()


def depth_m(ned_from_camera: Pose) -> np.ndarray:
    """Depth (H, W) of the ground at 0."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    flat = CAMERA.normalise(np.stack([u, v], -1).reshape(-1, 2))
    down = np.c_[flat, np.ones(len(flat))] @ ned_from_camera.rotation[2]
    return np.asarray(-ned_from_camera.translation[2] / down).reshape(u.shape)


def write_depth(folder: Path, flown: Piece) -> None:
    """Depth images a little later than the pictures, one pixel in a hundred without a value."""
    (folder / "depth").mkdir()
    rng, lines = np.random.default_rng(1), ["# depth maps"]
    for frame, pose in zip(flown.frames, flown.truth, strict=True):
        stamp = f"{frame.t_ns * 1e-9 + LATE_S:.6f}"
        found = depth_m(pose)
        noisy = found + 1.425e-3 * found**2 * rng.normal(size=found.shape)
        units = np.where(rng.random(found.shape) < 0.01, 0.0, 5000.0 * noisy)
        cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), np.rint(units).astype(np.uint16))
        lines.append(f"{stamp} depth/{stamp}.png")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root, terrain = tmp_path_factory.mktemp("tum"), Terrain(5, plane=True, pattern=leaves)
    frames, truth = [], []
    assert CAMERA.body_from_camera is not None
    for k in range(round(SECONDS * RATE_HZ)):
        pose = ned_from_body(k / RATE_HZ) @ CAMERA.body_from_camera
        grey = terrain.picture(CAMERA, pose)
        t_ns = 1_700_000_000_000_000_000 + round(k / RATE_HZ * 1e9)
        frames.append(Frame(k, t_ns, grey, np.repeat(grey[..., None], 3, 2)))
        truth.append(pose)
    flown = Piece(frames, truth, CAMERA, [])
    folder = root / "flight"
    write_tum_rgbd(folder, flown)
    write_flight_folder(root / "ours", flown)
    (root / "ours" / "camera.json").rename(folder / "camera.json")
    write_depth(folder, flown)
    return folder


def test_depth_images_give_depths_at_corners(written: Path) -> None:
    flight = open_tum_rgbd(written, CameraConfig(), TelemetryConfig())
    log = flight.telemetry()
    depths = [s for s in log.samples if isinstance(s, DepthSample)]
    assert {s.t_ns for s in depths} <= set(flight.times_ns)
    assert len(depths) > 20 * len({s.t_ns for s in depths})
    assert np.median([s.depth_m for s in depths]) == pytest.approx(7.0, rel=0.05)
    assert [w.what for w in log.warnings] == ["no attitude"]


def test_depths_that_are_not_believed_leave_no_telemetry(written: Path) -> None:
    log = open_tum_rgbd(written, CameraConfig(), TelemetryConfig(use=("attitude",))).telemetry()
    assert not log.samples
    assert [w.what for w in log.warnings] == ["no telemetry"]


def test_damaged_depth_images_are_told(written: Path, tmp_path: Path) -> None:
    listing = (written / "depth.txt").read_text()
    folder = tmp_path / "flight"
    folder.mkdir()
    for name in ("rgb", "rgb.txt", "camera.json"):
        (folder / name).symlink_to(written / name)
    (folder / "depth.txt").write_text(listing)
    log = open_tum_rgbd(folder, CameraConfig(), TelemetryConfig()).telemetry()
    assert not log.samples
    assert "pictures of the depth camera could not be read" in [w.what for w in log.warnings]


def test_a_replay_is_metric_without_attitude(written: Path, tmp_path: Path) -> None:
    run = replay_here(written, tmp_path / "out", "--set", "depth.enabled=false")
    assert run.status == 0, run.stderr
    assert run.report["unit"] == "m"
    found = read_tum(run.out / "trajectory.tum")
    truth = read_tum(written / "groundtruth.txt")
    scored = score(found, truth)
    print(f"{100 * scored.scale_error:.2f} % off")
    assert scored.tracked_share > 0.9
    assert scored.scale_error < 0.01
    assert scored.ate_sim3_m < 0.05
