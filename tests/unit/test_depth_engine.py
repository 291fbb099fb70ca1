"""The dense engine: its kernels against numpy, rendered scenes, and inputs that show nothing."""

from __future__ import annotations

import numpy as np
import pyopencl as cl
import pytest

from companion.camera import Camera
from companion.config import DepthConfig, OpenclConfig
from companion.depth.engine import HUBER, DepthEngine, Intrinsics
from companion.depth.opencl import ComputeDevice, open_device
from companion.errors import DeviceError
from companion.geometry import Pose, rotation_from_vector
from companion.messages import Bytes, DepthMap, PixelState
from tests.support.reference_depth import regularise, update_pixel
from tests.support.scene import DOWN_LOOKING, PlaneWorld, texture

STATES = {state.value for state in PixelState}


@pytest.fixture(scope="module")
def device() -> ComputeDevice:
    return open_device(OpenclConfig())


def engine(device: ComputeDevice, width: int, height: int, **keys: float) -> DepthEngine:
    camera = Intrinsics(0.8 * width, 0.79 * width, 0.49 * width, 0.51 * height)
    return DepthEngine(device, width, height, camera, DepthConfig(**keys))  # type: ignore[arg-type]


def state_of(device: ComputeDevice, it: DepthEngine) -> np.ndarray:
    out = np.empty((it._labels.size, 4), np.float32)
    device.read(out, it._state)
    return out


@pytest.mark.parametrize(("width", "height"), [(64, 48), (65, 49), (97, 33)])
def test_update_kernel_equals_its_reference(
    device: ComputeDevice, rng: np.random.Generator, width: int, height: int
) -> None:
    it = engine(device, width, height, stride=1)
    big = texture(rng, 256)
    grey = np.ascontiguousarray(big[40 : 40 + height, 60 : 60 + width])
    # a plane at depth 10, seen from a little to the right and turned a little
    pose = Pose(rotation_from_vector(np.array([0.004, -0.006, 0.02])), np.array([-0.5, 0.1, 0.05]))
    other = np.ascontiguousarray(big[41 : 41 + height, 62 : 62 + width])
    it.begin(grey, 6.0, 30.0)
    for share_changed in (0.2, 0.1):  # the second search is bounded by what the first found
        before = state_of(device, it).astype(np.float64)
        active = np.flatnonzero(it._labels == PixelState.UPDATING.value)
        assert it.update(other, pose) == len(active)
        after = state_of(device, it)
        wrong = changed = 0
        cells = active[::3]
        for cell in cells:
            want, label = update_pixel(
                grey.astype(np.float64), other.astype(np.float64), cell % width, cell // width,
                before[cell], pose, it.intrinsics, (1 / 30, 1 / 6), it._config,
            )  # fmt: skip
            changed += not np.array_equal(want, before[cell])
            # float32: errors of 1e-7 grow to some 1e-3 through the curvature of the peak
            wrong += not np.allclose(after[cell], want, rtol=1e-2, atol=1e-7)
            if label in (2, 3):
                wrong += int(it._labels[cell]) != label
        assert changed > share_changed * len(cells), "the scene is to exercise the update"
        assert wrong <= 0.03 * len(cells), "but for pixels where a threshold falls the other way"


@pytest.mark.parametrize("shape", [(5, 7), (33, 127), (48, 64)])
def test_regulariser_equals_its_reference(
    device: ComputeDevice, rng: np.random.Generator, shape: tuple[int, int]
) -> None:
    height, width = shape
    it = DepthEngine(
        device, max(width, 16), max(height, 16), Intrinsics(50, 50, 8, 8), DepthConfig(stride=1)
    )
    start, data = rng.uniform(0, 1, shape), rng.uniform(0, 1, shape)
    weight = rng.uniform(0, 20, shape) * (rng.uniform(size=shape) > 0.4)
    edge = rng.uniform(0, 1, shape)
    arrays = (
        (it._x, start),
        (it._x_bar, start),
        (it._data, data),
        (it._weight, weight),
        (it._edge, edge),
    )
    for buffer, array in (*arrays, (it._p, np.zeros((*shape, 2)))):
        device.write(buffer, np.ascontiguousarray(array, np.float32))
    w, h, step = np.int32(width), np.int32(height), np.float32(1 / np.sqrt(8))
    it._dual.set_args(it._x_bar, it._edge, it._p, w, h, step, np.float32(HUBER))
    it._primal.set_args(it._x, it._x_bar, it._edge, it._p, it._data, it._weight, w, h, step)
    for _ in range(12):
        for kernel in (it._dual, it._primal):
            cl.enqueue_nd_range_kernel(device.queue, kernel, (128, height), (32, 1))
    out = np.empty(shape, np.float32)
    device.read(out, it._x)
    want = regularise(start, data, weight, edge, 12, HUBER)
    np.testing.assert_allclose(out, want, atol=2e-5)  # float32 over a dozen steps


def fly(device: ComputeDevice, stride: int = 2) -> tuple[DepthMap, np.ndarray]:
    """Depth of a rendered scene from eight other views, and its true depth on the grid."""
    camera = Camera(322, 241, 260.0, 258.0, 161.0, 118.0)
    world = PlaneWorld(np.random.default_rng(11))
    tilt = rotation_from_vector(np.array([0.2, 0.1, 0.0])) @ DOWN_LOOKING

    def at(k: int) -> Pose:
        turn = rotation_from_vector(np.array([0.01 * k, 0.004 * k, 0.01 * k]))
        return Pose(turn @ tilt, np.array([0.2 * k, 0.12 * k, -12.0 - 0.05 * k]))

    first, truth = world.render(camera, at(0))
    intrinsics = Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
    it = DepthEngine(device, camera.width, camera.height, intrinsics, DepthConfig(stride=stride))
    it.begin(first, 6.0, 25.0)
    for k in (1, -1, 2, -2, 4, -4, 6, 9):
        it.update(world.render(camera, at(k))[0], at(k).inverse() @ at(0))
    rgb = np.repeat(first[..., None], 3, 2)
    return it.finish(7, 99, rgb), truth[::stride, ::stride]


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_a_rendered_scene_is_measured(device: ComputeDevice, stride: int) -> None:
    depth_map, truth = fly(device, stride)
    assert depth_map.depth.shape == truth.shape == depth_map.state.shape == depth_map.rgb.shape[:2]
    assert depth_map.intrinsics[0] == pytest.approx(260.0 / stride)
    known = depth_map.depth > 0
    assert known.mean() > 0.5
    error = np.abs(depth_map.depth - truth)[known] / truth[known]
    assert np.median(error) < 0.005
    assert (error < 0.02).mean() > 0.95
    assert not (known & (depth_map.state != PixelState.CONVERGED.value)).any()
    assert (depth_map.sigma[known] > 0).all()


def test_two_runs_are_the_same_to_the_last_bit(device: ComputeDevice) -> None:
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
def test_what_shows_nothing_yields_nothing(device: ComputeDevice, name: str) -> None:
    first, second, pose = _nothing()[name]
    it = engine(device, 64, 48, stride=1)
    it.begin(first, 5.0, 30.0)
    for _ in range(6):
        it.update(second, pose)
    depth_map = it.finish(1, 2, np.repeat(first[..., None], 3, 2))
    for array in (depth_map.depth, depth_map.sigma, depth_map.inlier_ratio):
        assert np.isfinite(array).all()
    assert set(np.unique(depth_map.state)) <= STATES
    # noise finds a peak by chance here and there, and the same one again in the same image
    assert (depth_map.depth > 0).mean() < (0.1 if name == "unrelated noise" else 1e-9)


def test_a_device_is_found_by_number_and_by_name_and_never_replaced() -> None:
    number, name = (
        open_device(OpenclConfig(device="0:0")),
        open_device(OpenclConfig(device="auto")).name,
    )
    part = name.split("(")[-1].rstrip(")")
    assert part in number.name or part in open_device(OpenclConfig(device=part)).name
    with pytest.raises(DeviceError, match=r"no-such-device.*is none of"):
        open_device(OpenclConfig(device="no-such-device"))
