"""A sequence in EuRoC's layout whose only telemetry is an IMU: metric, and upright."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose, rotation_from_vector
from companion.messages import Frame
from tests.support.flights.rendered_flight import (
    CAMERA_DOWN,
    START_NS,
    Terrain,
    inertial_samples,
)
from tests.support.flights.scene import leaves
from tests.support.flights.sequences import Piece, write_euroc
from tests.support.processes.program import replay_here
from tests.support.reference.scoring import read_tum, score

IMU_AXES = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""`body_from_imu` of an IMU whose x axis points down, and y to the left."""
CAMERA = Camera(
    320, 240, 260.0, 258.0, 161.0, 118.0, Distortion.RADTAN, (0.0,) * 5,
    body_from_camera=Pose(IMU_AXES.T, np.zeros(3)) @ CAMERA_DOWN,
)  # fmt: skip
STANDS_S, SECONDS, RATE_HZ = 1.0, 14.0, 10.0


def ned_from_imu(after_s: float) -> Pose:
    """Still for a second, then in swings of metres, to 3 m/s and 2.5 m/s2."""
    t = max(after_s - STANDS_S, 0.0)
    grown = 1.0 - np.exp(-0.5 * t * t)
    place = grown * np.array([2.5 * np.sin(1.0 * t), 2.0 * np.sin(0.8 * t), 0.7 * np.sin(1.2 * t)])
    turn = grown * 0.2 * np.sin(np.array([1.1, 1.4, 0.8]) * t)
    return Pose(rotation_from_vector(turn) @ IMU_AXES, place + [0.0, 0.0, -7.0])


def test_scale_and_vertical_come_of_the_imu(tmp_path: Path) -> None:
    terrain, frames, truth = Terrain(5, pattern=leaves), [], []
    for k in range(round(SECONDS * RATE_HZ)):
        pose = ned_from_imu(k / RATE_HZ) @ CAMERA.body_from_camera  # type: ignore[operator]
        grey = terrain.picture(CAMERA, pose)
        t_ns = START_NS + round(k / RATE_HZ * 1e9)
        frames.append(Frame(k, t_ns, grey, np.repeat(grey[..., None], 3, 2)))
        truth.append(pose)
    measured = list(inertial_samples(ned_from_imu, SECONDS))
    write_euroc(tmp_path / "flight", Piece(frames, truth, CAMERA, []), measured)
    run = replay_here(tmp_path / "flight", tmp_path / "out", "--set", "depth.enabled=false")
    assert run.status == 0, run.stderr
    assert run.report["unit"] == "m"
    states = np.loadtxt(
        tmp_path / "flight" / "mav0" / "state_groundtruth_estimate0" / "data.csv", delimiter=","
    )
    found = read_tum(run.out / "trajectory.tum")
    centres = np.stack([p.translation for p in truth])
    true = type(found)(states[:, 0] * 1e-9, centres, np.stack([p.rotation for p in truth]))
    scored = score(found, true)
    assert scored.tracked_share > 0.9
    assert scored.ate_sim3_m < 0.05
    assert scored.scale_error < 0.03
    tilt = scored.alignment.rotation[2, 2]
    assert np.degrees(np.arccos(tilt)) < 1.0
