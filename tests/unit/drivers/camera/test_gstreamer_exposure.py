"""Exposure of pipelines whose source can be set: real GStreamer, made-up sensors."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import pytest

from companion.config import CameraConfig
from drivers.camera import gstreamer_camera
from drivers.camera.camera_source import Picture
from drivers.camera.exposure_choice import BAND, MAX_BLUR_PX, MEAN, Exposure
from drivers.camera.gstreamer_camera import GAIN_STEPS, GstreamerCamera
from drivers.camera.live_exposure import UNKNOWN_RAD_S, LiveExposure

SENSORS = Path(__file__).parents[3] / "support" / "cameras" / "gstreamer_sensor.py"
RATE_HZ = 200
CAPS = f" ! video/x-raw,format=I420,width=64,height=48,framerate={RATE_HZ}/1"


@pytest.fixture
def sensors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The child runs with made-up sensors beside GStreamer's own elements."""
    check = (
        "import gi; gi.require_version('Gst', '1.0'); from gi.repository import Gst;"
        "Gst.init(None); assert Gst.ElementFactory.find('videobalance')"
    )
    python = gstreamer_camera.SYSTEM_PYTHON
    if not os.access(python, os.X_OK) or subprocess.call([python, "-I", "-c", check]):
        pytest.skip(gstreamer_camera.INSTALL)
    child = tmp_path / "child.py"
    child.write_text(
        "import runpy, sys\n"
        f"sys.argv = [{str(SENSORS)!r}, {str(gstreamer_camera.CHILD)!r}]\n"
        f"runpy.run_path({str(SENSORS)!r})\n"
    )
    monkeypatch.setattr(gstreamer_camera, "CHILD", child)


@contextmanager
def opened(
    source: str, exposure: Literal["camera", "tracking"] = "tracking"
) -> Iterator[GstreamerCamera]:
    camera = GstreamerCamera(config(source, exposure))
    camera.open()
    try:
        yield camera
    finally:
        camera.close()


def config(source: str, exposure: Literal["camera", "tracking"] = "tracking") -> CameraConfig:
    return CameraConfig(
        source="gstreamer", pipeline=source + CAPS, exposure=exposure, rate_hz=RATE_HZ, width=64,
        height=48,
    )  # fmt: skip


def next_picture(camera: GstreamerCamera) -> Picture:
    deadline_s = time.monotonic() + 10
    while time.monotonic() < deadline_s:
        picture = camera.read(0.1)
        if picture is not None:
            return picture
    raise AssertionError("no picture came")


@pytest.mark.usefixtures("sensors")
@pytest.mark.parametrize("source", ["libcamerasrc", "nvarguscamerasrc"])
@pytest.mark.parametrize("light", [0.01, 0.4])
def test_the_light_is_found_and_nothing_blurs(source: str, light: float) -> None:
    with opened(f"{source} light={light}") as camera:
        exposure = LiveExposure(camera, config(source))
        exposure.begin()
        assert not exposure.remark
        means = []
        for _ in range(300):
            picture = next_picture(camera)
            exposure.take(picture.monotonic_ns, picture.grey)
            means.append(float(picture.grey.mean()))
        setting = exposure.now
        assert setting is not None and setting.gain is not None
        blur_px = setting.exposure_us * 1e-6 * UNKNOWN_RAD_S * exposure.focal_px
        assert blur_px <= MAX_BLUR_PX
        assert MEAN / BAND / 1.1 < means[-1] < MEAN * BAND * 1.1


@pytest.mark.usefixtures("sensors")
def test_ranges_of_the_pipeline_are_the_limits() -> None:
    ranges = 'exposuretimerange="300000 4000000" gainrange="1 4"'
    with opened(f"nvarguscamerasrc light=1 {ranges}") as camera:
        known = camera.exposure_range
        assert known is not None
        assert known[0].exposure_us == (300, 4_000)
        assert known[0].gain == (GAIN_STEPS, 4 * GAIN_STEPS)
        assert known[1].exposure_us == 4_000  # not longer, as it begins


@pytest.mark.usefixtures("sensors")
def test_the_source_is_left_alone_unless_tracking_is_asked() -> None:
    with opened("libcamerasrc light=1", exposure="camera") as camera:
        assert camera.exposure_range is None
        assert next_picture(camera).grey.mean() == pytest.approx(50, abs=2)  # by its automatic


@pytest.mark.usefixtures("sensors")
def test_stamps_move_by_half_of_the_exposure() -> None:
    with opened("libcamerasrc light=0.01") as camera:
        stamps_ns = []
        for exposure_us in (2_000, 8_000):
            camera.set_exposure(Exposure(exposure_us, GAIN_STEPS))
            stamps_ns.append(next_picture(camera).monotonic_ns)
        apart_ns = (stamps_ns[1] - stamps_ns[0] + 3_000_000) % (1_000_000_000 // RATE_HZ)
        assert min(apart_ns, 1_000_000_000 // RATE_HZ - apart_ns) < 100_000


@pytest.mark.usefixtures("sensors")
def test_a_pipeline_that_cannot_be_set_says_so() -> None:
    with opened("videotestsrc") as camera:
        assert camera.exposure_range is None
        assert len(camera.remarks) == 1 and "own exposure" in camera.remarks[0]
        next_picture(camera)
