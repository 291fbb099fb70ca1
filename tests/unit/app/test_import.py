"""Flights of other formats as flight folders, read back equal."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from companion.app.cli import main
from companion.app.import_command import import_flight
from companion.app.progress import Progress
from companion.config import CameraConfig, Config
from companion.errors import FlightError, InputError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import ClockReport, Frame
from companion.telemetry import (
    ArmedSample,
    AttitudeSample,
    HeightSample,
    ImuSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from drivers.flight import Flight
from drivers.open_flight import format_of, open_flight
from drivers.telemetry.telemetry_csv import read_telemetry_csv, telemetry_csv
from drivers.telemetry.telemetry_log import TelemetryLog
from tests.support.flights.bags import write_bag
from tests.support.flights.sequences import (
    Piece,
    piece,
    write_euroc,
    write_flight_folder,
    write_remode,
)


@pytest.fixture(scope="module")
def flown() -> Piece:
    return piece().part(5)


def imported(source: Path, out: Path) -> tuple[Flight, list[str]]:
    told: list[str] = []
    n = import_flight(source, out, Config(), Progress(), told.append)
    flight = open_flight(out, CameraConfig())
    assert format_of(out).name == "flight folder"
    assert flight.n_frames == n
    return flight, told


def same_samples(one: TelemetryLog, other: TelemetryLog) -> bool:
    def words(log: TelemetryLog) -> list[str]:
        return [line for line in telemetry_csv(log) if not line.startswith("#")]

    return words(one) == words(other)


def same_camera(one: Camera, other: Camera) -> bool:
    numbers = [
        (c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.distortion, c.coefficients, c.assumed)
        for c in (one, other)
    ]
    poses = [c.body_from_camera for c in (one, other)]
    if poses[0] is None or poses[1] is None:
        return numbers[0] == numbers[1] and poses[0] is poses[1]
    near = np.allclose(poses[0].matrix(), poses[1].matrix(), atol=1e-12)
    return numbers[0] == numbers[1] and near


def same_pictures(one: Flight, other: Flight) -> bool:
    a, b = ([f for f in flight.frames() if isinstance(f, Frame)] for flight in (one, other))
    return len(a) == len(b) and all(
        x.t_ns == y.t_ns and (x.rgb == y.rgb).all() for x, y in zip(a, b, strict=True)
    )


def assert_same(one: Flight, other: Flight) -> None:
    assert one.times_ns == other.times_ns
    assert same_camera(one.camera, other.camera)
    assert same_pictures(one, other)
    assert same_samples(one.telemetry(), other.telemetry())
    assert one.telemetry().origin == other.telemetry().origin
    ours = [(w.t_ns, w.what, w.detail) for w in one.telemetry().warnings]
    for warned in (*other.warnings, *other.telemetry().warnings):
        assert (warned.t_ns, warned.what, warned.detail) in ours


@pytest.mark.parametrize("origin", [None, GeoOrigin(-35.36, 149.17, 584.0)])
def test_bag(tmp_path: Path, flown: Piece, origin: GeoOrigin | None) -> None:
    write_bag(tmp_path / "bag", "mcap", flown, origin=origin)
    flight, _ = imported(tmp_path / "bag", tmp_path / "out")
    assert_same(flight, open_flight(tmp_path / "bag", CameraConfig()))
    assert flight.telemetry().rates_hz["imu"] > 1


def test_euroc_with_a_hole(tmp_path: Path, flown: Piece) -> None:
    """The frame without picture is left out; truth lies where scoring looks for it."""
    write_euroc(tmp_path / "flown", flown)
    (tmp_path / "flown" / "mav0" / "cam0" / "data" / f"{flown.frames[1].t_ns}.png").unlink()
    flight, told = imported(tmp_path / "flown", tmp_path / "out")
    assert flight.times_ns == tuple(f.t_ns for i, f in enumerate(flown.frames) if i != 1)
    assert told[0].startswith("images of the list are missing: 1 of 5")
    truth = np.loadtxt(tmp_path / "out" / "truth" / "world_from_camera.tum")
    np.testing.assert_allclose(truth[3, 1:4], flown.truth[3].translation, atol=1e-6)


def test_readout_of_a_rolling_shutter_is_kept(tmp_path: Path, flown: Piece) -> None:
    write_flight_folder(tmp_path / "flown", flown)
    stated = tmp_path / "flown" / "camera.json"
    stated.write_text(json.dumps(json.loads(stated.read_text()) | {"readout_ms": 18.5}))
    flight, _ = imported(tmp_path / "flown", tmp_path / "out")
    assert flight.camera.readout_ms == 18.5


@pytest.mark.parametrize("origin", [None, GeoOrigin(-35.36, 149.17, 584.0)])
def test_as_a_recording(tmp_path: Path, flown: Piece, origin: GeoOrigin | None) -> None:
    write_bag(tmp_path / "bag", "mcap", flown, origin=origin)
    n = import_flight(tmp_path / "bag", tmp_path / "a.mcap", Config(), Progress(), print)
    flight = open_flight(tmp_path / "a.mcap", CameraConfig())
    assert format_of(tmp_path / "a.mcap").name == "recording"
    assert flight.n_frames == n
    heights = [w for w in flight.telemetry().warnings if w.what.startswith("heights of NavSatFix")]
    assert len(heights) == (origin is not None)
    assert_same(flight, open_flight(tmp_path / "bag", CameraConfig()))
    with pytest.raises(FlightError, match="is there already"):
        import_flight(tmp_path / "bag", tmp_path / "a.mcap", Config(), Progress(), print)


def test_warning_lines_may_be_damaged(tmp_path: Path) -> None:
    said = ['1,["a, b", "c"]', '1,["a"]', "1,[", '-1,["a", "b"]', "1,7", "", f'{9**30},["a", "b"]']
    lines = [*(f"# warning,{each}" for each in said), "unix_ns,kind,values", "5,height,1.0", ""]
    (tmp_path / "telemetry.csv").write_text("\n".join(lines))
    warnings = read_telemetry_csv(tmp_path / "telemetry.csv").warnings
    assert [(w.t_ns, w.what, w.detail) for w in warnings] == [(1, "a, b", "c")]


def test_recording_that_cannot_be_written(tmp_path: Path, flown: Piece) -> None:
    write_remode(tmp_path / "flown", flown)
    (tmp_path / "file").write_text("")
    with pytest.raises(FlightError, match="cannot be written"):
        import_flight(tmp_path / "flown", tmp_path / "file" / "a.mcap", Config(), Progress(), print)


def test_sample(tmp_path: Path) -> None:
    """Video and packets of a link: the video as it was, the telemetry on its clock."""
    source = Path(__file__).parents[3] / "sample" / "survey"
    flight, _ = imported(source, tmp_path / "out")
    before = open_flight(source, CameraConfig())
    assert (tmp_path / "out" / "camera.mp4").read_bytes() == (source / "camera.mp4").read_bytes()
    assert flight.times_ns == before.times_ns
    assert same_samples(flight.telemetry(), before.telemetry())
    clock, same = flight.telemetry().clock, before.telemetry().clock
    assert clock is not None
    assert same is not None
    assert dataclasses.asdict(clock) == dataclasses.asdict(same)


def test_camera_that_is_assumed_stays_so(tmp_path: Path, flown: Piece) -> None:
    write_remode(tmp_path / "flown", flown)
    flight, _ = imported(tmp_path / "flown", tmp_path / "out")
    assert not flight.camera.assumed
    (tmp_path / "out" / "camera.json").unlink()
    (tmp_path / "out" / "images" / "000004.png").write_bytes(b"none")
    again, told = imported(tmp_path / "out", tmp_path / "again")
    assert again.camera.assumed
    assert "no camera.json: the camera is assumed" in " ".join(told)
    assert "the camera is assumed" in {w.what for w in again.warnings}


def test_nothing_is_overwritten(tmp_path: Path, flown: Piece) -> None:
    write_remode(tmp_path / "flown", flown)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("precious")
    with pytest.raises(FlightError, match="is there already"):
        imported(tmp_path / "flown", tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["mine"]
    with pytest.raises(InputError, match=r"ending in \.mcap"):
        imported(tmp_path / "flown", tmp_path / "out.bag")


def test_nothing_is_left_of_an_import_that_fails(tmp_path: Path, flown: Piece) -> None:
    write_remode(tmp_path / "flown", flown)

    class Stopped(Progress):
        def update(self, done: int, state: str, n_points: int) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_flight(tmp_path / "flown", tmp_path / "out", Config(), Stopped(), print)
    assert [p.name for p in tmp_path.iterdir()] == ["flown"]


def test_command(tmp_path: Path, flown: Piece, capsys: pytest.CaptureFixture[str]) -> None:
    write_remode(tmp_path / "flown", flown)
    source, out = str(tmp_path / "flown"), tmp_path / "out"
    assert main(["import", source, "--out", str(out)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "no times: images are taken to come at 10/s: REMODE",
        "no telemetry: neither scale nor level will be known",
        f"flight: {out}, 5 frames",
    ]
    assert main(["import", source, "--out", str(out)]) == 2


SAMPLES: list[Telemetry] = [
    AttitudeSample(10**18 + 1, np.array([0.5, -0.5, 0.1, 0.7]), None),
    AttitudeSample(10**18 + 2, np.array([1, 0, 0, 0.0]), np.array([0.1, 0.2, 1 / 3])),
    ImuSample(10**18 + 3, np.array([1.0, 2, 3]), np.array([4.0, 5, 6])),
    PositionSample(10**18 + 4, PositionSource.LOCAL, np.array([1.0, 2, 3]), None),
    PositionSample(
        10**18 + 5, PositionSource.GPS, np.array([1.0, 2, 3]), np.array([4.0, 5, np.nan]), 0.5, 0.75
    ),
    RangeSample(10**18 + 6, 7.5),
    HeightSample(10**18 + 7, -3.25),
    ArmedSample(10**18 + 8, True),
    ArmedSample(10**18 + 9, False),
]


def test_table_keeps_every_sample_as_it_is(tmp_path: Path) -> None:
    origin, clock = GeoOrigin(1 / 3, -2 / 3, 100.1), ClockReport("TIMESYNC", 1.5, -2.25, 0.125, 2)
    log = TelemetryLog("test", SAMPLES, clock, origin)
    (tmp_path / "telemetry.csv").write_text("".join(telemetry_csv(log)))
    content = read_telemetry_csv(tmp_path / "telemetry.csv")
    assert content.host_ns is not None
    back = content.collected.finish(content.host_ns, content.clock)
    assert "".join(telemetry_csv(dataclasses.replace(back, clock=clock))) == "".join(
        telemetry_csv(log)
    )
    assert content.clock is not None
    assert dataclasses.astuple(content.clock) == dataclasses.astuple(clock)
    velocity = back.samples[4]
    assert isinstance(velocity, PositionSample)
    assert velocity.velocity_ned_m_s is not None
    assert np.isnan(velocity.velocity_ned_m_s[2])


@pytest.mark.parametrize("seed", range(30))
def test_damaged_table(tmp_path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    log = TelemetryLog("test", SAMPLES * 20, None, GeoOrigin(1.0, 2.0, 3.0))
    data = bytearray("".join(telemetry_csv(log)).encode())
    for at in rng.integers(0, len(data), 30):
        data[at] = rng.integers(256)
    path = tmp_path / "telemetry.csv"
    path.write_bytes(data[: int(rng.integers(1, len(data)))])
    try:
        content = read_telemetry_csv(path)
    except FlightError as error:
        assert "telemetry.csv" in str(error)
    else:
        assert content.host_ns is not None
        content.collected.finish(content.host_ns, None)
