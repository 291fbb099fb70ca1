"""Status document of the daemon: its health, and what else the page shows."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from companion.daemon.control.settings_in_force import SettingsInForce
from companion.daemon.flight_starts import FlightStarts
from companion.daemon.flights.flights import Flights
from companion.daemon.health_watch import HealthWatch
from companion.daemon.setup_proof import SetupProof
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.system.journal import Journal

MOST_WARNINGS = 20
"""Kinds of warnings, the newest."""


class StatusDocument:
    """Answer to `companion status`; to be called in the event loop."""

    def __init__(
        self, watch: HealthWatch, settings: SettingsInForce, flights: Flights,
        starts: FlightStarts, proof: SetupProof, link: AutopilotLink | None, journal: Journal,
        clock: FlightClock,
    ) -> None:  # fmt: skip
        self._watch, self._settings, self._flights = watch, settings, flights
        self._starts, self._proof, self._link = starts, proof, link
        self._journal, self._clock = journal, clock

    def __call__(self) -> dict[str, Any]:
        """The document now."""
        flight, config = self._flights.current, self._settings.config
        camera, origin = self._starts.camera, self._link.origin if self._link is not None else None
        return {
            **self._watch.document(),
            "profile": config.computer.profile,
            "armed": self._settings.armed,
            "page": config.page.listen,
            "kept": flight is not None and flight.kept,
            "recording": str(flight.folder.resolve()) if flight and flight.folder else "",
            "flights": str(Path(config.daemon.flights).resolve()),
            "viewers_port": flight.viewing.port if flight and flight.viewing else 0,
            "mount_known": camera is not None and camera.body_from_camera is not None,
            "unproven": self._proof.missing,
            "size": [camera.width, camera.height] if camera is not None else None,
            "origin": asdict(origin) if origin is not None else None,
            "warnings": self._warnings(),
        }

    def _warnings(self) -> list[dict[str, Any]]:
        """Newest warning of each kind, the newest first."""
        now_ns = self._clock.now_ns()
        newest = list(self._journal.newest.values())[: -MOST_WARNINGS - 1 : -1]
        return [
            {
                "what": each.what, "detail": each.detail, "good": each.good,
                "age_s": round((now_ns - each.t_ns) * 1e-9, 1),
            }
            for each in newest
        ]  # fmt: skip
