"""The dense engine on rendered scenes and uninformative inputs."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from companion.config import DepthConfig
from companion.dense import verification
from companion.dense.engine import DepthEngine
from companion.dense.opencl import ComputeDevice, device_asked_for
from companion.dense.verification import MAX_NOISE_GREY, image_noise
from companion.dense.view_selection import Intrinsics
from companion.errors import DeviceError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, rotation_from_vector
from companion.messages import Bytes, DepthMap, PixelState
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld, texture
from tests.support.reference import opencl_devices

STATES = {state.value for state in PixelState}


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return opencl_devices.best()


def engine(device: ComputeDevice, width: int, height: int, **keys: float) -> DepthEngine:
    camera = Intrinsics(0.8 * width, 0.79 * width, 0.49 * width, 0.51 * height)
    return DepthEngine(device, width, height, camera, DepthConfig(**keys))  # type: ignore[arg-type]


def fly(
    device: ComputeDevice,
    stride: int = 2,
    on_update: Callable[[int], object] = int,
    taken: Callable[[Bytes], Bytes] = lambda image: image,
) -> tuple[DepthMap, np.ndarray]:
    """Depth of a rendered scene from eight other views, and its true depth on the grid.

    `taken` is what a camera makes of each image.
    """
    camera = Camera(322, 241, 260.0, 258.0, 161.0, 118.0)
    world = PlaneWorld(np.random.default_rng(11))
    tilt = rotation_from_vector(np.array([0.2, 0.1, 0.0])) @ DOWN_LOOKING

    def at(k: int) -> Pose:
        turn = rotation_from_vector(np.array([0.01 * k, 0.004 * k, 0.01 * k]))
        return Pose(turn @ tilt, np.array([0.2 * k, 0.12 * k, -12.0 - 0.05 * k]))

    first, truth = world.render(camera, at(0))
    intrinsics = Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
    it = DepthEngine(device, camera.width, camera.height, intrinsics, DepthConfig(stride=stride))
    it.begin(taken(first), 6.0, 25.0)
    for k in (1, -1, 2, -2, 4, -4, 6, 9):
        on_update(it.update(taken(world.render(camera, at(k))[0]), at(k).inverse() @ at(0)))
    rgb = np.repeat(first[..., None], 3, 2)
    return it.finish(7, 99, rgb), truth[::stride, ::stride]


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_rendered_scene_is_reconstructed(device: ComputeDevice, stride: int) -> None:
    depth_map, truth = fly(device, stride)
    assert depth_map.depth.shape == truth.shape == depth_map.state.shape == depth_map.rgb.shape[:2]
    assert depth_map.intrinsics[0] == pytest.approx(260.0 / stride)
    known = depth_map.state == PixelState.CONVERGED.value
    assert known.mean() > 0.7
    assert (depth_map.depth > 0).all(), "what did not converge is filled in"
    error = np.abs(depth_map.depth - truth) / truth
    assert np.median(error[known]) < 0.004
    assert (error[known] < 0.02).mean() > 0.98
    assert (error < 0.05).mean() > 0.95
    assert (depth_map.sigma[known] > 0).all()
    off = error[known] * depth_map.depth[known] / depth_map.sigma[known]
    assert 0.4 < np.quantile(off, 0.68) < 1.6, "sigma is what it says"


def test_noise_does_not_reject_depth(
    device: ComputeDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    def weak() -> tuple[DepthMap, np.ndarray]:
        rng = np.random.default_rng(4)

        def taken(image: Bytes) -> Bytes:
            noisy = 100.0 + 0.1 * (image - 128.0) + rng.normal(0.0, 1.5, image.shape)
            return noisy.astype(np.uint8)

        return fly(device, 1, taken=taken)

    depth_map, truth = weak()
    monkeypatch.setattr(verification, "NOISE_BOUND", 0.0)
    strict, _ = weak()
    known, before = (m.state == PixelState.CONVERGED.value for m in (depth_map, strict))
    error = np.abs(depth_map.depth - truth) / truth
    assert known.mean() > 2 * before.mean() > 0.1 and known[before].all()
    assert (error[known] < 0.05).mean() > 0.95
    np.testing.assert_array_equal(depth_map.depth, strict.depth, "it weighs no more for that")


def test_noise_is_measured_in_the_smoothest_blocks() -> None:
    rng = np.random.default_rng(5)
    picture = cv2.resize(texture(rng, 128), (320, 240), interpolation=cv2.INTER_CUBIC)
    for noise in (0.7, 1.5, 4.0):
        noisy = 60.0 + 0.3 * picture + rng.normal(0.0, noise, picture.shape)
        assert image_noise(noisy.astype(np.uint8)) == pytest.approx(noise, rel=0.25)
    assert image_noise(np.full((65, 97), 9, np.uint8)) == 0.0
    assert image_noise(np.full((7, 9), 9, np.uint8)) == 0.0
    anything = rng.integers(0, 256, (240, 320), np.uint8)
    assert image_noise(anything) == MAX_NOISE_GREY


def test_eager_estimates_improve(device: ComputeDevice) -> None:
    left: list[int] = []
    depth_map, _ = fly(device, on_update=left.append)
    assert left[0] == depth_map.state.size
    assert left[-1] < 0.5 * depth_map.state.size


def test_redundant_images_are_skipped(device: ComputeDevice) -> None:
    it = engine(device, 64, 48)
    grey = texture(np.random.default_rng(5), 128)[:48, :64].copy()
    it.begin(grey, 5.0, 30.0)
    for k in range(9):
        it.update(grey, Pose(np.eye(3), np.array([0.4 + 0.001 * k, 0.0, 0.0])))
    it.update(grey, Pose(np.eye(3), np.array([-100.0, 0.0, 0.0])))
    it.update(grey, Pose(np.eye(3), np.array([np.nan, 0.0, 0.0])))
    assert it.n_novel == 1
    it.finish(1, 2, np.zeros((48, 64, 3), np.uint8))
    assert it.n_searched == 1


def test_runs_are_bit_exact(device: ComputeDevice) -> None:
    one, two = fly(device)[0], fly(device)[0]
    for name in ("depth", "sigma", "state", "inlier_ratio"):
        assert np.array_equal(getattr(one, name), getattr(two, name)), name


SIDEWAYS = Pose(np.eye(3), np.array([0.4, 0.0, 0.0]))


def _nothing() -> dict[str, tuple[Bytes, Bytes, Pose]]:
    rng = np.random.default_rng(5)
    flat = {
        name: np.full((48, 64), level, np.uint8)
        for name, level in (("black", 0), ("white", 255), ("grey", 90))
    }
    detail = texture(rng, 128)[:48, :64].copy()
    other = rng.integers(0, 255, (48, 64)).astype(np.uint8)
    turn = Pose(rotation_from_vector(np.array([0.0, 0.02, 0.01])), np.zeros(3))
    return {
        **{name: (image, image, SIDEWAYS) for name, image in flat.items()},
        "unrelated noise": (rng.integers(0, 255, (48, 64)).astype(np.uint8), other, SIDEWAYS),
        "zero baseline": (detail, detail, Pose.identity()),
        "pure rotation": (detail, detail, turn),
        "behind the camera": (detail, detail, Pose(np.eye(3), np.array([0.0, 0.0, -40.0]))),
        "turned away": (
            detail,
            detail,
            Pose(rotation_from_vector(np.array([0, 3.0, 0])), SIDEWAYS.translation),
        ),
    }


@pytest.mark.parametrize("name", sorted(_nothing()))
def test_uninformative_images_yield_no_depth(device: ComputeDevice, name: str) -> None:
    first, second, pose = _nothing()[name]
    it = engine(device, 64, 48, stride=1)
    it.begin(first, 5.0, 30.0)
    for _ in range(6):
        it.update(second, pose)
    depth_map = it.finish(1, 2, np.repeat(first[..., None], 3, 2))
    for array in (depth_map.depth, depth_map.sigma, depth_map.inlier_ratio):
        assert np.isfinite(array).all()
    assert set(np.unique(depth_map.state)) <= STATES
    # noise finds a match by chance here and there, and the same one again in the same image
    found = (depth_map.state == PixelState.CONVERGED.value).mean()
    assert found < (0.1 if name == "unrelated noise" else 1e-9)


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize(("width", "height"), [(64, 48), (65, 49), (101, 57), (48, 64)])
def test_any_size_gives_finite_values(
    device: ComputeDevice, width: int, height: int, stride: int
) -> None:
    big = texture(np.random.default_rng(5), 256)
    it = engine(device, width, height, stride=stride)
    it.begin(big[:height, :width].copy(), 5.0, 30.0)
    for k in range(1, 5):
        # the last goes past what it looks at: some depths are behind the camera
        ahead = np.array([-0.5 * k, 0.3 * k, 0.2 if k < 4 else -6.0])
        it.update(big[k : height + k, 2 * k : width + 2 * k].copy(), Pose(np.eye(3), ahead))
    depth_map = it.finish(1, 2, np.zeros((height, width, 3), np.uint8))
    assert depth_map.depth.shape == (-(-height // stride), -(-width // stride))
    for array in (depth_map.depth, depth_map.sigma, depth_map.inlier_ratio):
        assert np.isfinite(array).all()
    assert depth_map.depth.min() >= 4.99 and depth_map.depth.max() <= 30.01


def test_image_too_large_for_the_device_is_an_error(device: ComputeDevice) -> None:
    with pytest.raises(DeviceError, match=r"raise expert\.depth\.stride"):
        engine(device, 100_000, 90_000, stride=1)


def test_device_by_number_and_by_name() -> None:
    listed = [each.listed for each in opencl_devices.known()]
    for each in listed:
        assert device_asked_for(each.number, listed) is each
        assert device_asked_for(each.name, listed).name == each.name
        assert device_asked_for(each.platform.upper(), listed).platform == each.platform
    with pytest.raises(DeviceError, match=r"no-such-device.*is none of"):
        device_asked_for("no-such-device", listed)
