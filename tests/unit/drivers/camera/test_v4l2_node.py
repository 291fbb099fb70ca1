"""Video4Linux nodes other than a webcam's, and drivers that refuse requests."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from drivers.camera import v4l2_ioctl as v4l2
from drivers.camera.camera_devices import cameras, find_camera
from drivers.camera.v4l2_camera import V4l2Camera
from drivers.camera.v4l2_node import MAX_ENTRIES
from tests.support.cameras.fake_v4l2 import FakeV4l2, install


@pytest.fixture
def webcam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeV4l2:
    fake = FakeV4l2(tmp_path)
    fake.plug_in(0)
    install(monkeypatch, fake)
    return fake


@pytest.fixture
def mplane(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeV4l2:
    fake = FakeV4l2(tmp_path, mplane=True)
    fake.plug_in(0)
    install(monkeypatch, fake)
    return fake


def n_held(fake: FakeV4l2) -> int:
    """How often this process has the device open or mapped."""
    held = 0
    for fd in os.listdir("/proc/self/fd"):
        try:
            held += fake.is_at(int(fd))
        except FileNotFoundError:  # that of the listing itself
            continue
    return held


def test_a_multi_planar_camera(mplane: FakeV4l2) -> None:
    camera = V4l2Camera(CameraConfig())
    camera.open()
    try:
        for _ in range(6):  # more than there are buffers
            picture = camera.read(1.0)
            assert picture is not None
            assert abs(picture.monotonic_ns - mplane.last_stamp_ns) < 1_000
            assert picture.grey.shape == (480, 640)
            assert picture.grey.std() > 20
            np.testing.assert_array_equal(picture.grey[:, 160:], picture.grey[:, :-160])
            assert np.ptp(picture.grey, axis=0).max() == 0  # its bars stand upright
            assert picture.rgb.shape == (480, 640, 3)
    finally:
        camera.close()
    assert mplane.format == ("NV12", 640, 480)
    assert camera.remarks == []
    assert n_held(mplane) == 0


def test_a_multi_planar_camera_is_listed(mplane: FakeV4l2) -> None:
    (found,) = cameras()
    assert (found.problem, found.stable_path) == ("", mplane.stable_path)
    assert [(each.code, each.width, each.height, each.rates_hz) for each in found.formats] == [
        ("NV12", 640, 480, (30.0,))
    ]


def test_a_node_that_is_no_video_device(webcam: FakeV4l2, tmp_path: Path) -> None:
    other = tmp_path / "video1"
    other.write_bytes(b"")  # the kernel itself answers ENOTTY
    with pytest.raises(SourceError, match=r"video1: it is no camera"):
        V4l2Camera(CameraConfig(device=str(other))).open()
    assert [each.problem for each in cameras()] == ["", os.strerror(errno.ENOTTY)]
    assert find_camera() == webcam.stable_path


def test_a_node_without_pictures(webcam: FakeV4l2, monkeypatch: pytest.MonkeyPatch) -> None:
    def metadata(_: int, about: v4l2.Capability) -> None:
        about.card = b"Acme Webcam"
        about.capabilities = v4l2.CAP_DEVICE_CAPS | v4l2.CAP_VIDEO_CAPTURE | v4l2.CAP_STREAMING
        about.device_caps = v4l2.CAP_STREAMING

    monkeypatch.setattr(webcam, "_querycap", metadata)
    assert cameras() == []
    with pytest.raises(ConfigError, match=r"this node of Acme Webcam gives no pictures"):
        V4l2Camera(CameraConfig(device=webcam.stable_path)).open()


def test_a_driver_that_lists_no_sizes_and_rates(webcam: FakeV4l2) -> None:
    for request in (v4l2.ENUM_FRAMESIZES, v4l2.ENUM_FRAMEINTERVALS, v4l2.QUERYCTRL, v4l2.S_PARM):
        webcam.refused[request] = errno.ENOTTY
    (found,) = cameras()
    assert (found.problem, found.controls) == ("", ())
    assert {(each.width, each.height, each.rates_hz) for each in found.formats} == {(1280, 720, ())}
    camera = V4l2Camera(CameraConfig())
    camera.open()
    assert camera.read(1.0) is not None
    camera.close()
    assert camera.remarks == [f"{webcam.stable_path}: its rate cannot be set, 30/s was asked"]


@pytest.mark.parametrize("at", [v4l2.S_FMT, v4l2.REQBUFS, v4l2.STREAMON])
def test_a_busy_camera_is_let_go_and_tried_again(webcam: FakeV4l2, at: int) -> None:
    webcam.refused[at] = errno.EBUSY
    camera = V4l2Camera(CameraConfig())
    with pytest.raises(SourceError) as refused:  # which keeps what the frames below it know
        camera.open()
    assert n_held(webcam) == 0
    assert "another program uses the camera" in str(refused.value)
    webcam.refused.clear()
    camera.open()
    assert camera.read(1.0) is not None
    camera.close()


def test_memory_for_some_buffers_only(webcam: FakeV4l2, monkeypatch: pytest.MonkeyPatch) -> None:
    given = webcam._querybuf

    def querybuf(fd: int, about: v4l2.Buffer) -> None:
        if about.index == 2:
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
        given(fd, about)

    monkeypatch.setattr(webcam, "_querybuf", querybuf)
    with pytest.raises(SourceError) as refused:
        V4l2Camera(CameraConfig()).open()
    assert n_held(webcam) == 0
    assert "the camera cannot be started: Cannot allocate memory" in str(refused.value)


@pytest.mark.parametrize(
    ("after", "n_more"),
    [(lambda last: last + 1, MAX_ENTRIES), (lambda last: last, 0), (lambda last: last - 1, 0)],
)
def test_a_list_of_controls_that_does_not_end(
    webcam: FakeV4l2, after: Callable[[int], int], n_more: int
) -> None:
    webcam.control_after_last = after
    (found,) = cameras()
    assert found.problem == ""
    assert len(found.controls) == (n_more or len(webcam.controls))
    assert webcam.n_requests < 3 * MAX_ENTRIES
    camera = V4l2Camera(CameraConfig(gain=3))
    camera.open()
    camera.close()
    assert webcam.values[v4l2.CID_GAIN] == 3
