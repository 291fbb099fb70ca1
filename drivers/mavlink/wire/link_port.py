"""Choice of the MAVLink library.

MAVSDK gives out messages as JSON, which has no NaN: integers of PX4's parameters and unknown
covariances would be lost. So it only holds the wire, and everything above is as without it. See
docs/links.md.
"""

from __future__ import annotations

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.link_url import link_endpoint
from drivers.mavlink.wire.message_port import MavlinkPort


def link_port(config: LinkConfig, router: RouterConfig, clock: FlightClock) -> MavlinkPort:
    """Port of `link.url`; ConfigError where invalid. Imports the chosen library only."""
    # the daemon imports this file; a run without a link needs neither library
    from drivers.mavlink.wire.pymavlink_port import PymavlinkPort

    if config.backend == "mavsdk":
        from drivers.mavlink.wire.mavsdk_wire import MavsdkWire

        return PymavlinkPort(config, router, clock, MavsdkWire(link_endpoint(config.url)))
    return PymavlinkPort(config, router, clock)
