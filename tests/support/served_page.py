"""The page's application in front of a status socket that tells what a test says.

    with ServedPage(tmp_path) as served:
        served.status["armed"] = True
        answer = served.ask("GET", "/")                       # through the application
        answer = served.ask("GET", "/", peer="192.168.1.20")  # as from another machine
        ... served.port                                       # the same behind its server

Both run in an event loop of their own; the daemon is left out, its status socket is the real one.
"""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Coroutine, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import urlencode

from companion.config_file import load_config, to_toml
from companion.page.application import application
from companion.page.bounded_server import bounded_server
from companion.page.codes import Codes, read_codes
from companion.page.daemon_watch import DaemonWatch
from companion.page.facts import Facts
from companion.page.scene import Scene
from companion.timing.clock import monotonic_s
from drivers.system.status_socket import StatusSocket

HERE, ELSEWHERE = "127.0.0.1", "192.168.1.20"
WELL = {
    "armed": False, "tracker": "tracking", "quality": 90, "scale": "GPS", "size": [640, 480],
    "mount_known": True, "warnings": [], "viewers_port": 0, "origin": None,
    "sources": [
        {"name": "camera", "state": "running", "rate_hz": 30.0},
        {"name": "autopilot", "state": "running", "rate_hz": 90.0, "detail": "ArduPilot"},
    ],
    "feedback": {"mode": "odometry", "sending": True, "rate_hz": 30.0},
    "load": {"cpu_share": 0.5, "temperature_c": 55.0},
}  # fmt: skip
"""A status in which nothing is wrong."""


@dataclass
class Answer:
    """What came back."""

    status: int = 0
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes = b""

    @property
    def text(self) -> str:
        return self.body.decode()


class ServedPage:
    """See above. `config` is a file of settings, whose flights are in `folder`."""

    def __init__(self, folder: Path, config: str = "", supervised: bool = True) -> None:
        self.folder, self.flights = folder, folder / "flights"
        self.config = folder / "companion.toml"
        self.config.write_text(config, "utf-8")
        self.status: dict[str, Any] = json.loads(json.dumps(WELL))
        self.said: list[str] = []
        overrides = (f"daemon.flights={self.flights}",)
        self._facts = Facts.of_line(json.dumps({
            "config": to_toml(load_config(self.config, overrides)), "path": str(self.config),
            "overrides": overrides, "socket": str(folder / "run" / "status.sock"),
            "supervised": supervised,
        }))  # fmt: skip
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="page")
        self.now_s = 0.0
        """Added to the page's clock."""

    def __enter__(self) -> ServedPage:
        self._thread.start()
        self._do(self._start())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._do(self._stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @property
    def codes(self) -> Codes:
        found = read_codes(self.flights)
        assert found is not None
        return found

    def paired(self, code: str, peer: str = ELSEWHERE) -> dict[str, str]:
        """Headers of a device after pairing; AssertionError where the code is refused."""
        self.now_s += 15.0  # so that attempts are not too many
        answer = self.ask("POST", "/pair", peer=peer, form={"code": code})
        assert answer.status == 303, answer.text
        return {"cookie": answer.headers["set-cookie"].partition(";")[0]}

    def changer(self) -> tuple[dict[str, str], str]:
        """Headers and form token of a device that may change things."""
        headers = self.paired(self.codes.change)
        page = self.ask("GET", "/settings", headers=headers, peer=ELSEWHERE).text
        return headers, page.partition('name="token" value="')[2].partition('"')[0]

    def ask(
        self, method: str, path: str, *, peer: str = HERE, headers: Mapping[str, str] | None = None,
        form: Mapping[str, str] | None = None,
    ) -> Answer:  # fmt: skip
        """Ask the application itself, as from some machine."""
        answer: Answer = self._do(self._ask(method, path, peer, dict(headers or {}), form))
        return answer

    async def _ask(
        self, method: str, path: str, peer: str, headers: dict[str, str],
        form: Mapping[str, str] | None,
    ) -> Answer:  # fmt: skip
        body = urlencode(form).encode() if form is not None else b""
        sent = {"host": "192.168.1.5:9880", "accept": "text/html", **headers}
        if form is not None:
            sent.setdefault("content-type", "application/x-www-form-urlencoded")
            sent.setdefault("content-length", str(len(body)))
        path, _, query = path.partition("?")
        scope = {
            "type": "http", "http_version": "1.1", "method": method, "path": path,
            "raw_path": path.encode(), "query_string": query.encode(), "root_path": "",
            "scheme": "http", "server": ("192.168.1.5", 9880), "client": (peer, 40000),
            "headers": [(k.lower().encode(), v.encode()) for k, v in sent.items()],
        }  # fmt: skip
        answer, parts = Answer(), [body]

        async def receive() -> dict[str, Any]:
            if not parts:
                await asyncio.Event().wait()  # the peer stays until it has its answer
            return {"type": "http.request", "body": parts.pop(), "more_body": False}

        async def send(message: Any) -> None:
            if message["type"] == "http.response.start":
                answer.status = message["status"]
                answer.headers = {k.decode(): v.decode() for k, v in message["headers"]}
            else:
                answer.body += message.get("body", b"")

        await self._application(scope, receive, send)
        return answer

    async def _start(self) -> None:
        self._socket = StatusSocket(self._facts.socket, lambda: self.status, self.said.append)
        await self._socket.start()
        self._watch = DaemonWatch(self._facts.socket)
        self._scene = Scene(lambda: self._watch.viewers_port)
        self._application = application(
            self._facts, self._watch, self._scene, lambda: monotonic_s() + self.now_s,
            self.said.append,
        )  # fmt: skip
        listener = socket.create_server((HERE, 0))
        self.port = listener.getsockname()[1]
        self.server = bounded_server(self._application)
        self._serving = asyncio.ensure_future(self.server.serve(sockets=[listener]))

    async def _stop(self) -> None:
        self.server.should_exit = self.server.force_exit = True
        await self._serving
        await self._socket.stop()
        self._scene.close()
        await asyncio.to_thread(self._scene.join)
        await self._loop.shutdown_default_executor()

    def _do(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(30)
