"""Cameras without hardware: files in real time, the test pattern, GStreamer; and clocks."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from companion.config import CameraConfig, MountConfig
from companion.errors import ConfigError, SourceError
from companion.geometry.transforms import angle_between
from companion.messages import Bytes
from drivers.camera import gstreamer_camera
from drivers.camera.arrival_clock import ArrivalClock
from drivers.camera.camera_registry import camera_source
from drivers.camera.camera_source import CameraSource, DriverFault, EndOfPictures, Picture
from drivers.camera.live_calibration import live_camera
from drivers.camera.pattern_camera import (
    PatternScene,
    pattern_optics,
    world_from_body,
    world_from_camera,
)
from drivers.camera.pixel_formats import to_grey_and_rgb

MS = 1_000_000


def taken(source: CameraSource, n: int, limit_s: float = 3.0) -> list[Picture]:
    """The next n pictures."""
    pictures: list[Picture] = []
    deadline_s = time.monotonic() + limit_s
    while len(pictures) < n and time.monotonic() < deadline_s:
        picture = source.read(0.1)
        if picture is not None:
            pictures.append(picture)
    return pictures


@pytest.mark.parametrize(
    ("source", "key"), [("gstreamer", "pipeline"), ("network", "url"), ("file", "path")]
)
def test_what_a_camera_needs_is_asked_for(source: Any, key: str) -> None:
    with pytest.raises(ConfigError, match=rf"camera\.{key} is not set"):
        camera_source(CameraConfig(source=source))


# --- files


def flight(folder: Path, after_ms: list[int]) -> Path:
    (folder / "images").mkdir(parents=True)
    for number in range(len(after_ms)):
        cv2.imwrite(str(folder / "images" / f"{number}.png"), np.full((32, 48), number, np.uint8))
    lines = [f"{number},{10**18 + ms * MS}" for number, ms in enumerate(after_ms)]
    (folder / "frames.csv").write_text("\n".join(["index,unix_ns", *lines, ""]))
    return folder


@pytest.mark.real_time
def test_a_flight_comes_in_the_time_it_was_taken(tmp_path: Path) -> None:
    after_ms = [0, 30, 60, 150, 180]
    camera = camera_source(CameraConfig(source="file", path=str(flight(tmp_path, after_ms))))
    camera.open()
    pictures = []
    for _ in after_ms:
        pictures += taken(camera, 1)
        assert 0 <= time.monotonic_ns() - pictures[-1].monotonic_ns < 100 * MS
    assert [int(p.grey[0, 0]) for p in pictures] == [0, 1, 2, 3, 4]
    begun_ns = pictures[0].monotonic_ns
    assert [(p.monotonic_ns - begun_ns) // MS for p in pictures] == after_ms
    with pytest.raises(EndOfPictures):
        camera.read(0.1)
    camera.close()
    assert camera.n_dropped == 0


@pytest.mark.real_time
def test_late_pictures_are_left_out_and_counted(tmp_path: Path) -> None:
    camera = camera_source(
        CameraConfig(source="file", path=str(flight(tmp_path, list(range(0, 400, 20)))))
    )
    camera.open()
    (first,) = taken(camera, 1)
    time.sleep(0.11)
    (next_one,) = taken(camera, 1)
    camera.close()
    n_between = int(next_one.grey[0, 0]) - int(first.grey[0, 0]) - 1
    assert n_between >= 4
    assert camera.n_dropped == n_between


@pytest.mark.real_time
def test_it_begins_again_and_time_goes_on(tmp_path: Path) -> None:
    folder = flight(tmp_path, [0, 20, 40])
    camera = camera_source(CameraConfig(source="file", path=str(folder), repeat=True))
    camera.open()
    pictures = taken(camera, 7)
    camera.close()
    assert [int(p.grey[0, 0]) for p in pictures] == [0, 1, 2, 0, 1, 2, 0]
    steps = np.diff([p.monotonic_ns for p in pictures]) / MS
    assert np.all(steps >= 19.9)


@pytest.mark.real_time
def test_it_can_begin_at_a_set_time(tmp_path: Path) -> None:
    at_s = time.time() + 0.2
    config = CameraConfig(source="file", path=str(flight(tmp_path, [0, 20])), starts_at_unix_s=at_s)
    camera = camera_source(config)
    camera.open()
    (first,) = taken(camera, 1)
    camera.close()
    epoch_ns = time.time_ns() - time.monotonic_ns()
    assert abs(first.monotonic_ns + epoch_ns - at_s * 1e9) < 2 * MS


@pytest.mark.parametrize("name", ["nothing", "note.txt"])
def test_no_such_file(tmp_path: Path, name: str) -> None:
    (tmp_path / "note.txt").write_text("no video")
    with pytest.raises(ConfigError, match=rf"camera\.path: .*{name}"):
        camera_source(CameraConfig(source="file", path=str(tmp_path / name))).open()


# --- the test pattern


@pytest.mark.real_time
def test_the_pattern_keeps_time() -> None:
    camera = camera_source(CameraConfig(source="pattern", width=160, height=120, rate_hz=50))
    camera.open()
    stamps = [p.monotonic_ns for p in taken(camera, 10)]
    assert abs(time.monotonic_ns() - stamps[-1]) < 50 * MS
    camera.close()
    steps = np.diff(stamps)
    assert np.all(steps % (20 * MS) == 0)
    assert camera.n_dropped == int(np.sum(steps // (20 * MS) - 1))
    with pytest.raises(SourceError):
        camera.read(0.1)


def test_the_pattern_shows_the_plain_as_its_pose_says() -> None:
    config = CameraConfig(source="pattern")
    optics, scene = pattern_optics(config), PatternScene()
    early, late = world_from_camera(10**9), world_from_camera(10**9 + 100 * MS)
    before, after = (scene.picture(optics, pose)[0] for pose in (early, late))
    corners = cv2.goodFeaturesToTrack(before, 400, 0.01, 8)
    found, seen, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy())
    rays = np.c_[optics.normalise(corners[:, 0]), np.ones(len(corners))] @ early.rotation.T
    ground = early.translation + rays * (-early.translation[2] / rays[:, 2])[:, None]
    where = optics.project(late.inverse().apply(ground))
    off_px = np.linalg.norm(where - found[:, 0], axis=1)[seen[:, 0] > 0]
    assert np.median(off_px) < 0.1
    assert np.linalg.norm(where - corners[:, 0], axis=1).mean() > 3  # it does move
    # and what stands higher moves more: not all can be explained by one plane
    assert np.mean(off_px > 0.5) > 0.02


def test_the_pattern_moves_smoothly_and_its_camera_is_known() -> None:
    times_ns = [k * 10 * MS for k in range(400)]
    places = np.array([world_from_body(t_ns).translation for t_ns in times_ns])
    speed_m_s = np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.01
    assert 0.5 < speed_m_s.min() < speed_m_s.max() < 2
    turn = [
        angle_between(world_from_body(a).rotation, world_from_body(b).rotation)
        for a, b in itertools.pairwise(times_ns)
    ]
    assert max(turn) / 0.01 < 0.3
    camera, warnings = live_camera(CameraConfig(source="pattern"), MountConfig(), 640, 480)
    assert (camera.assumed, warnings) == (False, [])
    assert camera.body_from_camera is not None
    np.testing.assert_allclose(camera.body_from_camera.rotation @ [0, 0, 1], [0, 0, 1])


# --- GStreamer

BALL = (
    "videotestsrc is-live=true pattern=ball ! "
    "video/x-raw,format={form},width={width},height=48,framerate=50/1"
)


def gstreamer(pipeline: str) -> CameraSource:
    return camera_source(CameraConfig(source="gstreamer", pipeline=pipeline))


@pytest.fixture(scope="session")
def needs_gstreamer() -> None:
    check = (
        "import gi; gi.require_version('Gst', '1.0'); from gi.repository import Gst;"
        "Gst.init(None); assert Gst.ElementFactory.find('appsink')"
    )
    python = gstreamer_camera.SYSTEM_PYTHON
    if not os.access(python, os.X_OK) or subprocess.call([python, "-I", "-c", check]):
        pytest.skip(gstreamer_camera.INSTALL)


@pytest.mark.parametrize(
    ("form", "width"),  # rows of 70 pixels have a gap behind them
    [("NV12", 64), ("NV12", 70), ("YUY2", 70), ("I420", 64), ("GRAY8", 64), ("BGRx", 64)],
)
def test_gstreamer_gives_stamped_pictures(needs_gstreamer: None, form: str, width: int) -> None:
    camera = gstreamer(BALL.format(form=form, width=width))
    camera.open()
    pictures = taken(camera, 4)
    now_ns = time.monotonic_ns()
    camera.close()
    assert {p.grey.shape for p in pictures} == {(48, width)}
    steps = np.diff([p.monotonic_ns for p in pictures])
    assert np.all(np.abs(steps - np.round(steps / (20 * MS)) * 20 * MS) < MS)
    assert np.all(steps > 10 * MS)
    assert 0 <= now_ns - pictures[-1].monotonic_ns < 400 * MS
    assert pictures[-1].grey.max() > 200  # the ball
    assert not np.array_equal(pictures[0].grey, pictures[-1].grey)
    if form != "GRAY8":
        assert np.abs(pictures[0].rgb.mean(2) - pictures[0].grey).mean() < 20
    assert camera.remarks == []


def test_gstreamer_plays_what_is_not_live_in_its_time(needs_gstreamer: None) -> None:
    camera = gstreamer("videotestsrc num-buffers=8 ! video/x-raw,width=64,framerate=50/1")
    camera.open()
    stamps = []
    with pytest.raises(EndOfPictures):
        while True:
            picture = camera.read(0.2)
            stamps += [picture.monotonic_ns] if picture else []
    camera.close()
    assert (stamps[-1] - stamps[0]) == pytest.approx(20 * MS * (len(stamps) - 1), abs=40 * MS)
    assert len(stamps) > 4


@pytest.mark.parametrize(
    ("pipeline", "kind", "words"),
    [
        ("nosuchsrc ! queue", ConfigError, ["nosuchsrc", "apt install"]),
        ("videotestsrc ! ! ", ConfigError, ["camera.pipeline"]),
        ("filesrc location=/nonexistent ! jpegdec", SourceError, ["GStreamer filesrc"]),
    ],
)
def test_a_pipeline_that_cannot_be(
    needs_gstreamer: None, pipeline: str, kind: type[Exception], words: list[str]
) -> None:
    camera = gstreamer(pipeline)
    with pytest.raises(kind) as raised:
        camera.open()
        taken(camera, 1)
    camera.close()
    assert all(word in str(raised.value) for word in words)
    assert "\n" not in str(raised.value)


def test_a_pipelines_process_that_dies(needs_gstreamer: None) -> None:
    camera = gstreamer(BALL.format(form="NV12", width=64))
    camera.open()
    assert isinstance(camera, gstreamer_camera.GstreamerCamera)
    assert camera._child is not None
    camera._child.kill()
    with pytest.raises(SourceError, match="has ended"):
        taken(camera, 50)
    camera.close()
    camera.open()
    assert len(taken(camera, 1)) == 1
    camera.close()


def test_the_child_ends_when_nobody_asks_any_more(needs_gstreamer: None) -> None:
    camera = gstreamer(BALL.format(form="NV12", width=64))
    camera.open()
    assert isinstance(camera, gstreamer_camera.GstreamerCamera)
    child = camera._child
    assert child is not None
    camera.close()
    assert child.returncode == 0  # by itself, not by force


def test_a_python_without_gstreamer_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    monkeypatch.setattr(gstreamer_camera, "SYSTEM_PYTHON", sys.executable)
    with pytest.raises(ConfigError, match=r"missing.*apt install python3-gi"):
        gstreamer("videotestsrc").open()
    monkeypatch.setattr(gstreamer_camera, "SYSTEM_PYTHON", str(tmp_path / "none"))
    with pytest.raises(ConfigError, match="apt install python3-gi"):
        gstreamer("videotestsrc").open()


def test_a_bug_in_the_pipelines_process_comes_with_its_traceback(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "gi").mkdir()
    (tmp_path / "gi" / "__init__.py").write_text(
        "def require_version(*_):\n    raise RuntimeError('a bug')\n"
    )
    child = tmp_path / "child.py"
    child.write_text(
        f"import runpy, sys\nsys.path.insert(0, {str(tmp_path)!r})\n"
        f"runpy.run_path({str(gstreamer_camera.CHILD)!r}, run_name='__main__')\n"
    )
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    monkeypatch.setattr(gstreamer_camera, "SYSTEM_PYTHON", sys.executable)
    monkeypatch.setattr(gstreamer_camera, "CHILD", child)
    with pytest.raises(DriverFault, match=r"(?s)Traceback.*require_version.*RuntimeError: a bug"):
        gstreamer("videotestsrc").open()


def test_what_is_printed_of_a_pipeline_holds_no_password() -> None:
    assert gstreamer("rtspsrc location=rtsp://u:pw@h/ ! x").name == "GStreamer rtspsrc"


# --- pixels


def rainbow(width: int, height: int) -> Bytes:
    hue = np.tile(np.linspace(0, 170, width), (height, 1))
    value = np.tile(np.linspace(90, 220, height)[:, None], (1, width))
    hsv = np.dstack([hue, np.full_like(hue, 120), value]).astype(np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.uint8)


def encoded(code: str, rgb: Bytes, gap: int) -> tuple[bytes, int]:
    """The bytes of a picture in a format, rows followed by a gap; and the bytes from row to row."""
    i420 = np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420), np.uint8)
    height, width = rgb.shape[:2]
    y = i420[:height]
    u, v = i420[height:].reshape(2, height // 2, width // 2)
    if code == "YU12":  # its colours have half the rows, of half the length
        planes = [_with_gap(y, gap), _with_gap(u, gap // 2), _with_gap(v, gap // 2)]
        return b"".join(plane.tobytes() for plane in planes), width + gap
    u_row, v_row = (np.repeat(plane, 2, axis=0) for plane in (u, v))
    rows = {
        "NV12": np.vstack([y, np.dstack([u, v]).reshape(height // 2, width)]),
        "YUYV": np.dstack([y[:, ::2], u_row, y[:, 1::2], v_row]).reshape(height, -1),
        "UYVY": np.dstack([u_row, y[:, ::2], v_row, y[:, 1::2]]).reshape(height, -1),
        "RGB3": rgb.reshape(height, -1),
        "BGR3": rgb[..., ::-1].reshape(height, -1),
        "GREY": np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8),
    }[code]
    rows = _with_gap(rows, gap)
    return rows.tobytes(), rows.shape[1]


def _with_gap(rows: Bytes, gap: int) -> Bytes:
    return np.hstack([rows, np.full((len(rows), gap), 7, np.uint8)])


@pytest.mark.parametrize("gap", [0, 6])
@pytest.mark.parametrize("code", ["YUYV", "UYVY", "NV12", "YU12", "RGB3", "BGR3", "GREY"])
def test_pixel_formats(code: str, gap: int) -> None:
    rgb = rainbow(64, 48)
    data, stride = encoded(code, rgb, gap)
    arrays = to_grey_and_rgb(code, data, 64, 48, stride)
    assert arrays is not None
    grey, colours = arrays
    wanted = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    assert np.corrcoef(grey.ravel(), wanted.ravel())[0, 1] > 0.99
    if code != "GREY":
        assert np.abs(colours.astype(int) - rgb).mean() < 5
    assert to_grey_and_rgb(code, data[:-stride], 64, 48, stride) is None


def test_half_a_jpeg_is_none() -> None:
    data = cv2.imencode(".jpg", rainbow(64, 48)[..., ::-1])[1].tobytes()
    arrays = to_grey_and_rgb("MJPG", data, 64, 48)
    assert arrays is not None
    assert np.abs(arrays[1].astype(int) - rainbow(64, 48)).mean() < 5
    assert to_grey_and_rgb("MJPG", data + bytes(20), 64, 48) is not None
    for damaged in (data[: len(data) // 2], b"", b"\xff\xd8", data[9:]):
        assert to_grey_and_rgb("MJPG", damaged, 64, 48) is None


# --- stamps of what comes by a network


def test_arrival_clock_sees_through_jitter_and_drift(rng: np.random.Generator) -> None:
    clock = ArrivalClock()
    sent = np.arange(3000) * 33 * MS
    true = 5_000_000_000 + (sent * (1 - 80e-6)).astype(np.int64)
    arrived = true + (2 * MS + rng.exponential(8 * MS, len(sent))).astype(np.int64)
    told = [clock.monotonic_ns(int(s), int(a)) for s, a in zip(sent, arrived, strict=True)]
    off_ms = (np.array(told) - true)[300:] / MS
    assert np.all(np.array(told) <= arrived)
    assert np.percentile(np.abs(off_ms - 2), 95) < 2.5  # where arrivals scatter by 8 ms


def test_arrival_clock_does_not_believe_a_backlog() -> None:
    clock = ArrivalClock()
    for k in range(30):  # a second of pictures at once
        clock.monotonic_ns(k * 33 * MS, 10**9 + k * MS // 10)
        assert k < 2 or not clock.settled
    for k in range(30, 50):
        told_ns = clock.monotonic_ns(k * 33 * MS, 10**9 + (k - 29) * 33 * MS)
    assert clock.settled
    assert told_ns == pytest.approx(10**9 + 20 * 33 * MS, abs=3 * MS)


def test_arrival_clock_after_a_stall_and_a_step() -> None:
    clock = ArrivalClock()
    for k in range(100):
        clock.monotonic_ns(k * 33 * MS, k * 33 * MS + 10**9)
    # two seconds of pictures that were held up come at once, with their own times
    told = [clock.monotonic_ns(k * 33 * MS, 160 * 33 * MS + 10**9) for k in range(100, 160)]
    assert np.diff(told) == pytest.approx(33 * MS, abs=MS)
    # a sender whose stamps begin anew is believed after a while
    for k in range(160, 300):
        told_ns = clock.monotonic_ns((k - 160) * 33 * MS, k * 33 * MS + 10**9)
    assert told_ns == pytest.approx(299 * 33 * MS + 10**9, abs=MS)
