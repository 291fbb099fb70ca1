"""Telemetry of the autopilot, and of sensors beside it: one message for each kind of sample.

From its schema follow codec, recording topic, table and curve. See `messages` for time and arrays.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar, get_args

from companion.config import MEASUREMENTS, Measurement
from companion.geometry.transforms import Array
from companion.sample_schema import QUATERNION, VECTOR, WHERE_TRUE, Schema, fields_of


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeSample:
    """Attitude of the autopilot: quaternion w x y z, body rates (3,) or None."""

    schema: ClassVar[Schema] = Schema(
        "attitude", "Attitude of the body (FRD) in NED: quaternion w x y z; body rates, rad/s"
    )
    t_ns: int
    ned_from_body: Array = field(metadata=QUATERNION)
    rates_body_rad_s: Array | None = field(default=None, metadata=VECTOR)


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """Angular rate and specific force in the body frame, (3,) each.

    `less_biases` marks samples from which the autopilot has taken the biases that its EKF
    estimates: they change, together with its attitude, whenever the EKF learns better.
    """

    schema: ClassVar[Schema] = Schema(
        "imu", "Angular rate and specific force in the body frame (FRD)"
    )
    t_ns: int
    gyro_rad_s: Array = field(metadata=VECTOR)
    accel_m_s2: Array = field(metadata=VECTOR)
    less_biases: bool = field(default=False, metadata=WHERE_TRUE)


class PositionSource(Enum):
    """Source of a position; earlier ones are preferred."""

    LOCAL = "local position"
    GLOBAL = "global position"
    GPS = "GPS"


@dataclass(frozen=True, slots=True, eq=False)
class PositionSample:
    """Position (3,) of the body in local NED, velocity (3,) where the autopilot gives it.

    All samples of a source share one origin, the reader's `GeoOrigin` where that is known.
    """

    schema: ClassVar[Schema] = Schema("position", "Position and velocity of the body in local NED")
    t_ns: int
    source: PositionSource
    position_ned_m: Array = field(metadata=VECTOR)
    velocity_ned_m_s: Array | None = field(default=None, metadata=VECTOR)
    sigma_horizontal_m: float | None = None
    sigma_vertical_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RangeSample:
    """Distance along the body's down axis to the ground, by rangefinder."""

    schema: ClassVar[Schema] = Schema("range", "Distance to the ground along the body's down axis")
    t_ns: int
    distance_m: float


@dataclass(frozen=True, slots=True, eq=False)
class HeightSample:
    """Barometric height above an arbitrary, constant level; up is positive."""

    schema: ClassVar[Schema] = Schema(
        "height", "Barometric height above an arbitrary level, up positive"
    )
    t_ns: int
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmedSample:
    """State of the motors: True in `armed` while they may turn."""

    schema: ClassVar[Schema] = Schema("armed", "Whether the motors are armed")
    t_ns: int
    armed: bool


@dataclass(frozen=True, slots=True, eq=False)
class LandedSample:
    """State of the autopilot's landing detector: True in `landed` while it stands on the ground."""

    schema: ClassVar[Schema] = Schema(
        "landed", "Whether the autopilot's landing detector says that it stands on the ground"
    )
    t_ns: int
    landed: bool


@dataclass(frozen=True, slots=True, eq=False)
class AirspeedSample:
    """Indicated airspeed: by a pitot tube, for air as dense as at sea level, not calibrated."""

    schema: ClassVar[Schema] = Schema(
        "airspeed", "Airspeed indicated by a pitot tube, not calibrated", "m/s indicated airspeed"
    )
    t_ns: int
    indicated_m_s: float


@dataclass(frozen=True, slots=True, eq=False)
class GimbalSample:
    """Attitude of a gimbal's head (forward, right, down): quaternion w x y z.

    In NED with `yaw_from_north`; else in level axes of which the first points where the vehicle
    heads.
    """

    schema: ClassVar[Schema] = Schema(
        "gimbal",
        "Attitude of the gimbal's head (FRD): quaternion w x y z; its yaw is from north, or from "
        "where the vehicle heads",
    )
    t_ns: int
    level_from_head: Array = field(metadata=QUATERNION)
    yaw_from_north: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class DepthSample:
    """Depth along the camera's axis of what one pixel sees in the image of the same `t_ns`.

    By a second camera or a depth camera; the pixel is of the image as it came, with its distortion.
    """

    schema: ClassVar[Schema] = Schema(
        "depth", "Depth along the camera's axis of what a pixel sees in the image of that time"
    )
    t_ns: int
    u_px: float
    v_px: float
    depth_m: float
    sigma_m: float
    """Standard deviation of this one depth; errors of the calibration are in all alike."""


Telemetry = (
    AttitudeSample | ImuSample | PositionSample | RangeSample | HeightSample | ArmedSample
    | AirspeedSample | LandedSample | GimbalSample | DepthSample
)  # fmt: skip
TELEMETRY: tuple[type[Telemetry], ...] = get_args(Telemetry)
"""In order of their channels in a recording."""
FIELDS = {kind: fields_of(kind) for kind in TELEMETRY}
"""Fields of each, without its time."""
MEASURED: Mapping[type[Telemetry] | PositionSource, Measurement | None] = {
    AttitudeSample: "attitude", ImuSample: "imu", RangeSample: "range", HeightSample: "height",
    AirspeedSample: "airspeed", ArmedSample: None, LandedSample: None, GimbalSample: "attitude",
    DepthSample: "depth",
    PositionSource.LOCAL: "position", PositionSource.GLOBAL: "position",
    PositionSource.GPS: "satellites",
}  # fmt: skip
"""Measurement of each kind of sample, and of each source of positions; None of a state."""


def is_believed(sample: Telemetry, use: Collection[Measurement]) -> bool:
    """True if a sample may decide about the pose: what it measures is in use, or it is a state."""
    measured = MEASURED[sample.source if isinstance(sample, PositionSample) else type(sample)]
    return measured is None or measured in use


def belief_in_words(use: Collection[Measurement]) -> str:
    """Telemetry that is believed, and what follows for poses sent; "" where it is everything."""
    if set(use) == set(MEASUREMENTS):
        return ""
    named = ", ".join(each for each in MEASUREMENTS if each in use)
    believed = f"only {named}" if named else "nothing"
    said = f"of the autopilot's telemetry {believed} is believed (telemetry.use)"
    return said if "attitude" in use else f"{said}: without attitude no pose is sent"
