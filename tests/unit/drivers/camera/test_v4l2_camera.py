"""Video4Linux camera with a simulated driver: settings, stamps, faults."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest

from companion.app.devices_command import devices
from companion.config import CameraConfig
from companion.errors import ConfigError, SourceError
from companion.messages import Frame, Warned
from companion.timing.clock import FlightClock
from drivers.camera import camera_feed
from drivers.camera import v4l2_ioctl as v4l2
from drivers.camera.camera_devices import cameras
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.camera_source import Picture
from drivers.camera.exposure_choice import Exposure, ExposureRange
from drivers.camera.v4l2_camera import V4l2Camera
from tests.support.cameras.fake_v4l2 import MONOTONIC_EOF, N_BUFFERS, FakeV4l2, install
from tests.support.processes.strain import within
from tests.support.waiting import until


@pytest.fixture
def webcam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeV4l2:
    fake = FakeV4l2(tmp_path)
    fake.plug_in(0)
    install(monkeypatch, fake)
    return fake


def first(camera: V4l2Camera) -> Picture:
    picture = camera.read(1.0)
    assert picture is not None
    return picture


@pytest.fixture
def camera(request: pytest.FixtureRequest, webcam: FakeV4l2):  # type: ignore[no-untyped-def]
    made = V4l2Camera(CameraConfig(**getattr(request, "param", {})))
    yield made
    made.close()


def test_the_only_camera_is_found_by_its_stable_path(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    camera.open()
    picture = first(camera)
    assert camera.name == webcam.stable_path
    assert picture.grey.shape == (480, 640)
    assert picture.rgb.shape == (480, 640, 3)
    assert picture.grey.std() > 20
    assert webcam.format == ("YUYV", 640, 480)  # as fast as MJPG, and nothing to decode
    assert camera.remarks == []


def test_pictures_that_come_faster_than_they_are_taken_do_not_hold_it_up(
    webcam: FakeV4l2, camera: V4l2Camera
) -> None:
    camera.open()
    webcam.rate_hz = 1e9
    assert first(camera)
    assert 0 < camera.n_dropped < N_BUFFERS


@pytest.mark.parametrize("camera", [{"width": 1280, "height": 720}], indirect=True)
def test_the_format_that_is_fast_enough_is_taken(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    camera.open()
    assert first(camera).grey.shape == (720, 1280)
    assert webcam.format[0] == "MJPG"


def test_pictures_are_stamped_by_the_driver(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    camera.open()
    picture = first(camera)
    assert abs(picture.monotonic_ns - webcam.last_stamp_ns) < 1_000


@pytest.mark.parametrize("camera", [{"exposure_us": 8000}], indirect=True)
@pytest.mark.parametrize("at_end", [False, True])
def test_stamps_are_moved_to_mid_exposure(
    webcam: FakeV4l2, camera: V4l2Camera, at_end: bool
) -> None:
    if at_end:
        webcam.flags = MONOTONIC_EOF
    camera.open()
    moved_ns = first(camera).monotonic_ns - webcam.last_stamp_ns
    assert moved_ns == pytest.approx(-4_000_000 if at_end else 4_000_000, abs=1_000)


@pytest.mark.parametrize("wrong", ["unknown clock", "an hour ago"])
def test_invalid_stamps_are_replaced_and_reported(
    webcam: FakeV4l2, camera: V4l2Camera, wrong: str
) -> None:
    if wrong == "unknown clock":
        webcam.flags = 0
    else:
        webcam.lag_ns = 3_600_000_000_000
    begun_ns = time.monotonic_ns()
    camera.open()
    assert begun_ns <= first(camera).monotonic_ns <= time.monotonic_ns()
    first(camera)
    assert len(camera.remarks) == 1
    assert "stamped when read" in camera.remarks[0]


@pytest.mark.parametrize("camera", [{"exposure_us": 5000, "gain": 99, "focus": 23}], indirect=True)
def test_controls_are_set_and_automatics_put_off(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    camera.open()
    assert webcam.values == {
        v4l2.CID_EXPOSURE_AUTO: 1, v4l2.CID_EXPOSURE_ABSOLUTE: 50,
        v4l2.CID_EXPOSURE_AUTO_PRIORITY: 0, v4l2.CID_GAIN: 99, v4l2.CID_FOCUS_AUTO: 0,
        v4l2.CID_FOCUS_ABSOLUTE: 20,
    }  # fmt: skip
    assert camera.remarks == [
        f"{webcam.stable_path}: expert.camera.focus is 20 in its steps, 23 was asked"
    ]


@pytest.mark.parametrize("camera", [{"exposure": "tracking"}], indirect=True)
def test_exposure_for_tracking_is_set_and_moves_the_stamps(
    webcam: FakeV4l2, camera: V4l2Camera
) -> None:
    camera.open()
    known = camera.exposure_range
    assert known == (ExposureRange((300, 204_700), (0, 255)), Exposure(25_000, 64))
    assert webcam.values[v4l2.CID_EXPOSURE_AUTO] == v4l2.EXPOSURE_MANUAL
    assert camera.set_exposure(Exposure(4_050, 99)) == Exposure(4_000, 99)
    assert webcam.values[v4l2.CID_EXPOSURE_ABSOLUTE] == 40
    moved_ns = first(camera).monotonic_ns - webcam.last_stamp_ns
    assert moved_ns == pytest.approx(2_000_000, abs=1_000)
    assert camera.remarks == []
    camera.close()
    assert webcam.values[v4l2.CID_EXPOSURE_AUTO] == 3


@pytest.mark.parametrize("camera", [{"exposure": "tracking"}], indirect=True)
@pytest.mark.parametrize("when", ["no such control", "at the start", "in flight"])
def test_a_camera_that_refuses_is_left_to_its_own_exposure(
    webcam: FakeV4l2, camera: V4l2Camera, when: str
) -> None:
    if when == "no such control":
        del webcam.controls[v4l2.CID_EXPOSURE_ABSOLUTE]
    webcam.fixed = {v4l2.CID_EXPOSURE_ABSOLUTE} if when == "at the start" else set()
    camera.open()
    if when == "in flight":
        webcam.fixed = {v4l2.CID_EXPOSURE_ABSOLUTE}
        assert camera.set_exposure(Exposure(4_000, 99)) is None
    assert camera.exposure_range is None
    assert webcam.values[v4l2.CID_EXPOSURE_AUTO] == 3
    assert len(camera.remarks) == 1
    assert "it is left to its own exposure" in camera.remarks[0]
    assert first(camera).grey.shape == (480, 640)


@pytest.mark.parametrize("camera", [{"exposure": "tracking", "gain": 3}], indirect=True)
def test_a_fixed_gain_and_one_that_is_chosen_exclude_each_other(
    webcam: FakeV4l2, camera: V4l2Camera
) -> None:
    with pytest.raises(ConfigError, match="chooses exposure and gain"):
        camera.open()


def test_the_feed_sets_the_exposure_and_tells_it(webcam: FakeV4l2) -> None:
    config = CameraConfig(exposure="tracking")
    warned: list[Warned] = []
    feed = CameraFeed(V4l2Camera(config), FlightClock(), config, lambda _: None, warned.append)
    feed.start()
    try:
        # nothing is heard of the vehicle: half a radian per second, of a lens of 417 pixels
        until(lambda: feed.health.exposure_us is not None and feed.health.exposure_us < 7_300)
        assert webcam.values[v4l2.CID_EXPOSURE_ABSOLUTE] <= 72
    finally:
        feed.stop()
    assert warned == []


def test_what_is_left_to_the_camera_is_not_touched(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    webcam.values[v4l2.CID_GAIN] = 77
    camera.open()
    assert webcam.values[v4l2.CID_GAIN] == 77
    assert webcam.values[v4l2.CID_EXPOSURE_AUTO] == 3
    assert webcam.values[v4l2.CID_FOCUS_AUTO] == 1


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"width": 800, "height": 600}, ["800 x 600", "640 x 480, 1280 x 720"]),
        ({"gain": 256}, ["expert.camera.gain", "0 to 255"]),
        ({"pixel_format": "H264"}, ["H264", "YUYV, MJPG"]),
    ],
)
def test_what_the_camera_cannot_do(
    webcam: FakeV4l2, keys: dict[str, object], words: list[str]
) -> None:
    camera = V4l2Camera(CameraConfig(**keys))  # type: ignore[arg-type]
    with pytest.raises(ConfigError) as raised:
        camera.open()
    assert all(word in str(raised.value) for word in [*words, "usb-Acme"])
    camera.close()


def test_a_camera_without_the_control(webcam: FakeV4l2) -> None:
    del webcam.controls[v4l2.CID_FOCUS_ABSOLUTE]
    with pytest.raises(ConfigError, match=r"no such control: leave expert\.camera\.focus"):
        V4l2Camera(CameraConfig(focus=3)).open()


def test_a_rate_other_than_requested_is_reported(webcam: FakeV4l2) -> None:
    camera = V4l2Camera(CameraConfig(rate_hz=60))
    camera.open()
    camera.close()
    assert camera.remarks == [f"{webcam.stable_path}: it gives 30 pictures/s, 60 were asked"]


def test_two_cameras_are_ambiguous(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    both = FakeV4l2(tmp_path, "left"), FakeV4l2(tmp_path, "right")
    for number, each in enumerate(both):
        each.plug_in(2 * number)
    install(monkeypatch, *both)
    with pytest.raises(ConfigError, match=r"several .*Webcam_left.*Webcam_right"):
        V4l2Camera(CameraConfig()).open()
    named = V4l2Camera(CameraConfig(device=both[1].stable_path))
    named.open()
    assert first(named).grey.shape == (480, 640)
    named.close()


def test_no_camera(webcam: FakeV4l2) -> None:
    webcam.pull_out()
    with pytest.raises(SourceError, match="no camera is there"):
        V4l2Camera(CameraConfig()).open()
    with pytest.raises(SourceError, match="no such camera now"):
        V4l2Camera(CameraConfig(device=webcam.stable_path)).open()


def test_damaged_and_lost_pictures_are_counted(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    webcam.rate_hz = 4.0  # so that a reader that is held up has none to leave out
    camera.open()
    first(camera)
    n_before = camera.n_dropped
    webcam.n_lost = 3
    first(camera)
    assert camera.n_dropped == n_before + 3
    webcam.damaged, webcam.rate_hz = True, 100.0
    assert camera.read(0.5) is None
    assert camera.n_dropped > n_before + 4


def test_a_reader_that_was_slow_gets_the_newest(webcam: FakeV4l2, camera: V4l2Camera) -> None:
    camera.open()
    first(camera)
    time.sleep(0.06)
    n_before = camera.n_dropped
    picture = first(camera)
    assert picture.monotonic_ns == pytest.approx(webcam.last_stamp_ns, abs=1_000)
    assert camera.n_dropped >= n_before + 2


def test_unplugged_and_back_under_another_number(webcam: FakeV4l2) -> None:
    frames: list[Frame] = []
    warned: list[Warned] = []
    came = threading.Event()

    def deliver(frame: Frame) -> None:
        frames.append(frame)
        came.set()

    config = CameraConfig()
    feed = CameraFeed(V4l2Camera(config), FlightClock(), config, deliver, warned.append)
    feed.start()
    try:
        assert came.wait(60)
        webcam.pull_out()
        until(lambda: feed.health.state == "missing")
        with within(1.0):
            webcam.plug_in(3)
            came.clear()
            assert came.wait(60)
        assert feed.health.state == "running"
        assert feed.health.n_reopened == 1
    finally:
        feed.stop()
    told = [each.what for each in warned]
    assert (told[0], told[-1]) == (camera_feed.GONE, camera_feed.BACK)
    assert set(told[1:-1]) <= {camera_feed.MISSING}
    assert [frame.seq for frame in frames] == list(range(len(frames)))


def test_devices_lists_what_a_camera_can_do(webcam: FakeV4l2) -> None:
    (found,) = cameras()
    assert (found.name, found.stable_path, found.problem) == ("Acme Webcam", webcam.stable_path, "")
    assert [(each.code, each.width, each.rates_hz) for each in found.formats] == [
        ("YUYV", 640, (30.0, 15.0)), ("YUYV", 1280, (10.0,)),
        ("MJPG", 640, (30.0,)), ("MJPG", 1280, (30.0,)),
    ]  # fmt: skip
    text = devices(as_json=False)
    assert "YUYV  640 x 480 at 30, 15/s; 1280 x 720 at 10/s" in text
    assert "Gain = 64, 0 to 255, default 64" in text
    assert "Auto Exposure = 3 of: 1 Manual Mode, 3 Aperture Priority Mode; default 3" in text
