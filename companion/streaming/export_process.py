"""Process of an exporter: messages come in on its standard input, and go to viewers by TCP.

The first message is an ExportSetup. It reports in lines of JSON where it listens, and each second
its health. When its input ends it gives viewers a moment to receive the rest.
"""

from __future__ import annotations

import json
import os
import pickle
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from companion.config import StreamConfig
from companion.streaming.exporter import Exporter, open_listener
from companion.streaming.item_store import ItemStore
from companion.streaming.items import FlightItem, Item
from companion.streaming.parts import parts_of
from companion.streaming.scene_encoder import SceneEncoder
from companion.timing.clock import monotonic_s, wait_s

OWN = "127.0.0.1:0"
"""Address for viewers of this machine, on a port of their own."""
PATH_STEP_NS = 200_000_000
REPORT_EVERY_S = 1.0
BIND_AGAIN_S = 1.0
DRAIN_S = 2.5
NICE = 10
"""The pose has priority."""


@dataclass(frozen=True, slots=True)
class ExportSetup:
    """Setup of the process. `listen` is "" where only viewers of this machine are wanted."""

    flight: FlightItem
    stream: StreamConfig
    listen: str
    n_own: int = 0
    """Viewers of this machine that are expected."""


@dataclass(frozen=True, slots=True)
class SetBudget:
    """Limit the rate of all viewers together; 0 for no limit."""

    kbit_s: float


def main() -> int:
    """Export one flight; the exit status."""
    # No session of its own, between which the scheduler would share before it looks at priorities.
    os.setpgid(0, 0)
    os.nice(NICE)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # whoever started it says when to end
    try:
        setup: ExportSetup = pickle.load(sys.stdin.buffer)
    except EOFError:
        return 0
    config = setup.stream
    exporter = Exporter(ItemStore(config.store_mb << 20), config.most_viewers, config.budget_kbit_s)
    own = open_listener(OWN)
    exporter.listen(own)
    _say({"own": own.getsockname()[1]})
    ended, finished = threading.Event(), threading.Event()
    threading.Thread(
        target=_take_in, args=(exporter, setup.flight, ended), name="messages", daemon=True
    ).start()
    threading.Thread(
        target=_report, args=(exporter, setup.listen, finished), name="report", daemon=True
    ).start()

    def end() -> None:
        ended.wait()
        until_s = monotonic_s() + DRAIN_S
        while not exporter.is_drained(setup.n_own) and monotonic_s() < until_s:
            wait_s(threading.Event(), 0.02)
        finished.set()
        exporter.stop()

    threading.Thread(target=end, name="end", daemon=True).start()
    exporter.run()
    return 0


def _take_in(exporter: Exporter, flight: FlightItem, ended: threading.Event) -> None:
    encoder = SceneEncoder(flight, PATH_STEP_NS)
    try:
        _give(exporter, [flight])
        while True:
            message = pickle.load(sys.stdin.buffer)
            if isinstance(message, SetBudget):
                exporter.set_budget(message.kbit_s)
            else:
                _give(exporter, encoder.take(message))
    except (EOFError, OSError):  # the flight is over
        _give(exporter, encoder.close())
    finally:
        ended.set()


def _give(exporter: Exporter, items: list[Item]) -> None:
    for item in items:
        exporter.take(item, parts_of(item))


def _report(exporter: Exporter, listen: str, ended: threading.Event) -> None:
    """Listen when the port is free (the flight before may still have it), and report health."""
    is_open = not listen
    while not ended.is_set():
        said: dict[str, Any] = {}
        if not is_open:
            try:
                exporter.listen(open_listener(listen))
                is_open = True
            except (OSError, ValueError, OverflowError) as error:
                said["closed"] = f"{listen}: {getattr(error, 'strerror', None) or error}"
        _say({**said, "report": exporter.report()})
        wait_s(ended, REPORT_EVERY_S if is_open else BIND_AGAIN_S)


def _say(document: Mapping[str, Any]) -> None:
    try:
        print(json.dumps(document), flush=True)
    except OSError:
        os._exit(0)  # whoever started it is gone


if __name__ == "__main__":
    status = main()
    os._exit(status)  # threads that still read do not keep it
