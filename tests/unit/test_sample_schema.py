"""One schema of each telemetry message; what recordings and tables held of old stays as it was."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.sample_schema import fields_of
from companion.telemetry import (
    TELEMETRY,
    ArmedSample,
    AttitudeSample,
    DepthSample,
    HeightSample,
    ImuSample,
    LandedSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from drivers.recording.recording_codec import sample_bytes, sample_of, sample_topic
from drivers.recording.recording_topics import open_channels
from drivers.telemetry.telemetry_csv import read_telemetry_csv, telemetry_csv
from drivers.telemetry.telemetry_log import TelemetryLog

NAN = float("nan")
GPS, GLOBAL = PositionSource.GPS, PositionSource.GLOBAL
WRITTEN: list[tuple[Telemetry, str, str]] = [
    (
        AttitudeSample(5, np.array([0.5, -0.5, 0.1, 0.7])),
        '{"ned_from_body":[0.5,-0.5,0.1,0.7],"rates_body_rad_s":null}',
        "5,attitude,0.5,-0.5,0.1,0.7,,,",
    ),
    (
        AttitudeSample(5, np.array([1.0, 0, 0, 0]), np.array([0.1, 0.2, 1 / 3])),
        '{"ned_from_body":[1.0,0.0,0.0,0.0],"rates_body_rad_s":[0.1,0.2,0.3333333333333333]}',
        "5,attitude,1.0,0.0,0.0,0.0,0.1,0.2,0.3333333333333333",
    ),
    (
        ImuSample(5, np.array([1.0, 2, 3]), np.array([4.0, 5, -6])),
        '{"gyro_rad_s":[1.0,2.0,3.0],"accel_m_s2":[4.0,5.0,-6.0]}',
        "5,imu,1.0,2.0,3.0,4.0,5.0,-6.0",
    ),
    (
        ImuSample(5, np.array([1.0, 2, 3]), np.array([4.0, 5, -6]), less_biases=True),
        '{"gyro_rad_s":[1.0,2.0,3.0],"accel_m_s2":[4.0,5.0,-6.0],"less_biases":true}',
        "5,imu,1.0,2.0,3.0,4.0,5.0,-6.0,1.0",
    ),
    (
        PositionSample(5, GPS, np.array([1.0, 2, 3]), np.array([4.0, 5, NAN]), 0.5),
        '{"source":"GPS","position_ned_m":[1.0,2.0,3.0],"velocity_ned_m_s":[4.0,5.0,null],'
        '"sigma_horizontal_m":0.5,"sigma_vertical_m":null}',
        "5,GPS,1.0,2.0,3.0,4.0,5.0,nan,0.5,",
    ),
    (
        PositionSample(5, GLOBAL, np.array([1.0, 2, 3])),
        '{"source":"global position","position_ned_m":[1.0,2.0,3.0],"velocity_ned_m_s":null,'
        '"sigma_horizontal_m":null,"sigma_vertical_m":null}',
        "5,global position,1.0,2.0,3.0,,,,,",
    ),
    (RangeSample(5, 7.5), '{"distance_m":7.5}', "5,range,7.5"),
    (HeightSample(5, -3.25), '{"height_m":-3.25}', "5,height,-3.25"),
    (ArmedSample(5, True), '{"armed":true}', "5,armed,1.0"),
    (
        DepthSample(5, 7.5, 2.0, 4.25, 0.5),
        '{"u_px":7.5,"v_px":2.0,"depth_m":4.25,"sigma_m":0.5}',
        "5,depth,7.5,2.0,4.25,0.5",
    ),
    (LandedSample(5, True), '{"landed":true}', "5,landed,1.0"),
]
NUMBERS = '{"type": "array", "items": {"type": "number"}}'
SCHEMAS = {
    "attitude": '{"title": "companion.AttitudeSample", "description": "Attitude of the body (FRD) '
    'in NED: quaternion w x y z; body rates, rad/s", "type": "object", "properties": '
    f'{{"ned_from_body": {NUMBERS}, "rates_body_rad_s": {NUMBERS}}}}}',
    "imu": '{"title": "companion.ImuSample", "description": "Angular rate and specific force in '
    'the body frame (FRD)", "type": "object", "properties": '
    f'{{"gyro_rad_s": {NUMBERS}, "accel_m_s2": {NUMBERS}, "less_biases": {{"type": "boolean"}}}}}}',
    "position": '{"title": "companion.PositionSample", "description": "Position and velocity of '
    'the body in local NED", "type": "object", "properties": {"source": {"type": "string"}, '
    f'"position_ned_m": {NUMBERS}, "velocity_ned_m_s": {NUMBERS}, '
    '"sigma_horizontal_m": {"type": "number"}, "sigma_vertical_m": {"type": "number"}}}',
    "range": '{"title": "companion.RangeSample", "description": "Distance to the ground along '
    'the body\'s down axis", "type": "object", "properties": {"distance_m": {"type": "number"}}}',
    "height": '{"title": "companion.HeightSample", "description": "Barometric height above an '
    'arbitrary level, up positive", "type": "object", '
    '"properties": {"height_m": {"type": "number"}}}',
    "armed": '{"title": "companion.ArmedSample", "description": "Whether the motors are armed", '
    '"type": "object", "properties": {"armed": {"type": "boolean"}}}',
}


class Channels:
    """Channels as they are added, with their schemas."""

    def __init__(self) -> None:
        self.schemas: dict[str, str] = {}
        self._data = [b""]

    def schema(self, _name: str, _encoding: str, data: bytes) -> int:
        self._data.append(data)
        return len(self._data) - 1

    def channel(self, topic: str, encoding: str, schema: int) -> int:
        if encoding == "json":
            self.schemas[topic] = self._data[schema].decode()
        return len(self.schemas)


@pytest.mark.parametrize(("sample", "recorded", "line"), WRITTEN)
def test_a_sample_is_written_as_ever_and_read_back(
    sample: Telemetry, recorded: str, line: str, tmp_path: Path
) -> None:
    assert sample_bytes(sample) == recorded.encode()
    back = sample_of(sample_topic(sample), 5, recorded.encode())
    assert type(back) is type(sample) and sample_bytes(back) == recorded.encode()
    table = "".join(telemetry_csv(TelemetryLog("", [sample])))
    assert table == f"unix_ns,kind,values\n{line}\n"
    (tmp_path / "telemetry.csv").write_text(table)
    content = read_telemetry_csv(tmp_path / "telemetry.csv")
    log = content.collected.finish(lambda times, _: times, None)
    assert [sample_bytes(each) for each in log.samples] == [recorded.encode()]


def test_the_schemas_in_a_recording_are_as_ever() -> None:
    channels: Any = Channels()
    open_channels(channels)
    found = {topic: text for topic, text in channels.schemas.items() if "/telemetry/" in topic}
    assert [f"/telemetry/{kind.schema.name}" for kind in TELEMETRY] == list(found)
    assert {name: found[f"/telemetry/{name}"] for name in SCHEMAS} == SCHEMAS


@pytest.mark.parametrize(
    ("topic", "given"),
    [
        ("/telemetry/attitude", {"ned_from_body": [1, 0, 0]}),
        ("/telemetry/attitude", {"ned_from_body": None}),
        ("/telemetry/imu", {"gyro_rad_s": [1, 2, True], "accel_m_s2": [1, 2, 3]}),
        ("/telemetry/imu", {"gyro_rad_s": [1, 2, 3], "accel_m_s2": [1, 2, 3], "less_biases": 1}),
        ("/telemetry/position", {"source": "somewhere", "position_ned_m": [1, 2, 3]}),
        ("/telemetry/armed", {"armed": 1}),
        ("/telemetry/range", {"distance_m": "7.5"}),
        ("/telemetry/height", [1.0]),
    ],
)
def test_what_does_not_fit_the_schema_is_no_sample(topic: str, given: object) -> None:
    with pytest.raises(ValueError, match=r"."):
        sample_of(topic, 5, json.dumps(given).encode())


@pytest.mark.parametrize(
    "line",
    ["5,position,1,2,3,,,,,", "5,range", "5,range,1,2", "5,depth,1", "5,imu,1,2,3,4,5,6,7,8"],
)
def test_what_is_no_line_of_the_table_is_left_out(line: str, tmp_path: Path) -> None:
    (tmp_path / "telemetry.csv").write_text(f"unix_ns,kind,values\n{line}\n")
    assert len(read_telemetry_csv(tmp_path / "telemetry.csv").collected) == 0


def test_a_field_without_a_codec_is_named() -> None:
    @dataclass
    class Wind:
        t_ns: int
        words: list[str]

    with pytest.raises(TypeError, match=r"Wind\.words"):
        fields_of(Wind)
