"""`companion view`: viewer at the ground station, in a window or a browser."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable

from companion.errors import InputError, StreamError
from companion.streaming.ground_link import GroundLink, host_and_port
from companion.streaming.viewer import Colours, Screen, show
from companion.timing.clock import monotonic_s, wait_s

LOOK_S = 0.2
END_S = 1.0


def view(host: str, where: str, bind: str, colours: str, notify: Callable[[str], None]) -> int:
    """View the companion at `host` until Ctrl-C or until its window is closed.

    Returns the exit status: 2 where its window has ended by a fault, as without a display.
    InputError where nothing can be shown here.
    """
    try:
        link = GroundLink(*host_and_port(host), notify)
    except StreamError as error:
        raise InputError(str(error)) from error
    screen = Screen(where, bind)
    if screen.page:
        notify(f"open {screen.page}")
    stop = threading.Event()
    faults: list[BaseException] = []

    def work() -> None:
        try:
            show(link, screen, Colours(colours), stop)
        except BaseException as fault:
            faults.append(fault)

    worker = threading.Thread(target=work, name="view", daemon=True)
    worker.start()
    try:
        never = threading.Event()
        while worker.is_alive() and not screen.is_gone:
            wait_s(never, LOOK_S)
    finally:
        stop.set()
        until_s = monotonic_s() + END_S
        while worker.is_alive() and monotonic_s() < until_s:
            worker.join(LOOK_S)
        fault = screen.fault
        screen.close()
        hangs = worker.is_alive()
    if fault:
        notify(fault)
    elif faults:
        raise faults[0]
    status = 2 if fault else 0
    if hangs:  # in a call into a viewer that is gone, for which the interpreter would wait
        sys.stderr.flush()
        os._exit(status)
    return status
