"""MAVLink over a wire that MAVSDK holds; everything above the wire is as without it."""

from __future__ import annotations

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.link_url import link_endpoint
from drivers.mavlink.wire.mavsdk_wire import MavsdkWire
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort


class MavsdkPort(PymavlinkPort):
    """Link to the autopilot through MAVSDK: the same messages, router and signing.

    MAVSDK gives out messages as JSON, which has no NaN: integers of PX4's parameters and unknown
    covariances would be lost. So raw packets are used. See docs/links.md.
    """

    def __init__(self, config: LinkConfig, router: RouterConfig, clock: FlightClock) -> None:
        super().__init__(config, router, clock, MavsdkWire(link_endpoint(config.url)))
