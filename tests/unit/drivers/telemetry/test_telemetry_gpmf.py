from __future__ import annotations

import struct

import numpy as np
import pytest

from companion.telemetry import PositionSample
from drivers.telemetry.gpmf_camera import camera_fixes
from drivers.telemetry.gpmf_records import GpmfError, read_streams
from drivers.telemetry.telemetry_gpmf import _offset
from tests.support.flights.logs import klv

SCALES = struct.pack(">8i", 1000, 1, 1, 1, 1, 1, 1, 1)
ROWS = [(146_065, 0.1, -0.4, 2.0, 1, 2, 3, 0), (146_317, 0.2, -0.5, 2.1, 4, 5, 6, 0)]
ATTITUDE = (
    klv("STNM", "c", 1, b"Attitude")
    + klv("TYPE", "c", 1, b"LffffffB")
    + klv("SCAL", "l", 4, SCALES)
    + klv("ATTD", "?", 29, b"".join(struct.pack(">L6fB", *row) for row in ROWS))
)
GYRO = klv("SCAL", "s", 2, struct.pack(">h", 100)) + klv(
    "GYRO", "s", 6, struct.pack(">3h", 1, -2, 3)
)
PAYLOAD = klv("DEVC", "\0", 1, klv("STRM", "\0", 1, ATTITUDE) + klv("STRM", "\0", 1, GYRO))


def test_streams_in_their_units() -> None:
    attitude, gyro = read_streams(PAYLOAD)
    assert (attitude.key, gyro.key) == ("ATTD", "GYRO")
    np.testing.assert_allclose(attitude.rows[0, :4], [146.065, 0.1, -0.4, 2.0], atol=1e-6)
    assert attitude.rows.shape == (2, 8)
    np.testing.assert_allclose(gyro.rows, [[0.01, -0.02, 0.03]])


def test_what_holds_text_is_passed_over() -> None:
    """Cameras from the HERO8 on name the scenes that they recognise beside their gyroscope."""
    scenes = klv("TYPE", "c", 1, b"Ff") + klv("SCEN", "?", 8, struct.pack(">4sf", b"SNOW", 0.5))
    payload = klv("DEVC", "\0", 1, klv("STRM", "\0", 1, scenes) + klv("STRM", "\0", 1, GYRO))
    assert [stream.key for stream in read_streams(payload)] == ["GYRO"]


def test_damage_is_an_error_or_fewer_streams(rng: np.random.Generator) -> None:
    for _ in range(300):
        damaged = bytearray(PAYLOAD)
        for at in rng.integers(0, len(PAYLOAD), 3):
            damaged[at] = rng.integers(0, 256)
        try:
            streams = read_streams(bytes(damaged))
        except GpmfError:
            continue
        assert all(stream.rows.ndim == 2 for stream in streams)


def test_blocks_bound_the_clock() -> None:
    """Four samples a second, collected in blocks of a second of a video 140.3 s younger."""
    offset_ns = -140_300_000_000
    stamps = np.arange(140_400_000_000, 152_000_000_000, 252_000_000)
    spans = []
    for second in range(11):
        begin, end = second * 10**9, (second + 1) * 10**9
        inside = stamps[(stamps + offset_ns >= begin) & (stamps + offset_ns < end)]
        spans.append((begin, end, int(inside[0]), int(inside[-1])))
    found, sigma_ns = _offset(spans)
    assert abs(found - offset_ns) < 126_000_000
    assert abs(found - offset_ns) < 2 * sigma_ns


def test_a_block_that_is_late() -> None:
    spans = [
        (k * 10**9, (k + 1) * 10**9, (k + 50) * 10**9, (k + 50) * 10**9 + 9 * 10**8)
        for k in range(9)
    ]
    spans[4] = (spans[4][0], spans[4][1], spans[4][2] - 2 * 10**9, spans[4][3] - 2 * 10**9)
    found, sigma_ns = _offset(spans)
    assert found == pytest.approx(-50e9, abs=1e8)
    assert sigma_ns > 1e8


def camera_block(latitude: float, fix: int, dilution: int = 150) -> bytes:
    """Two places of a camera's own receiver, as GPS5."""
    rows = [(latitude, -8.5, 500.5, 3.0, 3.5), (latitude + 1e-5, -8.50002, 501.5, 3.0, 3.5)]
    scales = (10_000_000, 10_000_000, 1000, 1000, 100)
    data = b"".join(
        struct.pack(">5l", *(round(v * s) for v, s in zip(row, scales, strict=True)))
        for row in rows
    )
    stream = (
        klv("GPSF", "L", 4, struct.pack(">L", fix))
        + klv("GPSP", "S", 2, struct.pack(">H", dilution))
        + klv("SCAL", "l", 4, struct.pack(">5l", *scales))
        + klv("GPS5", "l", 20, data)
    )
    return klv("DEVC", "\0", 1, klv("STRM", "\0", 1, stream))


def test_places_of_the_camera_itself() -> None:
    """Spread over their blocks; those without a fix, or a bad one, are left out."""
    second = 1_000_000_000
    blocks = [camera_block(47.1, 3), camera_block(47.2, 0), camera_block(47.3, 3, 2500),
              camera_block(47.4, 3)]  # fmt: skip
    payloads = [(k * second, (k + 1) * second, block) for k, block in enumerate(blocks)]
    collected = camera_fixes("video", payloads)
    log = collected.finish(lambda t_ns, _: t_ns, None)
    found = [s for s in log.samples if isinstance(s, PositionSample)]
    assert [s.t_ns for s in found] == [second // 4, 3 * second // 4, 13 * second // 4,
                                       15 * second // 4]  # fmt: skip
    assert log.origin is not None
    assert log.origin.latitude_deg == pytest.approx(47.1)
    assert log.origin.longitude_deg == pytest.approx(-8.5)
    assert found[0].sigma_horizontal_m == 4.5
    assert found[1].position_ned_m[2] == pytest.approx(-1, abs=0.01)
