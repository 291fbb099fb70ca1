"""Subtitles of DJI's videos as telemetry."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TypeVar

import av
import numpy as np
import pytest

from companion.config import CameraConfig
from companion.geometry.transforms import rotation_from_quaternion
from companion.telemetry import AttitudeSample, HeightSample, PositionSample
from drivers.flight import Flight
from drivers.open_flight import open_flight
from drivers.telemetry.telemetry_srt import cues_of
from tests.support.flights.logs import START_NS, write_times, write_video

Kind = TypeVar("Kind", PositionSample, HeightSample, AttitudeSample)
BRACKETS = (
    '<font size="28">FrameCnt: {n}, DiffTime: 100ms\n2025-11-01 12:26:40.{n:03d}\n'
    "[iso: 100] [shutter: 1/2000.0] [fnum: 2.8] [focal_len: 24.00] [dzoom_ratio: 1.00], "
    "[latitude: {lat:.6f}] [longitude: {lon:.6f}] [rel_alt: {up:.3f} abs_alt: {sea:.3f}] "
    "[gb_yaw: 90.0 gb_pitch: -30.0 gb_roll: 0.0] [ct: 5500] </font>"
)
OLD = (
    "HOME(8.545600,47.397700) 2017.06.10 15:06:05\nGPS({lon:.6f},{lat:.6f},19) "
    "BAROMETER:{up:.1f}\nISO:100 Shutter:60 EV:0 Fnum:2.2"
)
RTK = (
    "F/2.8, SS 206.14, ISO 150, EV 0, GPS ({lon:.6f}, {lat:.6f}, 15), D 20.1m, H {up:.2f}m, "
    "H.S 1.00m/s, V.S 0.50m/s"
)
TYPO = "[iso : 110] [latitude : {lat:.6f}] [longtitude : {lon:.6f}] [altitude: {sea:.3f}]"


def cue(number: int, form: str) -> tuple[str, str]:
    text = form.format(
        n=number + 1, lat=47.3977 + number * 1e-5, lon=-8.5456 - number * 2e-5,
        up=30.5 + number, sea=520.25 + number,
    )  # fmt: skip
    return f"00:00:0{number // 10},{number % 10 * 100:03d}", text


def write_srt(path: Path, form: str, n: int = 10) -> None:
    blocks = []
    for number in range(n):
        begin, text = cue(number, form)
        end, _ = cue(number + 1, form)
        blocks.append(f"{number + 1}\n{begin} --> {end}\n{text}\n\n")
    path.write_text("".join(blocks))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    write_video(tmp_path / "DJI_0001.MP4.mp4", 10)
    (tmp_path / "DJI_0001.MP4.mp4").rename(tmp_path / "DJI_0001.MP4")
    return tmp_path / "DJI_0001.MP4"


def opened(path: Path) -> Flight:
    return open_flight(path, CameraConfig())


def of_kind(flight: Flight, kind: type[Kind]) -> list[Kind]:
    return [s for s in flight.telemetry().samples if isinstance(s, kind)]


def test_brackets(video: Path) -> None:
    """Place, heights and where the camera looks: east, 30 degrees down."""
    write_srt(video.with_suffix(".SRT"), BRACKETS)
    flight = opened(video)
    places = of_kind(flight, PositionSample)
    assert [p.t_ns for p in places] == list(flight.times_ns)
    log = flight.telemetry()
    assert log.origin is not None
    assert (log.origin.latitude_deg, log.origin.longitude_deg) == (47.3977, -8.5456)
    assert log.origin.altitude_m == 520.25
    np.testing.assert_allclose(
        places[-1].position_ned_m,
        [9e-5 * 111_175, -18e-5 * 111_320 * math.cos(math.radians(47.3977)) * 1.0018, -9],
        atol=0.01,
    )
    assert [h.height_m for h in of_kind(flight, HeightSample)][:2] == [30.5, 31.5]
    assert flight.camera.body_from_camera is not None
    attitude = rotation_from_quaternion(of_kind(flight, AttitudeSample)[0].ned_from_body)
    looks = (attitude @ flight.camera.body_from_camera.rotation)[:, 2]
    np.testing.assert_allclose(looks, [0, math.sqrt(0.75), 0.5], atol=1e-9)
    assert flight.camera.fx == pytest.approx(24 / 43.2666 * 80)


@pytest.mark.parametrize(
    ("form", "height"), [(OLD, 30.5), (RTK, 30.5), (TYPO, 520.25), (BRACKETS, 520.25)]
)
def test_forms(video: Path, form: str, height: float) -> None:
    write_srt(video.with_suffix(".srt"), form)
    log = opened(video).telemetry()
    assert log.origin is not None
    assert (log.origin.latitude_deg, log.origin.longitude_deg) == (47.3977, -8.5456)
    assert log.origin.altitude_m == height
    assert log.rates_hz["GPS"] == 10
    from_start = "heights count from the take-off" in {w.what for w in log.warnings}
    assert from_start == (height < 100)


def test_in_a_flight_folder(tmp_path: Path) -> None:
    """On the clock of frames.csv."""
    write_video(tmp_path / "camera.mp4")
    write_times(tmp_path / "frames.csv", [START_NS + k * 200_000_000 for k in range(10)])
    write_srt(tmp_path / "camera.srt", BRACKETS)
    places = of_kind(opened(tmp_path), PositionSample)
    assert places[3].t_ns == START_NS + 600_000_000


def test_inside_the_video(tmp_path: Path) -> None:
    """Muxed as FFmpeg would from a file; then there is none beside it."""
    write_srt(tmp_path / "apart.srt", BRACKETS)
    write_video(tmp_path / "apart.mp4")
    path = tmp_path / "DJI_0002.mkv"
    with (
        av.open(str(path), "w") as writer,
        av.open(str(tmp_path / "apart.mp4")) as pictures,
        av.open(str(tmp_path / "apart.srt")) as text,
    ):
        sources = pictures.streams.video[0], text.streams.subtitles[0]
        streams = [writer.add_stream_from_template(source) for source in sources]
        for source, stream in zip((pictures, text), streams, strict=True):
            for packet in source.demux():
                if packet.size:
                    packet.stream = stream
                    writer.mux(packet)
    found = list(cues_of(path))
    assert [c.t_ns for c in found] == [k * 100_000_000 for k in range(10)]
    assert found[4].said["latitude"] == pytest.approx(47.39774)
    assert len(of_kind(opened(path), PositionSample)) == 10


def test_places_that_are_not_new(video: Path) -> None:
    """The receiver is slower than the subtitles."""
    write_srt(video.with_suffix(".SRT"), BRACKETS.replace("{lat:.6f}", "{lat:.4f}"), 10)
    text = video.with_suffix(".SRT").read_text()
    same = re.sub(r"longitude: [-.\d]+", "longitude: 8.0", text)
    video.with_suffix(".SRT").write_text(same)
    assert len(of_kind(opened(video), PositionSample)) == 2


@pytest.mark.parametrize(
    "text", ["", "no subtitles", "1\n00:00:00,000 --> 00:00:01,000\nHello, world.\n",
             "1\n00:00:00,000 --> 00:00:01,000\n[latitude: 0.0] [longitude: 0.0]\n",
             "1\n00:00:00,000 --> 00:00:01,000\n[latitude: 147.0] [longitude: 8.0]\n"],
)  # fmt: skip
def test_subtitles_of_another_kind(video: Path, text: str) -> None:
    video.with_suffix(".SRT").write_text(text)
    assert {w.what for w in opened(video).telemetry().warnings} == {"no telemetry"}


@pytest.mark.parametrize("seed", range(20))
def test_damaged_subtitles(video: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    write_srt(video.with_suffix(".SRT"), BRACKETS)
    data = bytearray(video.with_suffix(".SRT").read_bytes())
    for at in rng.integers(0, len(data), 40):
        data[at] = rng.integers(256)
    video.with_suffix(".SRT").write_bytes(data[: int(rng.integers(len(data)))])
    for found in cues_of(video):
        assert all(math.isfinite(value) for value in found.said.values())
        assert abs(found.said.get("latitude", 0)) <= 90
