"""The report as one page that needs no other file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from companion.output.flight_result import Cloud, FlightResult, RunFacts, WorldPose


def report_page(
    result: FlightResult,
    facts: RunFacts,
    poses: Sequence[WorldPose],
    cloud: Cloud,
    numbers: dict[str, Any],
) -> bytes:
    """HTML with all styles and pictures in it."""
    return b"<!doctype html><title>Flight</title>"
