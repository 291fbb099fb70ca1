"""Addresses of this machine in its networks."""

from __future__ import annotations

import ipaddress
import socket

import psutil


def own_addresses() -> list[str]:
    """Addresses by which other machines may reach this one, IPv4 first."""
    found = [
        ipaddress.ip_address(each.address.partition("%")[0])
        for addresses in psutil.net_if_addrs().values()
        for each in addresses
        if each.family in (socket.AF_INET, socket.AF_INET6)
    ]
    far = [each for each in found if not (each.is_loopback or each.is_link_local)]
    return [str(each) for each in sorted(far, key=lambda each: (each.version, each.packed))]
