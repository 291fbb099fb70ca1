"""Limit of requests that ground stations may make."""

from __future__ import annotations

from companion.timing.rate_limit import PeerLimit

EACH_HZ, EACH_BURST = 40.0, 120.0
ALL_HZ, ALL_BURST = 160.0, 300.0
MOST_ASKERS = 32


def request_limit() -> PeerLimit:
    """A limit per sender, and for all senders together."""
    return PeerLimit((EACH_HZ, EACH_BURST), (ALL_HZ, ALL_BURST), MOST_ASKERS)
