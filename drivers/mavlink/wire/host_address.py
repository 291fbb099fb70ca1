"""Host name resolution that blocks neither the event loop nor the program's end."""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import threading

from companion.errors import SourceError

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
    loop = asyncio.get_running_loop()
    answer: asyncio.Future[Address | str] = loop.create_future()

    def settle(found: Address | str) -> None:
        if not answer.done():
            answer.set_result(found)

    def look_up() -> None:
        found: Address | str
        try:
            places = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            family, *_, address = min(places, key=lambda place: place[0] != socket.AF_INET)
            found = family, (str(address[0]), int(address[1]))
        except OSError as error:
            found = error.strerror or str(error)
        try:
            loop.call_soon_threadsafe(settle, found)
        except RuntimeError:
            pass  # the loop has ended meanwhile: nobody asks any more

    threading.Thread(target=look_up, name="resolver", daemon=True).start()
    # not wait_for: up to Python 3.11 it swallows a cancellation that comes with the answer
    await asyncio.wait({answer}, timeout=RESOLVE_S)
    found = answer.result() if answer.done() else "no answer from the name server"
    if isinstance(found, str):
        raise SourceError(f"{host}: the name cannot be resolved: {found}")
    return found
