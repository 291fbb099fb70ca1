"""Marks and words of settings."""

from __future__ import annotations

from typing import Annotated, Literal, TypeVar, get_args

T = TypeVar("T")
EXPERT = "expert"
Expert = Annotated[T, EXPERT]
"""A key that few drones need: its default was found by tests, or fits nearly all."""
ADDRESS = "HOST:PORT"
Address = Annotated[str, ADDRESS]
"""Address at which something listens; "" for none."""
Measurement = Literal[
    "attitude", "imu", "position", "satellites", "range", "height", "airspeed", "depth"
]
"""A kind of measurement, as `telemetry.use` names it."""
MEASUREMENTS: tuple[Measurement, ...] = get_args(Measurement)
