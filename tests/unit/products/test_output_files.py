from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.geometry.transforms import angle_between, rotation_from_quaternion
from companion.messages import Odometry, TrackState
from companion.products.atomic_file import write_atomically
from companion.products.cloud import no_cloud
from companion.products.cloud_ply import ply_parts
from companion.products.flight_result import FlightResult
from companion.products.report.report_json import report, report_json, state_spans
from companion.products.report.write_results import write_results
from companion.products.trajectory_file import exact_seconds, trajectory_tum
from tests.support.flights import flown
from tests.support.reference.scoring import read_ply


@pytest.fixture(scope="module")
def result() -> FlightResult:
    flight = FlightResult()
    for message in flown.messages():
        flight.take(message)
    return flight


def numbers(result: FlightResult, **changes: object) -> dict[str, Any]:
    made = report(result, flown.facts(**changes), result.poses(), result.cloud(0.5))
    read: dict[str, Any] = json.loads(report_json(made))
    return read


def test_report_counts_what_did_not_fit_the_motion() -> None:
    flight = FlightResult()
    for message in flown.messages():
        flight.take(message)
    assert numbers(flight)["refused"] == {}
    flight.take(Odometry(1, 10**9, TrackState.TRACKING, 0, refused={"place": 2}))
    assert numbers(flight)["refused"] == {"place": 2}


def test_trajectory_reads_back_as_it_was(result: FlightResult) -> None:
    lines = trajectory_tum(result.poses(), "m", None).decode("ascii").splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    assert len(rows) == len(result.poses())
    for row, (seq, t_ns, _) in zip(rows, result.poses(), strict=True):
        whole, part = row[0].split(".")
        assert int(whole) * 10**9 + int(part) == t_ns
        x, y, z, w = map(float, row[4:])
        assert len({round(abs(v), 3) for v in (x, y, z, w)}) == 4  # else an order could hide
        true = flown.world_from_camera(seq)
        assert angle_between(rotation_from_quaternion(np.array([w, x, y, z])), true.rotation) < 1e-6
        assert np.allclose([float(v) for v in row[1:4]], true.translation, atol=1e-6)


def test_trajectory_says_its_frame_and_unit(result: FlightResult) -> None:
    origin = flown.facts().origin
    metric = trajectory_tum(result.poses(), "m", origin).decode("ascii")
    assert "NED" in metric and "metres" in metric and "47.39770000" in metric
    loose = trajectory_tum(result.poses(), "map units", origin).decode("ascii")
    assert "no metric scale" in loose and "metres" not in loose and "47.39" not in loose


@pytest.mark.parametrize(
    ("t_ns", "text"),
    [
        (1_700_000_000_000_000_001, "1700000000.000000001"),
        (5, "0.000000005"),
        (-1_500_000_000, "-1.500000000"),
    ],
)
def test_seconds_lose_no_nanosecond(t_ns: int, text: str) -> None:
    assert exact_seconds(t_ns) == text


def test_cloud_reads_back_as_it_was(tmp_path: Path, result: FlightResult) -> None:
    cloud = result.cloud(0.5)
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"".join(ply_parts(cloud, "m", flown.facts().origin)))
    read = read_ply(path)
    assert read.dtype.names == (
        "x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "confidence", "sigma"
    )  # fmt: skip
    assert np.array_equal(np.stack([read["n" + a] for a in "xyz"], 1), cloud.normals)
    assert np.array_equal(read["sigma"], cloud.sigma)
    assert np.array_equal(np.stack([read[a] for a in "xyz"], 1), cloud.points)
    assert np.array_equal(np.stack([read[c] for c in ("red", "green", "blue")], 1), cloud.rgb)
    assert np.array_equal(read["confidence"], cloud.confidence)


def test_an_empty_cloud_is_a_file_too(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    path.write_bytes(b"".join(ply_parts(no_cloud(), "map units", None)))
    assert len(read_ply(path)) == 0


def test_report_has_the_numbers(result: FlightResult) -> None:
    n = numbers(result)
    unplaced = flown.N_INITIALISING + len(flown.LOST)
    assert n["frames"] == flown.N_FRAMES
    assert n["tracked"] == flown.N_FRAMES - unplaced
    assert n["tracked_share"] == pytest.approx(1 - unplaced / flown.N_FRAMES, abs=1e-4)
    assert n["keyframes"] == flown.N_FRAMES // flown.PER_KEYFRAME
    assert n["points"] == len(result.cloud(0.5))
    assert n["duration_s"] == pytest.approx((flown.N_FRAMES - 1) * 0.05)
    assert n["metres_per_unit"] == flown.METRES_PER_UNIT
    assert n["scale"]["method"] == "GPS positions"
    assert n["scale"]["sigma_relative"] == 0.008
    assert n["clock"] == {
        "method": "TIMESYNC", "offset_s": -83.0213, "drift_ppm": 14.2, "sigma_ms": 0.8, "reboots": 1
    }  # fmt: skip
    assert n["speed"]["frames_per_s"] == flown.N_FRAMES / 10
    assert n["stages"]["features"]["p95_ms"] == 19.5
    assert n["kernels"]["search"]["n"] == 12
    assert n["kernels"]["search"]["p50_ms"] == pytest.approx(25.5, rel=0.011)
    assert n["warnings"] == [{"what": "late telemetry", "count": 2, "first_detail": "by 0.3 s"}]
    assert n["segments"] == 2
    assert n["states"] == {"initialising": 10, "tracking": flown.N_FRAMES - unplaced, "lost": 12}
    assert n["completed"] is True


def test_path_length_is_that_of_the_way(result: FlightResult) -> None:
    places = [flown.place_m(pose.seq) for pose in result.poses()]
    way = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert numbers(result)["path_length"] == pytest.approx(way, abs=1e-3)


def test_what_is_not_known_is_null() -> None:
    n = numbers(FlightResult(), clock=None, origin=None, wall_s=0.0)
    assert n["frames"] == n["tracked"] == n["points"] == 0
    assert n["metres_per_unit"] is n["scale"] is n["clock"] is n["origin"] is None
    assert n["unit"] == "map units"


def test_state_spans_cover_every_frame_once(result: FlightResult) -> None:
    spans = state_spans(result.tracks)
    assert [span["state"] for span in spans] == ["initialising", "tracking", "lost", "tracking"]
    assert sum(span["frames"] for span in spans) == flown.N_FRAMES
    lost = next(span for span in spans if span["state"] == TrackState.LOST.value)
    assert lost["from_s"] == pytest.approx(flown.LOST[0] * 0.05)
    assert lost["to_s"] == pytest.approx(flown.LOST[-1] * 0.05)


def test_results_are_the_same_bytes_each_time(tmp_path: Path, result: FlightResult) -> None:
    for name in ("one", "two"):
        write_results(tmp_path / name, result, flown.facts(), 0.5)
    names = ["cloud.ply", "report.html", "report.json", "trajectory.tum"]
    for folder in ("one", "two"):
        assert sorted(path.name for path in (tmp_path / folder).iterdir()) == names
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "result"
    write_atomically(path, b"old")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="no space left on device: "):
        write_atomically(path, b"new")
    assert [p.name for p in tmp_path.iterdir()] == ["result"]
    assert path.read_bytes() == b"old"


def test_a_write_replaces(tmp_path: Path) -> None:
    write_atomically(tmp_path / "result", b"longer than")
    write_atomically(tmp_path / "result", b"new")
    assert (tmp_path / "result").read_bytes() == b"new"
