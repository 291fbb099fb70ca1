"""Choice of the MAVLink library."""

from __future__ import annotations

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.message_port import MavlinkPort


def link_port(config: LinkConfig, router: RouterConfig, clock: FlightClock) -> MavlinkPort:
    """Port of `link.url`; ConfigError where invalid. Imports the chosen library only."""
    if config.backend == "mavsdk":
        from drivers.mavlink.wire.mavsdk_port import MavsdkPort

        return MavsdkPort(config, router, clock)
    from drivers.mavlink.wire.pymavlink_port import PymavlinkPort

    return PymavlinkPort(config, router, clock)
