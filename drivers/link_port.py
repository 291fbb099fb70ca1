"""Which library speaks to the autopilot."""

from __future__ import annotations

from companion.clock import FlightClock
from companion.config import LinkConfig, RouterConfig
from drivers.mavlink_port import MavlinkPort


def link_port(config: LinkConfig, router: RouterConfig, clock: FlightClock) -> MavlinkPort:
    """The port of `link.url`; ConfigError where that cannot be. Loads the one library only."""
    if config.backend == "mavsdk":
        from drivers.mavsdk_port import MavsdkPort

        return MavsdkPort(config, router, clock)
    from drivers.pymavlink_port import PymavlinkPort

    return PymavlinkPort(config, router, clock)
