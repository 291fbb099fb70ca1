from __future__ import annotations

import json
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import FlightError
from companion.messages import Frame, Warned
from drivers.flight import Flight
from drivers.open_flight import open_flight
from tests.support.flights.logs import (
    START_NS,
    Tlog,
    attitude,
    heartbeat,
    picture,
    write_times,
    write_video,
)
from tests.unit.drivers.images.test_calibration import GOOD

STEP_NS = 100_000_000
TIMES = [START_NS + k * STEP_NS for k in range(10)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_video(tmp_path / "camera.mp4")
    write_times(tmp_path / "frames.csv", TIMES)
    (tmp_path / "camera.json").write_text(json.dumps(GOOD))
    return tmp_path


AS_FOUND = CameraConfig()


def opened(folder: Path, camera: CameraConfig = AS_FOUND) -> Flight:
    return open_flight(folder, camera)


def frames(flight: Flight, *part: int) -> list[Frame]:
    return [item for item in flight.frames(*part) if isinstance(item, Frame)]


def numbers(found: list[Frame]) -> list[int]:
    """Which pictures these are, by what is in them."""
    return [round((float(frame.grey[40:, 40:].mean()) - 20) / 12) for frame in found]


def whats(warnings: tuple[Warned, ...]) -> list[str]:
    return [warned.what for warned in warnings]


def test_all_frames(folder: Path) -> None:
    flight = opened(folder)
    found = frames(flight)
    assert (flight.n_frames, flight.start_ns, flight.stop_ns) == (10, TIMES[0], TIMES[-1] + 1)
    assert [frame.t_ns for frame in found] == TIMES
    assert [frame.seq for frame in found] == list(range(10)) == numbers(found)
    assert flight.warnings == ()


def test_pictures_are_upright_and_red_is_red(folder: Path) -> None:
    frame = frames(opened(folder))[3]
    assert frame.rgb.shape == (48, 64, 3)
    assert frame.grey.shape == (48, 64)
    np.testing.assert_allclose(frame.rgb[5, 5].astype(int), [200, 10, 10], atol=12)
    assert abs(int(frame.rgb[5, 50, 0]) - int(frame.rgb[5, 50, 2])) < 12


def test_decoding_twice_is_the_same(folder: Path) -> None:
    flight = opened(folder)
    for a, b in zip(frames(flight), frames(flight), strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)


@pytest.mark.parametrize("start", range(10))
def test_a_part_is_what_it_is_in_the_whole(folder: Path, start: int) -> None:
    flight = opened(folder)
    whole = frames(flight)
    part = frames(flight, TIMES[start], TIMES[min(start + 3, 9)])
    assert len(part) == flight.n_frames_between(TIMES[start], TIMES[min(start + 3, 9)])
    for frame in part:
        np.testing.assert_array_equal(frame.rgb, whole[frame.seq].rgb)
    assert [frame.seq for frame in part] == list(range(start, min(start + 3, 9)))


def test_leaving_early_leaves_no_thread(folder: Path) -> None:
    before = threading.active_count()
    with pytest.raises(RuntimeError):
        for _ in opened(folder).frames():
            raise RuntimeError
    reading = opened(folder).frames()
    next(reading)
    reading.close()  # type: ignore[attr-defined]
    assert threading.active_count() == before


def test_video_that_ends_early(folder: Path) -> None:
    write_video(folder / "camera.mp4", 6)
    flight = opened(folder)
    assert whats(flight.warnings) == ["the video ends early"]
    assert numbers(frames(flight)) == list(range(6))


def test_video_cut_off(folder: Path) -> None:
    data = (folder / "camera.mp4").read_bytes()
    (folder / "camera.mp4").write_bytes(data[:-200])
    found = list(opened(folder).frames())
    usable = [item for item in found if isinstance(item, Frame)]
    assert 0 < len(usable) < 10
    assert numbers(usable) == [frame.seq for frame in usable]


def test_damaged_picture_leaves_a_hole(folder: Path) -> None:
    """The numbers of those after it stay, and so do their times."""
    data = bytearray((folder / "camera.mp4").read_bytes())
    at = data.index(b"mdat") + (len(data) - data.index(b"mdat")) // 2
    data[at : at + 60] = bytes(60)
    (folder / "camera.mp4").write_bytes(bytes(data))
    found = list(opened(folder).frames())
    assert len(found) == 10
    usable = [item for item in found if isinstance(item, Frame)]
    assert len(usable) >= 5
    assert all(frame.t_ns == TIMES[frame.seq] for frame in usable)
    assert usable[-1].seq == 9


def test_more_pictures_than_times(folder: Path) -> None:
    write_times(folder / "frames.csv", TIMES[:7])
    flight = opened(folder)
    assert whats(flight.warnings) == ["frames.csv ends early"]
    assert len(frames(flight)) == 7


def test_frames_that_were_not_listed(folder: Path) -> None:
    rows = [f"{k},{TIMES[k]}" for k in (0, 1, 4, 9)]
    (folder / "frames.csv").write_text("\n".join(["index,unix_ns", *rows]))
    found = frames(opened(folder))
    assert numbers(found) == [0, 1, 4, 9]
    assert [frame.t_ns for frame in found] == [TIMES[k] for k in (0, 1, 4, 9)]


def test_times_that_go_back_are_left_out(folder: Path) -> None:
    write_times(folder / "frames.csv", [*TIMES[:4], TIMES[2], TIMES[3], *TIMES[6:]])
    flight = opened(folder)
    assert whats(flight.warnings) == ["frames out of order left out"]
    assert numbers(frames(flight)) == [0, 1, 2, 3, 6, 7, 8, 9]


@pytest.mark.parametrize(
    "text",
    ["", "index,unix_ns\n", "a,b\n0,1\n", "index,unix_ns\n0,soon\n1,5\n",
     "index,unix_ns\n5,1\n4,2\n0,3\n", "index,unix_ns\n50,1\n", "index,unix_ns\n-1,5\n0,6\n"],
)  # fmt: skip
def test_lists_that_are_none(folder: Path, text: str) -> None:
    (folder / "frames.csv").write_text(text)
    with pytest.raises(FlightError, match=r"frames\.csv"):
        opened(folder)


def test_last_line_cut_off(folder: Path) -> None:
    text = (folder / "frames.csv").read_text()
    (folder / "frames.csv").write_text(text.rstrip()[:-20])
    flight = opened(folder)
    assert "the last line of frames.csv is damaged" in whats(flight.warnings)
    assert len(frames(flight)) == 9


def test_no_list_of_times(folder: Path) -> None:
    (folder / "frames.csv").unlink()
    flight = opened(folder)
    assert whats(flight.warnings) == ["no frames.csv: times are the file's own"]
    steps = np.diff([frame.t_ns for frame in frames(flight)])
    np.testing.assert_allclose(steps, STEP_NS, atol=1e3)


def test_no_calibration(folder: Path) -> None:
    (folder / "camera.json").unlink()
    flight = opened(folder, CameraConfig(assumed_hfov_deg=60))
    assert flight.camera.assumed
    assert flight.camera.body_from_camera is None
    assert whats(flight.warnings) == ["no camera.json: the camera is assumed"]
    with pytest.raises(FlightError, match="assumed_hfov_deg"):
        opened(folder, CameraConfig(assumed_hfov_deg=0))


def test_numbered_images(tmp_path: Path) -> None:
    """Ten comes after nine; a damaged one leaves a hole."""
    (tmp_path / "images").mkdir()
    for number in range(12):
        cv2.imwrite(str(tmp_path / "images" / f"im{number}.png"), picture(number)[..., ::-1])
    (tmp_path / "images" / "im5.png").write_bytes(b"no image")
    flight = opened(tmp_path)
    found = list(flight.frames())
    assert [item.seq for item in found if isinstance(item, Frame)] == [*range(5), *range(6, 12)]
    assert numbers([item for item in found if isinstance(item, Frame)]) == [
        *range(5),
        *range(6, 12),
    ]
    assert [item.what for item in found if isinstance(item, Warned)] == [
        "a picture could not be decoded"
    ]


def test_no_flight(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match="nowhere"):
        opened(tmp_path / "nowhere")
    with pytest.raises(FlightError, match="no video"):
        opened(tmp_path)
    (tmp_path / "camera.mp4").write_bytes(b"no video")
    with pytest.raises(FlightError, match=r"camera\.mp4"):
        opened(tmp_path)
    with pytest.raises(FlightError, match=r"camera\.mp4"):
        opened(tmp_path / "camera.mp4")
    (tmp_path / "a.tlog").write_bytes(b"")
    with pytest.raises(FlightError, match="goes to --log"):
        opened(tmp_path / "a.tlog")
    (tmp_path / "note.txt").write_text("no flight")
    with pytest.raises(FlightError, match="not a folder, and no file that holds a flight"):
        opened(tmp_path / "note.txt")


def test_two_videos(folder: Path) -> None:
    write_video(folder / "another.mp4", 3)
    assert opened(folder).n_frames == 10
    (folder / "camera.mp4").rename(folder / "one.mp4")
    with pytest.raises(FlightError, match=r"another\.mp4, one\.mp4"):
        opened(folder)


def fly(folder: Path, name: str, start_ns: int, seconds: float = 1.0) -> None:
    log = Tlog()
    for k in range(int(seconds * 50)):
        log.add(start_ns + k * 20_000_000, attitude(5 * 10**9 + k * 20_000_000, 0, 0, 1))
    log.add(start_ns, heartbeat(True))
    (folder / name).write_bytes(log.data)


def test_telemetry(folder: Path) -> None:
    fly(folder, "telemetry.tlog", START_NS)
    log = opened(folder).telemetry()
    assert log.rates_hz["attitude"] == pytest.approx(50, rel=0.01)
    assert log.warnings == ()


def test_no_telemetry(folder: Path) -> None:
    log = opened(folder).telemetry()
    assert not log.samples
    assert whats(log.warnings) == ["no telemetry"]


@pytest.mark.parametrize("name", ["a.tlog", "a.BIN", "a.ulg"])
@pytest.mark.parametrize("content", [b"", b"\xa3\x95\x80", bytes(range(256)) * 40])
def test_telemetry_that_is_none(folder: Path, name: str, content: bytes) -> None:
    (folder / name).write_bytes(content)
    log = opened(folder).telemetry()
    assert not log.samples
    assert "no telemetry that can be used" in whats(log.warnings)
    named = TelemetryConfig(log=str(folder / name))  # what was asked for is not passed over
    with pytest.raises(FlightError, match=f"{name}: no telemetry that can be used"):
        open_flight(folder, AS_FOUND, named).telemetry()


def test_telemetry_of_another_time(folder: Path) -> None:
    fly(folder, "telemetry.tlog", START_NS + 100 * 10**9)
    with pytest.raises(FlightError) as raised:
        opened(folder).telemetry()
    line = str(raised.value)
    assert "telemetry.tlog" in line
    assert "1762000000.0" in line
    assert "1762000100.0" in line


def test_telemetry_shifted_by_configuration(folder: Path) -> None:
    fly(folder, "telemetry.tlog", START_NS + 100 * 10**9)
    log = open_flight(folder, CameraConfig(), TelemetryConfig(offset_s=-100)).telemetry()
    assert log.samples[0].t_ns == pytest.approx(START_NS, abs=5e6)


def test_of_several_logs_the_one_of_the_video(folder: Path) -> None:
    fly(folder, "a.tlog", START_NS + 100 * 10**9)
    fly(folder, "b.tlog", START_NS)
    log = opened(folder).telemetry()
    assert log.source == "b.tlog"
    assert "several telemetry logs" in whats(log.warnings)
