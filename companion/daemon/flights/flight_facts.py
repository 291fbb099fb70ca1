"""Facts of a live flight for its report, beside its messages."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from companion.config import Config
from companion.config.passwords import command_shown
from companion.config_file import shown
from companion.daemon.flights.live_flight import LiveFlight
from companion.geometry.geodesy import GeoOrigin
from companion.messages import ClockReport
from companion.messages.run_facts import RunFacts
from companion.products.versions import versions
from companion.runtime.peak_memory import peak_memory_mb


def facts_of(
    flight: LiveFlight, config: Config, clock: ClockReport | None, origin: GeoOrigin | None,
    rates_hz: Mapping[str, float],
) -> RunFacts:  # fmt: skip
    """Facts of a flight whose stages have given their last results."""
    times: dict[str, Mapping[str, float]] = {}
    device = "none"
    for stage in flight.stages.values():
        said = stage.progress
        if said is not None:
            times.update(said.times)
            device = said.device or device
    return RunFacts(
        stage_times=times,
        wall_s=flight.duration_s,
        clock=clock,
        origin=origin if flight.has_origin else None,
        device=device,
        config=shown(config),
        versions=versions(),
        command=command_shown(sys.argv),
        peak_memory_mb=peak_memory_mb(),
        camera=flight.camera,
        n_frames_total=flight.n_frames,
        completed=True,
        dropped=flight.dropped(),
        rates_hz=dict(rates_hz),
        believed=flight.believed,
    )
