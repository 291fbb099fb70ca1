"""Landing markers, rendered at known poses through lenses, and images without any."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig, LandingConfig, TelemetryConfig
from companion.errors import InputError
from companion.estimation.landing.marker_detector import (
    FAMILIES,
    NO_CALIBRATION,
    NO_MOUNT,
    NOT_SEEN,
    SMALL,
    TWICE,
    MarkerDetector,
)
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array, Pose, rotation_from_vector
from companion.messages import Bytes, Frame, LandingTarget
from drivers.open_flight import open_flight
from tests.support.flights.marker_ground import MarkerGround, looking_at_marker

SIZE_M = 0.5
LANDING = LandingConfig("apriltag_36h11", 7, SIZE_M)
MOUNT = Pose(
    rotation_from_vector(np.array([0.0, 0.0, 0.5 * np.pi])) @ rotation_from_vector(
        np.array([0.0, 0.2, 0.0])
    ),
    np.array([0.12, -0.03, 0.05]),
)  # fmt: skip
"""Looks down and somewhat forward, from before the autopilot."""
RADTAN = Camera(
    640, 480, 520.0, 515.0, 322.0, 238.0, Distortion.RADTAN, (-0.2, 0.05, 0.001, -0.001, 0.0),
    body_from_camera=MOUNT,
)  # fmt: skip
FISHEYE = Camera(
    640, 480, 260.0, 260.0, 318.0, 243.0, Distortion.EQUIDISTANT, (-0.01, 0.005, -0.002, 0.0),
    body_from_camera=MOUNT,
)  # fmt: skip
SAMPLE = Path(__file__).parents[4] / "sample" / "survey"


def frame_of(grey: Bytes, seq: int = 1) -> Frame:
    return Frame(seq, seq * 33_000_000, grey, np.zeros((0, 0, 3), np.uint8))


@pytest.fixture(scope="module")
def ground() -> MarkerGround:
    return MarkerGround(LANDING.marker, LANDING.id, SIZE_M)


def found_at(
    ground: MarkerGround, camera: Camera, distance_m: float, off_vertical_deg: float, seed: int
) -> tuple[LandingTarget, Array]:
    """What is found, and the true centre in the body."""
    rng = np.random.default_rng(seed)
    pose = looking_at_marker(
        distance_m, off_vertical_deg, rng.uniform(0, 360), rng.uniform(0, 360),
        rng.uniform(-0.15, 0.15, 2),
    )  # fmt: skip
    target = MarkerDetector(LANDING, camera).step(frame_of(ground.picture(camera, pose)))
    return target, MOUNT.apply(pose.inverse().translation)


@pytest.mark.parametrize(
    ("distance_m", "off_vertical_deg", "across_m", "along_m"),
    [
        (1.5, 0, 0.004, 0.01), (1.5, 40, 0.004, 0.01), (4.0, 0, 0.012, 0.05),
        (4.0, 50, 0.02, 0.08), (8.0, 0, 0.05, 0.3), (8.0, 40, 0.06, 0.35), (12.0, 10, 0.15, 0.8),
    ],
)  # fmt: skip
def test_accuracy_by_distance_and_angle(
    ground: MarkerGround, distance_m: float, off_vertical_deg: float, across_m: float,
    along_m: float,
) -> None:  # fmt: skip
    for seed in range(2):
        target, truth = found_at(ground, RADTAN, distance_m, off_vertical_deg, seed)
        assert target.position_body_m is not None, target.why_not
        assert target.sigma_body_m is not None and target.normals_body is not None
        sight = (truth - MOUNT.translation) / np.linalg.norm(truth - MOUNT.translation)
        error = target.position_body_m - truth
        assert abs(error @ sight) < along_m
        assert np.linalg.norm(error - error @ sight * sight) < across_m
        assert (np.abs(error) < 4 * target.sigma_body_m).all()
        assert target.sigma_body_m.max() < 0.1 * distance_m


def test_through_a_fisheye(ground: MarkerGround) -> None:
    target, truth = found_at(ground, FISHEYE, 2.5, 30, 4)
    assert target.position_body_m is not None, target.why_not
    assert np.linalg.norm(target.position_body_m - truth) < 0.06


def test_its_face_is_known_where_it_is_large(ground: MarkerGround) -> None:
    pose = looking_at_marker(2.0, 35, 120, 40)
    target = MarkerDetector(LANDING, RADTAN).step(frame_of(ground.picture(RADTAN, pose)))
    up_body = MOUNT.rotation @ pose.rotation.T @ [0, 0, -1]
    assert target.normals_body is not None and len(target.normals_body) == 1
    assert target.normals_body[0] @ up_body > np.cos(np.radians(2))


def test_two_poses_of_a_small_one_are_both_told(ground: MarkerGround) -> None:
    """Seen squarely, a tilt to one side looks like one to the other."""
    pose = looking_at_marker(10.0, 5, 120, 40)
    target = MarkerDetector(LANDING, RADTAN).step(frame_of(ground.picture(RADTAN, pose)))
    assert target.normals_body is not None and len(target.normals_body) == 2


def test_what_is_too_far_or_another_is_not_told(ground: MarkerGround) -> None:
    far = frame_of(ground.picture(RADTAN, looking_at_marker(22.0, 0, 0, 10)))
    near = frame_of(ground.picture(RADTAN, looking_at_marker(3.0, 0, 0, 10)))
    other = LandingConfig(LANDING.marker, 8, SIZE_M)
    for frame, config, why in ((far, LANDING, {SMALL, NOT_SEEN}), (near, other, {NOT_SEEN})):
        target = MarkerDetector(config, RADTAN).step(frame)
        assert target.position_body_m is None and target.why_not in why


def test_of_two_none_is_told(ground: MarkerGround) -> None:
    half = ground.picture(RADTAN, looking_at_marker(4.0, 0, 0, 0))[:, 160:480]
    target = MarkerDetector(LANDING, RADTAN).step(frame_of(np.ascontiguousarray(np.c_[half, half])))
    assert target.why_not == TWICE and target.position_body_m is None


def test_without_mount_or_calibration_nothing_is_told(ground: MarkerGround) -> None:
    frame = frame_of(ground.picture(RADTAN, looking_at_marker(4.0, 0, 0, 0)))
    free, guessed = Camera(640, 480, 520.0, 515.0, 322.0, 238.0), Camera(
        640, 480, 520.0, 515.0, 322.0, 238.0, body_from_camera=MOUNT, assumed=True
    )  # fmt: skip
    assert MarkerDetector(LANDING, free).step(frame).why_not == NO_MOUNT
    assert MarkerDetector(LANDING, guessed).step(frame).why_not == NO_CALIBRATION


@pytest.mark.parametrize(
    ("config", "named"),
    [
        (LandingConfig("apriltag_36h11", 7), "landing.size_m"),
        (LandingConfig("aruco_4x4_50", 50, 0.3), "0 to 49"),
    ],
)
def test_what_cannot_be_is_refused(config: LandingConfig, named: str) -> None:
    with pytest.raises(InputError, match=named):
        MarkerDetector(config, RADTAN)


def test_no_marker_is_found_where_there_is_none() -> None:
    """Every fourth image of the sample flight, in every family, whatever the number."""
    flight = open_flight(SAMPLE, CameraConfig(), TelemetryConfig())
    detectors = [
        MarkerDetector(LandingConfig(marker, 0, 0.5), flight.camera)  # type: ignore[arg-type]
        for marker in FAMILIES
    ]
    n = 0
    for frame in flight.frames(flight.start_ns, flight.stop_ns):
        if not isinstance(frame, Frame) or frame.seq % 4:
            continue
        n += 1
        for detector in detectors:
            assert detector.step(frame).why_not == NOT_SEEN
    assert n > 100
