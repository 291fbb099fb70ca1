"""Host name resolution that blocks neither the event loop nor the program's end."""

from __future__ import annotations

import asyncio
import ipaddress
import socket

from companion.errors import SourceError
from drivers.mavlink.wire.thread_call import in_thread

RESOLVE_S = 5.0
Address = tuple[socket.AddressFamily, tuple[str, int]]


async def resolve(host: str, port: int) -> Address:
    """Family and address of a host, IPv4 first; SourceError if it has none."""
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        return await _ask(host, port)
    return (socket.AF_INET if number.version == 4 else socket.AF_INET6), (host, port)


async def _ask(host: str, port: int) -> Address:
    def look_up() -> Address | str:
        try:
            places = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except (OSError, UnicodeError) as error:
            return getattr(error, "strerror", None) or str(error)
        family, *_, address = min(places, key=lambda place: place[0] != socket.AF_INET)
        return family, (str(address[0]), int(address[1]))

    answer = in_thread(look_up, "resolver")
    # not wait_for: up to Python 3.11 it swallows a cancellation that comes with the answer
    await asyncio.wait({answer}, timeout=RESOLVE_S)
    found = answer.result() if answer.done() else "no answer from the name server"
    if isinstance(found, str):
        raise SourceError(f"{host}: the name cannot be resolved: {found}")
    return found
