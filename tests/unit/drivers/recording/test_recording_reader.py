import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from companion.config import CameraConfig, RecorderConfig, TelemetryConfig
from companion.errors import ConfigError, FlightError
from companion.geometry.geodesy import GeoOrigin
from companion.messages import ClockReport, Frame, Warned
from drivers.open_flight import open_flight
from drivers.recording.mcap_file import McapFile
from drivers.recording.mcap_scan import scan
from drivers.recording.picture_codec import picture_encoder
from drivers.recording.recording_as_flight import RecordedFlight, is_recording, open_recording
from drivers.telemetry.tlog_records import TlogRecords
from drivers.video import h264_encoder
from tests.support.flights.recorded import SIZE, START_NS, STEP_NS, camera, frames, record, samples

N = 30
X264 = "libx264"
HOLDS_BACK = {"preset": "veryfast", "x264-params": "sync-lookahead=0:rc-lookahead=4"}


def opened(folder: Path) -> RecordedFlight:
    return open_recording(folder / "flight.mcap", CameraConfig(), TelemetryConfig())


def frames_of(flight: RecordedFlight) -> list[Frame]:
    return [frame for frame in flight.frames() if isinstance(frame, Frame)]


def plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value.tobytes() if isinstance(value, np.ndarray) else value


def test_samples_camera_clock_and_origin_come_back_exactly(tmp_path: Path) -> None:
    record(tmp_path / "f")
    assert is_recording(tmp_path / "f" / "flight.mcap")
    flight = opened(tmp_path / "f")
    assert flight.warnings == ()
    assert plain(flight.camera) == plain(camera())
    log = flight.telemetry()
    assert [plain(each) for each in log.samples] == [plain(each) for each in samples(N)]
    assert plain(log.clock) == plain(ClockReport("TIMESYNC", 1 / 3, 2.0, 0.1, 0))
    assert log.origin == GeoOrigin(47.1, 8.2, 400.0)


@pytest.mark.parametrize("codec", ["mjpeg", "h264", "png", "raw"])
def test_frames_come_back_with_their_numbers_and_times(tmp_path: Path, codec: str) -> None:
    record(tmp_path / "f", N, codec)
    flight = opened(tmp_path / "f")
    was, now = frames(N), frames_of(flight)
    assert [(f.seq, f.t_ns) for f in now] == [(f.seq, f.t_ns) for f in was]
    assert flight.n_frames == N and flight.times_ns[-1] == START_NS + (N - 1) * STEP_NS
    for before, after in zip(was, now, strict=True):
        away = np.abs(before.rgb.astype(float) - after.rgb).mean()
        assert away == 0 if codec in ("png", "raw") else away < 8
    part = list(flight.frames(START_NS + 10 * STEP_NS, START_NS + 13 * STEP_NS))
    assert [f.seq for f in part if isinstance(f, Frame)] == [15, 16, 17]
    assert all(isinstance(f, Frame) and np.array_equal(f.rgb, now[f.seq - 5].rgb) for f in part)


def test_an_encoder_that_holds_pictures_back_loses_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(h264_encoder, "OPTIONS", {X264: HOLDS_BACK})
    record(tmp_path / "f", N, "h264", config=RecorderConfig(least_free_mb=0, h264_encoder=X264))
    was, now = frames(N), frames_of(opened(tmp_path / "f"))
    assert [(f.seq, f.t_ns) for f in now] == [(f.seq, f.t_ns) for f in was]
    for k in range(0, N, 7):  # each is its own picture, not its neighbour's
        away = [np.abs(was[k].rgb.astype(float) - each.rgb).mean() for each in now]
        assert int(np.argmin(away)) == k


@pytest.mark.parametrize("codec", ["png", "raw"])
def test_without_loss_a_grey_picture_of_its_own_comes_back_too(tmp_path: Path, codec: str) -> None:
    record(tmp_path / "f", 5, codec, grey_is_of_colours=False)
    for before, after in zip(frames(5, False), frames_of(opened(tmp_path / "f")), strict=True):
        assert np.array_equal(before.rgb, after.rgb) and np.array_equal(before.grey, after.grey)


def test_replay_opens_it_by_file_and_by_folder(tmp_path: Path) -> None:
    record(tmp_path / "f", 5)
    for path in (tmp_path / "f", tmp_path / "f" / "flight.mcap"):
        assert isinstance(open_flight(path, CameraConfig()), RecordedFlight)


def test_two_readings_give_the_same_bytes(tmp_path: Path) -> None:
    record(tmp_path / "f", N, "h264")
    first, second = (frames_of(opened(tmp_path / "f")) for _ in range(2))
    assert [plain(f) for f in first] == [plain(f) for f in second]


def test_bytes_of_the_link_are_kept_and_a_tlog_beside(tmp_path: Path) -> None:
    record(tmp_path / "f")
    with (tmp_path / "f" / "flight.mcap").open("rb") as stream:
        found: dict[str, bytes] = {}
        exchanges = 0
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found[channel.topic] = found.get(channel.topic, b"") + message.data
            exchanges += channel.topic == "/mavlink/timesync"
    tlog = (tmp_path / "f" / "flight.tlog").read_bytes()
    packets = TlogRecords(tlog)
    told = list(packets)
    assert len(told) == 4 * N and packets.n_damaged == 0
    for component, topic in ((1, "/mavlink/received"), (197, "/mavlink/sent")):
        n_bytes = sum(r.end - r.begin - 8 for r in told if r.component == component)
        assert n_bytes <= len(found[topic])
    assert all(abs(r.unix_us - START_NS // 1000) < 2_000_000 for r in told)
    assert exchanges == N


def test_others_know_its_schemas(tmp_path: Path) -> None:
    record(tmp_path / "f", 10)
    with (tmp_path / "f" / "flight.mcap").open("rb") as stream:
        names = {
            channel.topic: schema.name
            for schema, channel, _ in make_reader(stream).iter_messages()
            if schema is not None
        }
    assert names["/camera/image"] == "foxglove.CompressedImage"
    assert names["/camera/calibration"] == "foxglove.CameraCalibration"
    assert names["/pose"] == "foxglove.PoseInFrame"
    assert names["/events"] == "foxglove.Log"
    assert names["/mavlink/received"] == "companion.MavlinkBytes"
    assert names["/telemetry/attitude"] == "companion.AttitudeSample"


def test_cut_short_it_is_repaired_and_says_so(tmp_path: Path) -> None:
    record(tmp_path / "f", N, per_chunk=10)
    path = tmp_path / "f" / "flight.mcap"
    with McapFile(path) as file:
        chunks = scan(file).chunks
    assert len(chunks) >= 4
    path.write_bytes(path.read_bytes()[: chunks[-1].end - 100])
    for _ in range(2):  # said again when it is opened again
        flight = opened(tmp_path / "f")
        assert [w.what for w in flight.warnings] == ["the recording was cut short"]
        assert [f.seq for f in frames_of(flight)] == list(range(5, flight.n_frames + 5))
        assert flight.n_frames >= 20


def test_video_after_a_gap_waits_for_an_intra_picture(tmp_path: Path) -> None:
    folder = tmp_path / "f"
    record(folder, 75, "h264", per_chunk=10)
    path = folder / "flight.mcap"
    flight = opened(folder)
    whole = {f.seq: f.rgb for f in frames_of(flight)}
    places = flight.recording.pictures
    assert [p.seq for p in places if p.intra] == [5, 35, 65]
    chunk = flight.recording.found.chunks[places[10].chunk]
    assert places[0].chunk < places[10].chunk < places[25].chunk
    data = bytearray(path.read_bytes())
    data[chunk.end - 50] ^= 1
    path.write_bytes(data)
    told = list(opened(folder).frames())
    assert {w.what for w in told if isinstance(w, Warned)} == {"a picture could not be decoded"}
    kept = {f.seq: f.rgb for f in told if isinstance(f, Frame)}
    assert all(np.array_equal(rgb, whole[seq]) for seq, rgb in kept.items())
    assert kept.keys() == {p.seq for p in places if p.chunk < places[10].chunk or p.seq >= 35}


def test_damage_anywhere_never_crashes(tmp_path: Path) -> None:
    record(tmp_path / "f", 12, per_chunk=3)
    data = (tmp_path / "f" / "flight.mcap").read_bytes()
    damaged = tmp_path / "g" / "flight.mcap"
    damaged.parent.mkdir()
    n_opened = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        changed = np.frombuffer(data, np.uint8).copy()
        at = int(rng.integers(8, len(data)))
        if seed % 4 == 0:
            changed = changed[:at]
        elif seed % 4 == 1:
            changed[at : at + 1000] = 0
        else:
            for _ in range(20):
                changed[int(rng.integers(8, len(data)))] ^= 1 << int(rng.integers(8))
        damaged.write_bytes(changed.tobytes())
        try:
            flight = open_recording(damaged, CameraConfig(), TelemetryConfig())
        except FlightError as error:
            assert str(damaged) in str(error)
            continue
        n_opened += 1
        for frame in flight.frames():
            assert not isinstance(frame, Frame) or frame.rgb.shape == (SIZE[1], SIZE[0], 3)
        flight.telemetry()
    assert n_opened > 20


def test_an_encoder_that_does_not_work_is_named() -> None:
    config = RecorderConfig(codec="h264", h264_encoder="h264_nonsense")
    with pytest.raises(ConfigError, match="h264_nonsense"):
        picture_encoder(config, 64, 48, 30.0)
