"""Stage `viewers`: what can be seen of a flight, served to viewers over links of any width."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from companion.messages import Message
from companion.runtime.stage_protocol import Finish, Listening, SetBudget, Setup
from companion.runtime.stage_work import Work
from companion.streaming.exporter import Exporter, open_listener
from companion.streaming.item_store import ItemStore
from companion.streaming.items import FlightItem, Item
from companion.streaming.parts import parts_of
from companion.streaming.reduced import reduced
from companion.streaming.scene_encoder import SceneEncoder
from companion.timing.clock import monotonic_s, wait_s

OWN = "127.0.0.1:0"
"""Address for viewers of this machine, on a port of their own."""
PATH_STEP_NS = 200_000_000
BIND_AGAIN_S, HELD_BY_OURS = 1.0, 4
"""Interval of attempts to have the port, and how many fail before that is told: the flight before
may still have it while it gives its last results."""
DRAIN_S, DRAIN_TICK_S = 2.5, 0.02


class _Viewers(Work):
    outlives_daemon = True

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        stream, camera = setup.config.stream, setup.camera
        self._width = min(setup.config.viewer.image_width, camera.width)
        self._exporter = Exporter(
            ItemStore(stream.store_mb << 20), stream.most_viewers, stream.budget_kbit_s
        )
        own = open_listener(OWN)
        self._port = own.getsockname()[1]
        self._exporter.listen(own)
        self._closed = ""
        """Reason why nobody can connect from elsewhere; "" where they can."""
        name = setup.folder.name if setup.folder is not None else ""
        flight = FlightItem(name or os.urandom(8).hex(), name, camera.pinhole(), setup.origin)
        self._encoder = SceneEncoder(flight, PATH_STEP_NS)
        self._give([flight])
        self._over = threading.Event()
        self._server = threading.Thread(target=self._exporter.run, name="exporter", daemon=True)
        self._server.start()
        if stream.listen:
            threading.Thread(
                target=self._listen, args=(stream.listen,), name="listening", daemon=True
            ).start()

    def details(self) -> Mapping[str, Any]:
        return {**self._exporter.report(), "closed": self._closed}

    def begin(self, tell: Callable[[Any], None]) -> None:
        """Tell where viewers of this machine find it."""
        tell(Listening(self._port))

    def step(self, message: Any) -> Iterable[Message]:
        if isinstance(message, SetBudget):
            self._exporter.set_budget(message.kbit_s)
            return []
        self._give(self._encoder.take(reduced(message, self._width)))
        return []

    def finish(self, finish: Finish) -> Iterable[Message]:
        """Give viewers a moment to receive the rest."""
        self._give(self._encoder.close())
        until_s = monotonic_s() + (0.0 if finish.hurry else DRAIN_S)
        while not self._exporter.is_drained(finish.n_viewers) and monotonic_s() < until_s:
            wait_s(self._over, DRAIN_TICK_S)
        self._over.set()
        self._exporter.stop()
        self._server.join()
        return []

    def _give(self, items: list[Item]) -> None:
        for item in items:
            self._exporter.take(item, parts_of(item))

    def _listen(self, address: str) -> None:
        """Listen when the port is free: the flight before may still have it."""
        n_failed = 0
        while not self._over.is_set():
            try:
                self._exporter.listen(open_listener(address))
            except (OSError, ValueError, OverflowError) as error:
                n_failed += 1
                if n_failed > HELD_BY_OURS or not isinstance(error, OSError):
                    self._closed = f"{address}: {getattr(error, 'strerror', None) or error}"
                wait_s(self._over, BIND_AGAIN_S)
            else:
                self._closed = ""
                return


work = _Viewers
"""The stage for a setup."""
