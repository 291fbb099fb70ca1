"""`companion page`: address of the drone's page, and the codes that pair a device with it."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import TextIO

from companion.config import Config
from companion.errors import SourceError
from companion.page.codes import new_codes, read_codes, shown, write_codes
from drivers.system.own_addresses import own_addresses
from drivers.system.status_socket import ask_status, found_socket_path

EVERY = ("0.0.0.0", "::")


def show_page(config: Config, out: TextIO, renew: bool) -> None:
    """Print where the page is, and its codes; SourceError without a daemon, or without a page.

    With `renew` other codes are drawn first: all sessions end.
    """
    status = ask_status(found_socket_path(config.daemon.socket))
    listen = str(status.get("page") or "")
    if not listen:
        raise SourceError("the daemon serves no page: page.listen is empty")
    flights = Path(status["flights"])
    if renew:
        try:
            write_codes(flights, new_codes())
        except OSError as error:
            raise SourceError(f"{flights}: {error.strerror}") from error
    codes = read_codes(flights)
    if codes is None:
        raise SourceError("the page is being started; ask again")
    for address in _addresses(listen):
        print(f"http://{address}", file=out)
    print(f"code to look on:        {shown(codes.look)}", file=out)
    print(f"code to change things:  {shown(codes.change)}", file=out)


def _addresses(listen: str) -> list[str]:
    host, _, port = listen.rpartition(":")
    if host.strip("[]") not in EVERY:
        return [listen]
    found = [f"[{each}]" if ":" in each else each for each in own_addresses()]
    return [f"{each}:{port}" for each in [f"{socket.gethostname()}.local", *found]]
