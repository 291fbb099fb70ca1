"""Process of the viewer on the machine of the flight: WHERE PORT COLOURS BIND."""

from __future__ import annotations

import os
import signal
import sys
import threading

from companion.errors import InputError
from companion.streaming.ground_link import GroundLink
from companion.streaming.onboard_viewer import READY
from companion.streaming.viewer.colours import Colours
from companion.streaming.viewer.ground_viewer import show
from companion.streaming.viewer.screen import Screen
from companion.streaming.viewer.web_proxy import LOOPBACK

NICE = 10


def main() -> int:
    """Show one flight, until its exporter ends; the exit status."""
    os.setpgid(0, 0)  # it is ended with what it starts
    os.nice(NICE)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    where, port, colours, bind = sys.argv[1], int(sys.argv[2]), Colours(sys.argv[3]), sys.argv[4]
    try:
        screen = Screen(where, bind)
    except InputError as error:
        _say(str(error).encode() + b"\n")
        return 1
    try:
        _say(READY + b" " + screen.page.encode() + b"\n")
        link = GroundLink(LOOPBACK, port, lambda text: None, again=False)
        show(link, screen, colours, threading.Event())
    except BrokenPipeError:
        return 1  # who asked for it has ended while it started
    finally:
        screen.close()
    return 0


def _say(line: bytes) -> None:
    sys.stdout.buffer.write(line)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    # not by the interpreter's end, where the library would wait for a peer that hangs
    os._exit(main())
