"""Replay of a flight in its own time, with the processes of a live flight and its drops."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from companion.app.progress import Progress
from companion.app.replay.replay_command import RecordedInput, Watched
from companion.config import Config
from companion.daemon.flights.flight_facts import facts_of
from companion.daemon.flights.live_flight import Given, Listener, LiveFlight
from companion.errors import StageError
from companion.messages import Frame, FrameOverdue, Georeferenced, Odometry, Warned
from companion.messages.run_facts import RunFacts
from companion.runtime.fork_server import ForkServer
from companion.runtime.stages import START_S
from companion.telemetry import Telemetry
from companion.timing.clock import FlightClock, monotonic_s, wait_s

TICK_S = 0.05


def replay_paced(
    given: RecordedInput, out: Path, config: Config, viewer: str, progress: Progress,
    notify: Callable[[str], None],
) -> None:  # fmt: skip
    """Replay a flight into the folder `out`; InputError when it cannot begin, or gives no map.

    `notify` takes remarks. StageError where localisation ends on the way.
    """
    live = replace(
        config, recorder=replace(config.recorder, enabled=False),
        stream=replace(config.stream, listen=""), daemon=replace(config.daemon, viewer=viewer),
    )  # fmt: skip
    watched = Watched()
    over = threading.Event()
    faults: list[str] = []

    def unusable(why: str) -> None:
        faults.append(why)
        over.set()

    def warned(warning: Warned) -> None:
        notify(f"{warning.what}: {warning.detail}" if warning.detail else warning.what)
        flight.take(warning)

    def given_out(message: Given) -> None:
        if isinstance(message, Odometry):
            watched.see(message.state)
        elif isinstance(message, Georeferenced):
            watched.take(message)

    server = ForkServer()
    flight = LiveFlight(
        live, given.flight.camera, FlightClock(),
        lambda _: Listener(
            given_out, warned, lambda: unusable("localisation has died"), unusable,
            mapped=watched.take,
        ),
        server.start,
    )  # fmt: skip

    def facts(flown: LiveFlight) -> RunFacts:
        origin = given.log.origin if flown.has_origin else None
        found = facts_of(flown, config, given.log.clock, origin, given.log.rates_hz)
        return replace(found, n_frames_total=given.n_frames, completed=completed)

    completed = False
    try:
        _wait(flight, over)
        flight.begin(out)
        if given.log.origin is not None:
            flight.set_origin(given.log.origin)
        _wait(flight, over)
        progress.start(given.n_frames)
        _play(
            flight, given, over, lambda n: progress.update(n, watched.state.value, watched.n_points)
        )
        completed = not over.is_set()
    finally:
        progress.finish()
        flight.finish(facts)
        server.close()
    if faults:
        raise StageError(f"{faults[0]}; results so far are in {out}")
    watched.check(out)


def _wait(flight: LiveFlight, over: threading.Event) -> None:
    """Wait until all stages take frames."""
    until_s = monotonic_s() + START_S
    while not flight.stages_up and not over.is_set() and monotonic_s() < until_s:
        wait_s(over, TICK_S)


def _play(
    flight: LiveFlight, given: RecordedInput, over: threading.Event, update: Callable[[int], None]
) -> None:
    start_s, first_ns, n_done = monotonic_s(), None, 0
    for message in given.messages():
        if first_ns is None and isinstance(message, Frame):
            start_s, first_ns = monotonic_s(), message.t_ns
        if first_ns is not None:
            wait_s(over, start_s + (message.t_ns - first_ns) * 1e-9 - monotonic_s())
        if over.is_set():
            return
        if isinstance(message, Frame):
            flight.frame(message)
            n_done += 1
            update(n_done)
        elif isinstance(message, Warned | Telemetry | FrameOverdue):
            flight.take(message)
