"""Time alignment of a log with a video by rotation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    Array,
    angle_between,
    quaternion_from_euler,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.messages import Frame
from companion.timing.image_rotation import RotationMeter
from companion.timing.rotation_alignment import RotationRecord, TimeAlignment, align_rotations

LOG_FROM_CAMERA = rotation_from_quaternion(quaternion_from_euler(0.3, -1.2, 2.0))


def rates(rng: np.random.Generator, n: int, smooth: int) -> Array:
    """Body rates as in wind, rad/s."""
    kernel = np.hanning(smooth)
    raw = rng.normal(size=(n + smooth, 3))
    smoothed = [np.convolve(raw[:, k], kernel / kernel.sum(), "valid")[:n] for k in range(3)]
    return np.stack(smoothed, 1)


def records(
    rng: np.random.Generator, *, offset_s: float, length_s: float = 60.0, begin_s: float = 20.0,
    video_s: float = 30.0, noise: float = 0.0, bias: float = 0.0,
) -> tuple[RotationRecord, RotationRecord]:  # fmt: skip
    """A log of 200 Hz, and a camera of 30 frames/s that saw part of it."""
    t_log = np.arange(0, length_s, 0.005)
    turning = rates(rng, len(t_log), 120)
    angle = np.vstack([np.zeros(3), np.cumsum(turning[:-1] * 0.005, 0)])
    t_video = np.arange(0, video_s, 1 / 30)
    seen = np.stack([np.interp(t_video + begin_s, t_log, a) for a in angle.T], 1) @ LOG_FROM_CAMERA
    # errors of each step, which add up
    seen = seen + np.cumsum(rng.normal(0, noise / 30, seen.shape), 0) + bias * t_video[:, None]
    return RotationRecord(t_video, seen), RotationRecord(t_log - begin_s - offset_s, angle)


@pytest.mark.parametrize("offset_s", [-123.456, 0.0, 7.0137, 1.7e3])
@pytest.mark.parametrize("known", [False, True])
def test_offset(rng: np.random.Generator, offset_s: float, known: bool) -> None:
    camera, log = records(rng, offset_s=offset_s, noise=0.02, bias=0.1)
    found = align_rotations(camera, log, 1 / 30, LOG_FROM_CAMERA if known else None)
    assert found is not None
    assert found.why_not is None
    assert found.offset_s == pytest.approx(offset_s, abs=0.005)
    assert found.sigma_s < 0.005


def test_video_starting_before_its_log(rng: np.random.Generator) -> None:
    camera, log = records(rng, offset_s=3.0, begin_s=0.0, noise=0.02)
    later = RotationRecord(log.t_s[2000:], log.angle_rad[2000:])
    found = align_rotations(camera, later, 1 / 30)
    assert found is not None
    assert found.offset_s == pytest.approx(3.0, abs=0.005)


def test_log_of_another_flight(rng: np.random.Generator) -> None:
    camera, _ = records(rng, offset_s=0.0)
    _, log = records(rng, offset_s=0.0, length_s=600)
    found = align_rotations(camera, log, 1 / 30)
    assert found is not None
    assert found.why_not is not None


def test_periodic_rotation_is_ambiguous(rng: np.random.Generator) -> None:
    """A swing of four seconds fits every four seconds."""
    t_s = np.arange(0, 60, 0.02)
    angle = np.stack([0.2 * np.sin(t_s * np.pi / 2), 0.1 * np.cos(t_s * np.pi / 2), 0 * t_s], 1)
    found = align_rotations(
        RotationRecord(t_s[:1500], angle[:1500]), RotationRecord(t_s, angle), 0.02
    )
    assert found is not None
    assert found.why_not is not None
    assert "fits with" in found.why_not


def test_camera_without_rotation(rng: np.random.Generator) -> None:
    _, log = records(rng, offset_s=0.0)
    t_s = np.arange(0, 30, 1 / 30)
    found = align_rotations(RotationRecord(t_s, rng.normal(0, 1e-6, (900, 3))), log, 1 / 30)
    assert found is not None
    assert found.why_not == "the camera hardly turns"


def test_too_short(rng: np.random.Generator) -> None:
    camera, log = records(rng, offset_s=0.0, video_s=8.0)
    assert align_rotations(camera, log, 1 / 30) is None


def test_words_for_the_user() -> None:
    text = str(TimeAlignment(-1.5, 0.004, 0.97, 0.41, 9.0, 0.1))
    assert text.startswith("-1.500 s, within 4 ms")
    assert "0.97 of 1" in text


def test_rotation_between_frames(rng: np.random.Generator) -> None:
    """A far scene seen by a camera that turns by known angles."""
    camera = Camera(320, 240, 250.0, 250.0, 160.0, 120.0)
    texture = cv2.GaussianBlur(rng.integers(0, 255, (240, 320)).astype(np.uint8), (0, 0), 2)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    meter = RotationMeter(camera)
    vectors = [np.array([0.02, -0.03, 0.05]), np.array([-0.01, 0.04, -0.02])]
    world_from_camera = np.eye(3)
    k = camera.matrix()
    assert meter.rotation(Frame(0, 0, texture, np.zeros((1, 1, 3), np.uint8))) is None
    for number, vector in enumerate(vectors, 1):
        world_from_camera = world_from_camera @ rotation_from_vector(vector)
        warp = k @ world_from_camera.T @ np.linalg.inv(k)
        grey = np.asarray(cv2.warpPerspective(texture, warp, (320, 240)), np.uint8)
        turn = meter.rotation(Frame(number, number, grey, np.zeros((1, 1, 3), np.uint8)))
        assert turn is not None
        wanted = rotation_from_vector(vector)
        assert angle_between(rotation_from_vector(turn), wanted) < 2e-3


def test_blank_frames() -> None:
    meter = RotationMeter(Camera(320, 240, 250.0, 250.0, 160.0, 120.0))
    dull = Frame(0, 0, np.full((240, 320), 128, np.uint8), np.zeros((1, 1, 3), np.uint8))
    assert meter.rotation(dull) is None
    assert meter.rotation(dull) is None
