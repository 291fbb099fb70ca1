"""Sets an origin on an autopilot that has none: without one ArduPilot does not use a pose.

An autopilot that has an origin, from its own GPS or from anybody else, keeps it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import FeedbackConfig
from companion.geometry.geodesy import GeoOrigin
from drivers.mavlink.autopilot_link import AutopilotLink

LOOK_EVERY_S = 0.5
PATIENCE, PATIENCE_SEARCHING = 12, 120
"""Consecutive checks without an origin before one is set, and where its GPS sees satellites: from
a cold start receivers take half a minute to a fix, and an origin cannot be changed afterwards."""
SEARCHING = "the autopilot's GPS sees satellites: the origin is left to it for a minute"
AGAIN_AFTER_S = 10.0
"""Time after which an origin that was not accepted is set again."""
DO_SET_GLOBAL_ORIGIN = 611
NOWHERE_DEG = 1e-7
"""Autopilots take a position of all zeros for none."""


class OriginKeeper:
    """Ensures that the autopilot has an origin; the link itself requests the present one.

    `known` gives the place that it was at before, None where there is none to be believed;
    `believes_gps` whether a GPS of the autopilot may give the origin.
    """

    def __init__(
        self, config: FeedbackConfig, link: AutopilotLink, say: Callable[[str], None],
        is_wanted: Callable[[], bool], known: Callable[[], GeoOrigin | None],
        believes_gps: Callable[[], bool],
    ) -> None:  # fmt: skip
        self._believes_gps = believes_gps
        self._link, self._say, self._is_wanted, self._known = link, say, is_wanted, known
        self._place = GeoOrigin(
            config.origin_latitude_deg, config.origin_longitude_deg, config.origin_altitude_m
        )

    async def run(self) -> None:
        """Check, and set where needed; ends by cancellation."""
        n_without = 0
        while True:
            await asyncio.sleep(LOOK_EVERY_S)
            without = (
                self._is_wanted()
                and self._link.alive
                and self._link.samples.positions.origin is None
            )
            n_without = n_without + 1 if without else 0
            searching = self._link.samples.gps_searches and self._believes_gps()
            if searching and n_without == PATIENCE:
                self._say(SEARCHING)
            if n_without >= (PATIENCE_SEARCHING if searching else PATIENCE):
                await self._set()
                await asyncio.sleep(AGAIN_AFTER_S)

    async def _set(self) -> None:
        """Set it by the command, and by the message that older firmware has."""
        place = self._known() or self._place
        if place.latitude_deg == 0 and place.longitude_deg == 0:
            place = GeoOrigin(NOWHERE_DEG, NOWHERE_DEG, place.altitude_m)
            self._say(
                "feedback.origin_latitude_deg is not set: the autopilot's map has it at 0 N 0 E"
            )
        await self._link.commands.at(DO_SET_GLOBAL_ORIGIN, place)
        vehicle = self._link.vehicle
        self._link.send(
            mavlink.MAVLink_set_gps_global_origin_message(
                vehicle.system_id if vehicle is not None else 0,
                round(place.latitude_deg * 1e7), round(place.longitude_deg * 1e7),
                round(place.altitude_m * 1000),
            )
        )  # fmt: skip
        self._say(
            f"the autopilot had no origin and is given one: {place.latitude_deg:.7f} "
            f"{place.longitude_deg:.7f} at {place.altitude_m:.1f} m"
        )
