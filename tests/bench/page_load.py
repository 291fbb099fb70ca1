"""Effect of the page on the pose: 20 browsers that look on, hung peers, and rubbish.

    python -m tests.bench.page_load [--rounds 5] [--seconds 20]

Flies the camera and the autopilot of the tests in real time. In turns nobody looks at the page, and
everything at once does: 20 clients that ask as an open view does, 20 that ask nothing or read
nothing, and rubbish at 10 MB/s. Of each turn it prints the rate of poses that reached the
autopilot, the 95th percentile from exposure to pose, and the memory (PSS) of all processes; at the
end whether what it is with them lies within the spread without.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import socket
import statistics
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import psutil

from tests.support.processes.paged import Paged

N_LOOKING, N_HUNG = 20, 20
RUBBISH_BYTES_S = 10_000_000
HOST = "127.0.0.1"
EVERY_S = (("/now/panel", 1.0), ("/now/above", 1.0), ("/now/picture", 0.2))
FLY_S = 90.0


class Load:
    """All that asks, until `stop`."""

    def __init__(self, port: int) -> None:
        self._port, self._over = port, threading.Event()
        self.answers: Counter[str] = Counter()
        work = [self._look] * N_LOOKING + [self._hang] * N_HUNG + [self._rubbish]
        self._threads = [threading.Thread(target=each, daemon=True) for each in work]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End all of it."""
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _look(self) -> None:
        due_s = dict.fromkeys((path for path, _ in EVERY_S), 0.0)
        number = -1
        while not self._over.is_set():
            connection = http.client.HTTPConnection(HOST, self._port, timeout=10)
            try:
                while not self._over.is_set():
                    for path, every_s in EVERY_S:
                        if time.monotonic() < due_s[path]:
                            continue
                        due_s[path] = time.monotonic() + every_s
                        asked = f"{path}?after={number}" if path.endswith("picture") else path
                        connection.request("GET", asked)
                        answer = connection.getresponse()
                        body = answer.read()
                        self.answers[str(answer.status)] += 1
                        if path.endswith("picture") and answer.status == 200:
                            number = json.loads(body)["number"]
                    self._over.wait(0.02)
            except (OSError, http.client.HTTPException) as error:
                self.answers[type(error).__name__] += 1
                self._over.wait(0.5)
            finally:
                connection.close()

    def _hang(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(OSError), socket.create_connection((HOST, self._port)) as peer:
                peer.sendall(b"GET /settings HTTP/1.1\r\nHost: localhost\r\n")
                peer.settimeout(0.5)
                while not self._over.is_set():
                    with contextlib.suppress(TimeoutError):
                        if not peer.recv(1024):
                            break
            self._over.wait(0.5)

    def _rubbish(self) -> None:
        data, n_bytes, began_s = os.urandom(65536), 0, time.monotonic()
        while not self._over.is_set():
            with contextlib.suppress(OSError), socket.create_connection((HOST, self._port)) as peer:
                peer.settimeout(1.0)
                while not self._over.is_set():
                    n_bytes += peer.send(data)
                    ahead_s = n_bytes / RUBBISH_BYTES_S - (time.monotonic() - began_s)
                    self._over.wait(max(0.0, ahead_s))
            self.answers["rubbish refused"] += 1
            self._over.wait(0.01)
        self.answers["rubbish MB"] = round(n_bytes / 1e6)


def measured(paged: Paged, seconds: float, loaded: bool) -> tuple[float, float, float, float]:
    """Poses a second, p95 (ms), memory of all processes and of the page (MB), in one turn."""
    load = Load(paged.port) if loaded else None
    began_ns = time.monotonic_ns()
    late_ms = []
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        late_ms.append(paged.daemon.status()["pose_latency_p95_ms"] or 0.0)
        time.sleep(1.0)
    took_s = (time.monotonic_ns() - began_ns) * 1e-9
    n = sum(got.monotonic_ns >= began_ns for got in paged.autopilot.of("ODOMETRY"))
    daemon = psutil.Process(paged.daemon.pid)
    pss_mb, page_mb = 0.0, 0.0
    for process in [daemon, *daemon.children(recursive=True)]:
        mb = process.memory_full_info().pss / 1e6
        pss_mb += mb
        if "companion.page.page_process" in process.cmdline():
            page_mb = mb
    if load is not None:
        load.stop()
        print("   ", dict(load.answers))
    return n / took_s, statistics.median(late_ms), pss_mb, page_mb


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--dense", action="store_true", help="with the dense map")
    given = parser.parse_args()
    found: dict[bool, list[tuple[float, float, float, float]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder, Paged(Path(folder), depth=given.dense) as paged:
        paged.until_served()
        paged.autopilot.arm()
        paged.daemon.until(lambda health: health["feedback"]["sending"], "poses", timeout_s=FLY_S)
        for number in range(given.rounds):
            for loaded in (False, True):
                hz, p95_ms, pss_mb, page_mb = result = measured(paged, given.seconds, loaded)
                found[loaded].append(result)
                print(
                    f"{number + 1} {'loaded' if loaded else 'alone '} {hz:6.2f} poses/s, p95"
                    f" {p95_ms:5.1f} ms, {pss_mb:4.0f} MB in all, page {page_mb:3.0f} MB",
                    flush=True,
                )
    for index, name in ((0, "poses/s"), (1, "p95, ms")):
        alone = [each[index] for each in found[False]]
        loaded_too = [each[index] for each in found[True]]
        middle = statistics.median(loaded_too)
        within = "within" if min(alone) <= middle <= max(alone) else "outside"
        print(
            f"{name}: alone {min(alone):.2f} to {max(alone):.2f}, loaded median {middle:.2f}"
            f" ({min(loaded_too):.2f} to {max(loaded_too):.2f}): {within} the spread"
        )


if __name__ == "__main__":
    main()
