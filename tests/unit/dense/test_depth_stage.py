"""The depth stage on a rendered flight: points in the right place, memory bounded."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest

from companion.config import CloudConfig, DepthConfig
from companion.dense import device_takeover
from companion.dense.depth_stage import LAGS, MAX_FRAMES, DepthStage
from companion.dense.device_takeover import FAILED_OVER, NO_DEVICE_LEFT, Devices
from companion.dense.self_test import SelfTest
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose
from companion.messages import (
    DepthMap,
    Frame,
    KeyframeAdded,
    Message,
    PointChunk,
    Track,
    TrackState,
    Warned,
)
from tests.support.flights.mapped_plane import at, told
from tests.support.reference import opencl_devices
from tests.support.reference.failing_driver import WrongDevice

RADTAN = Camera(242, 181, 200.0, 199.0, 121.0, 88.0, Distortion.RADTAN, (-0.1, 0.02, 0, 0, 0))
FISHEYE = Camera(242, 181, 170.0, 170.0, 121.0, 90.0, Distortion.EQUIDISTANT, (0.01, 0, 0, 0))


def stage(camera: Camera, devices: Devices | None = None) -> DepthStage:
    return DepthStage(
        DepthConfig(),
        CloudConfig(),
        camera,
        devices or opencl_devices.devices(),
        lambda _: nullcontext(),
    )


def fly(
    camera: Camera, n: int = 34, scale_of: dict[int, float] | None = None, *,
    devices: Devices | None = None, before: Callable[[int], object] = int,
) -> list[Message]:  # fmt: skip
    """A flight with true poses and a keyframe every fourth frame; all that the stage gives.

    `before` is told each frame's number before the stage gets it.
    """
    it, out, last = stage(camera, devices), [], -1
    for k, message in told(camera, n, scale_of):
        if k != last:
            before(k)
        last = k
        out += it.step(message)
    return out + it.flush()


def turning(k: int) -> np.ndarray:
    """Angular rates of a camera that turns this way and that: 90 degrees/s at most."""
    return np.array([0.8 * np.sin(0.9 * k), 1.4 * np.cos(1.7 * k), 1.0 * np.sin(2.3 * k)])


def test_the_turning_of_a_rolling_shutter_is_undone() -> None:
    messages = [m for _, m in told(replace(RADTAN, readout_ms=25.0), 34, None, turning)]

    def heights(readout_ms: float | None) -> np.ndarray:
        """Of the points, m."""
        it, out = stage(replace(RADTAN, readout_ms=readout_ms)), []
        for message in messages:
            out += it.step(message)
        chunks = [m for m in [*out, *it.flush()] if isinstance(m, PointChunk)]
        return np.concatenate(
            [at(4 * c.keyframe_id).apply(c.points_camera.astype(np.float64))[:, 2] for c in chunks]
        )

    undone, ignored = heights(25.0), heights(None)
    surfaces = np.array([0.0, -1.5, -2.0, -2.5, -3.0, -3.5, -4.0])
    assert np.median(np.abs(undone[:, None] - surfaces).min(1)) < 0.06, "metres, from 12 m above"
    assert len(undone) > 2.5 * len(ignored), "ignored, few depths are consistent"


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "fisheye"])
def test_points_lie_on_the_surfaces(camera: Camera) -> None:
    out = fly(camera)
    chunks = [m for m in out if isinstance(m, PointChunk)]
    assert [m for m in out if isinstance(m, DepthMap)]
    assert sum(len(c.points_camera) for c in chunks) > 1000
    heights = np.concatenate(
        [at(4 * c.keyframe_id).apply(c.points_camera.astype(np.float64))[:, 2] for c in chunks]
    )
    # the ground, and the roofs of PlaneWorld half a metre apart
    surfaces = np.array([0.0, -1.5, -2.0, -2.5, -3.0, -3.5, -4.0])
    off = np.abs(heights[:, None] - surfaces).min(1)
    assert np.median(off) < 0.06  # metres, from 12 m above
    assert (off < 0.24).mean() > 0.95
    normalised = off / np.concatenate([c.sigma for c in chunks])
    assert 0.4 < np.quantile(normalised, 0.68) < 1.2, "sigma is what it says"
    assert np.quantile(normalised, 0.95) < 2.5
    for chunk in chunks:
        assert len(chunk.points_camera) == len(chunk.rgb) == len(chunk.confidence)
        assert ((chunk.confidence >= 0) & (chunk.confidence <= 1)).all()
        assert (chunk.sigma > 0).all()
        assert np.median(chunk.sigma) < 0.15  # a hundredth of 12 m
        # ground and roofs are level; at their edges are a few points that are not
        up = (chunk.normals_camera @ at(4 * chunk.keyframe_id).rotation.T)[:, 2]
        assert np.median(up) < -0.98


def test_segments_are_not_fused() -> None:
    alone = fly(RADTAN, scale_of={k: 1.0 + 0.1 * k for k in range(20)})
    assert not [m for m in alone if isinstance(m, PointChunk)], "no two keyframes share a unit"


def test_frame_buffer_is_bounded_while_hovering(monkeypatch: pytest.MonkeyPatch) -> None:
    it = stage(RADTAN)
    monkeypatch.setattr(it._undistortion, "image", None)  # no depth map uses any
    grey = np.zeros((RADTAN.height, RADTAN.width), np.uint8)
    for k in range(3 * MAX_FRAMES):
        it.step(Frame(k, k, grey, np.repeat(grey[..., None], 3, 2)))
        it.step(Track(k, k, TrackState.TRACKING, Pose.identity(), 0, Pose.identity(), 50))
    assert len(it._frames) <= MAX_FRAMES + 1


@pytest.mark.parametrize(("lag", "n_coloured"), [(6, 30), (25, 50)])
def test_a_hover_keeps_colours_for_as_long_as_keyframes_take(lag: int, n_coloured: int) -> None:
    """Map updates are left out, so that no depth map is made."""
    it = stage(RADTAN)
    grey = np.zeros((RADTAN.height, RADTAN.width), np.uint8)
    told_of = range(40, 40 + 12 * LAGS, 12)
    for seq in range(400):
        it.step(Frame(seq, seq, grey, np.repeat(grey[..., None], 3, 2)))
        if seq - lag in told_of:
            it.step(KeyframeAdded(seq, seq - lag, seq, Pose.identity(), np.zeros((0, 3))))
            assert it._frames[seq - lag].rgb is not None
    coloured = {seq for seq, each in it._frames.items() if each.rgb is not None}
    assert coloured - set(told_of) == set(range(400 - n_coloured, 400))


def test_colours_are_kept_only_where_a_keyframe_may_be() -> None:
    it, n_maps, most, n_frames = stage(RADTAN), 0, 0, 0
    for _, message in told(RADTAN, 34):
        n_maps += sum(isinstance(each, DepthMap) for each in it.step(message))
        most = max(most, sum(each.rgb is not None for each in it._frames.values()))
        n_frames = max(n_frames, len(it._frames))
    assert n_maps > 2
    # from the oldest of two that wait to the frame after the next keyframe, every fourth
    assert most <= 13 < n_frames


# -- devices that fail in flight -----------------------------------------------------------------


@pytest.fixture(scope="module")
def undisturbed() -> list[Message]:
    return fly(RADTAN)


def twice() -> Devices:
    """The best device, and again for failover to itself."""
    best = next(
        each for each in opencl_devices.known() if each.number == opencl_devices.working()[0]
    )
    return Devices([best, best], lambda _: "")


def lose(devices: Devices) -> None:
    """All commands to the current device fail from now on."""
    assert devices.current is not None
    devices.current.queue = cl.CommandQueue(cl.Context([devices.current.device]))


def spoil(devices: Devices) -> None:
    """The next test of the current device fails."""
    assert devices.current is not None and devices._taken is not None
    listed, _ = devices._taken
    devices._taken = (listed, SelfTest(WrongDevice(devices.current.device)))


def points(out: list[Message]) -> list[bytes]:
    return [m.points_camera.tobytes() for m in out if isinstance(m, PointChunk)]


@pytest.mark.parametrize(
    ("fault", "in_words"),
    [(lose, "fails while it computes"), (spoil, "self-test failed: only")],
)
def test_failover_loses_nothing(
    fault: Callable[[Devices], None], in_words: str, undisturbed: list[Message],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(device_takeover, "TEST_PERIOD_NS", 1)
    devices = twice()
    out = fly(RADTAN, devices=devices, before=lambda k: fault(devices) if k == 18 else None)
    (warned,) = [m for m in out if isinstance(m, Warned)]
    assert (warned.what, warned.good) == (FAILED_OVER, False) and 18 <= warned.t_ns < 24
    assert devices.current is not None
    assert warned.detail.startswith(f"{devices.current.name}; {devices.current.name}: {in_words}")
    assert ("may be wrong" in warned.detail) == (fault is spoil)
    assert points(out) == points(undisturbed) != []
    assert f"failed: {devices.current.name}: {in_words}" in devices.described


@pytest.mark.parametrize("fault", [lose, spoil])
def test_without_another_device_depth_ends_and_the_stage_continues(
    fault: Callable[[Devices], None], undisturbed: list[Message], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_takeover, "TEST_PERIOD_NS", 1)
    devices = twice()
    out = fly(RADTAN, devices=devices, before=lambda k: fault(devices) if k in (12, 26) else None)
    assert [m.what for m in out if isinstance(m, Warned)] == [FAILED_OVER, NO_DEVICE_LEFT]
    maps = [m.depth.tobytes() for m in out if isinstance(m, DepthMap)]
    whole = [m.depth.tobytes() for m in undisturbed if isinstance(m, DepthMap)]
    assert 0 < len(maps) < len(whole) and maps == whole[: len(maps)]
    assert devices.described.startswith("none is left; failed: ")


def test_stage_started_with_a_failed_device_reports_it() -> None:
    """As after a restart in flight."""
    best = next(
        each for each in opencl_devices.known() if each.number == opencl_devices.working()[0]
    )
    out = fly(RADTAN, 12, devices=Devices([best], lambda _: "", ["another: was lost"]))
    (warned,) = [m for m in out if isinstance(m, Warned)]
    assert (warned.what, warned.detail) == (FAILED_OVER, f"{best.named}; another: was lost")
    out = fly(RADTAN, 12, devices=Devices([], lambda _: "", ["another: was lost"]))
    assert len(out) == 1 and isinstance(out[0], Warned)  # and nothing else
    warned = out[0]
    assert (warned.what, warned.detail) == (NO_DEVICE_LEFT, "another: was lost")


def test_warnings_fit_one_autopilot_message() -> None:
    assert all(len(f"Companion: {what}") <= 50 for what in (FAILED_OVER, NO_DEVICE_LEFT))
