"""Depth node on another machine: fetches keyframe bundles from a drone, makes depth and cloud.

It asks for one bundle after the other, as fast as it can process them. After any failure of the
link, of the drone or of itself it continues after the last bundle that counted.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path

from companion.compute.compute_devices import choose_devices
from companion.config import Config
from companion.daemon.nodes.remote_flight import RemoteFlight
from companion.errors import StreamError
from companion.geometry.camera import Camera
from companion.timing.clock import monotonic_s, wait_s
from companion.topics.camera_fields import camera_of
from companion.topics.envelope import Envelope, unpack
from companion.topics.keyframe_bundle import Bundle, bundle_of
from drivers.system.journal import WARNING, Journal
from drivers.system.zenoh_bus import LAST, ZenohBus

ASK_S = 10.0
"""Timeout of an answer over a thin link."""
AGAIN_S, NOBODY_S = 0.15, 0.5
"""Pause before the next query: where there is nothing new, and where nobody answers."""
MOST_IN_A_ROW = 10
"""Malformed answers before the bundle is skipped."""
SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,79}")


def run_depth_node(config: Config, is_stopped: Callable[[], bool]) -> int:
    """Work until stopped; the exit status. InputError where it cannot begin."""
    node = DepthNode(config, is_stopped)
    try:
        node.run()
    finally:
        node.close()
    return 0


class DepthNode:
    """Fetches bundles and runs the depth stage on them."""

    def __init__(self, config: Config, is_stopped: Callable[[], bool]) -> None:
        self._config, self._is_stopped = config, is_stopped
        self._journal = Journal()
        choose_devices(config.opencl, self._journal.say)  # an error now, not with a flight
        self._bus = ZenohBus(config.distributed)
        for topic in ("depth", "cloud"):
            self._bus.declare_publisher(topic, LAST)
        self._flight: RemoteFlight | None = None
        self._run = ""
        self._after = -1
        self._needs_whole = True
        self._is_heard = False
        self._over = ""
        """Flight that has ended."""
        self._n_malformed = self._n_in_a_row = 0
        self._warned_s = monotonic_s()
        self._never = threading.Event()
        where = ", ".join(config.distributed.connect) or "who joins"
        self._journal.say(f"depth and cloud of {config.distributed.vehicle} at {where}")

    def run(self) -> None:
        """Fetch and process until stopped."""
        while not self._is_stopped():
            if self._flight is None:
                worked = self._look()
            else:
                self._flight.step()
                worked = self._fetch(self._flight)
            if not worked:
                wait_s(self._never, AGAIN_S if self._is_heard else NOBODY_S)
            self._tell()
        self._journal.say("stopping")

    def close(self) -> None:
        """Write the results so far, and disconnect."""
        self._end_flight(hurry=True)
        self._bus.close()

    def _look(self) -> bool:
        """Find the current flight; whether there is one to work on."""
        answer = self._bus.ask("flight", b"", ASK_S)
        self._heard(answer is not None)
        if answer is None:
            return False
        try:
            about = unpack(answer)
            flight, run = about.text("flight"), about.text("run")
            camera = camera_of(about.part("camera"))
            if about.kind != "flight" or not SAFE_NAME.fullmatch(flight):
                raise StreamError("flight: it has no name that a folder can have")
        except StreamError as error:
            self._malformed(error)
            return False
        if flight == self._over and run == self._run:
            self._is_heard = False  # nothing to do for a while
            return False
        self._begin(flight, run, camera)
        return True

    def _begin(self, flight: str, run: str, camera: Camera) -> None:
        if self._flight is not None and self._flight.flight != flight:
            self._end_flight(hurry=False)
        if self._flight is None:
            vehicle = self._config.distributed.vehicle
            folder = Path(self._config.daemon.flights) / f"{vehicle}-{flight}"
            self._flight = RemoteFlight(
                self._config, flight, camera, folder, self._publish, self._journal
            )
            before = len(self._flight.kept.found)
            more = f", going on with {before} keyframes" if before else ""
            self._journal.say(f"flight {flight}: its results go to {folder}{more}")
        self._run, self._needs_whole = run, True
        self._after = self._flight.kept.resume_after(run)

    def _fetch(self, flight: RemoteFlight) -> bool:
        """Ask for the next bundle and process it; whether there was one."""
        wanted = {"run": self._run, "after": self._after, "whole": self._needs_whole}
        answer = self._bus.ask("depth_input", Envelope("wanted", wanted, {}).pack(), ASK_S)
        self._heard(answer is not None)
        if answer is None:
            return False
        try:
            envelope = unpack(answer)
            if envelope.text("run") != self._run:
                return self._look()  # the drone, or its flight, has begun anew
            if envelope.kind == "wait":
                return False
            bundle = bundle_of(envelope)
        except StreamError as error:
            self._malformed(error)
            self._n_in_a_row += 1
            if self._n_in_a_row >= MOST_IN_A_ROW:  # it is not the link: go on without it
                self._after, self._n_in_a_row = self._after + 1, 0
            return False
        self._n_in_a_row = 0
        self._work(flight, bundle)
        return True

    def _work(self, flight: RemoteFlight, bundle: Bundle) -> None:
        whole = bundle.change is not None and bundle.change.whole
        if whole and self._after < bundle.number and self._after >= 0:
            flight.n_missed += bundle.number - self._after
        self._needs_whole = self._needs_whole and not whole
        self._after = bundle.number
        try:
            flight.take(bundle)
        except StreamError as error:
            self._malformed(error)
        if bundle.over:
            self._over = flight.flight
            self._end_flight(hurry=False)

    def _end_flight(self, hurry: bool) -> None:
        flight, self._flight = self._flight, None
        if flight is not None:
            flight.close(hurry)
            self._journal.say(
                f"flight over: {flight.folder} ({flight.n_depth_maps} depth maps here, "
                f"{flight.n_points} points, {flight.n_missed} bundles missed)"
            )

    def _publish(self, topic: str, envelope: Callable[[], Envelope]) -> None:
        if self._bus.has_subscribers(topic):
            self._bus.publish(topic, envelope().pack())

    def _heard(self, is_heard: bool) -> None:
        if is_heard != self._is_heard and self._flight is not None:
            text = "the drone answers again" if is_heard else "the drone does not answer"
            self._journal.say(text, WARNING)
        self._is_heard = is_heard

    def _malformed(self, error: StreamError) -> None:
        self._n_malformed += 1
        if self._n_malformed & (self._n_malformed - 1) == 0:  # only some of many are reported
            self._journal.say(f"warning: malformed, {self._n_malformed} so far: {error}", WARNING)

    def _tell(self) -> None:
        now_s = monotonic_s()
        if now_s - self._warned_s < self._config.daemon.status_every_s:
            return
        self._warned_s = now_s
        if self._flight is None:
            self._journal.say("waiting for a flight")
            return
        self._journal.say(
            f"{self._flight.n_depth_maps} depth maps, {self._flight.n_points} points, "
            f"{self._after + 1} bundles, {self._flight.n_missed} missed"
        )
