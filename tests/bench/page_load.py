"""Effect of the page on the pose: 20 browsers that look on, hung peers, and rubbish.

    python -m tests.bench.page_load [--rounds 5] [--seconds 20] [--real-time]

Flies the camera and the autopilot of the tests in real time. In turns nobody looks at the page, and
everything at once does: 20 clients that ask as an open view does, 20 that ask nothing or read
nothing, and rubbish at 10 MB/s as far as it is taken. Who asks is a process of the lowest priority,
as on a drone it is other machines: beside the camera and the autopilot of the tests it would make
them late too. Of each turn it prints the rate of poses that reached the autopilot, the 95th
percentile from exposure to pose, the memory (PSS) of all processes, and the processor time of the
page; at the end whether what it is with them lies within the spread without. `--real-time`, for
root, gives the pose the priority that it has in `companion.service` by LimitRTPRIO=1.
"""

from __future__ import annotations

import argparse
import contextlib
import http.client
import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import psutil

from companion.daemon.page_child import PAGE
from drivers.system.low_priority import give_way
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
        """End all of it; `answers` then has what came back."""
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


@contextlib.contextmanager
def asked(port: int) -> Iterator[None]:
    """All that asks, in a process of its own; prints what came back."""
    command = [sys.executable, "-m", "tests.bench.page_load", "--ask", str(port)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as child:
        yield
        child.communicate()


def ask(port: int) -> None:
    """Be that process, until the standard input ends."""
    give_way(0)
    load = Load(port)
    sys.stdin.read()
    load.stop()
    print("   ", dict(load.answers), flush=True)


class Turn(NamedTuple):
    """Measures of a turn."""

    poses_hz: float
    p95_ms: float
    pss_mb: float
    page_mb: float
    page_cpu: float
    """Share of a core."""


def give_real_time(daemon: psutil.Process) -> None:
    """Real-time priority for the thread from frame to pose, which the service lets it take."""
    pose = next(each for each in daemon.children(recursive=True) if each.name() == "localisation")
    os.sched_setscheduler(pose.pid, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))


def measured(paged: Paged, seconds: float, loaded: bool) -> Turn:
    """One turn."""
    daemon = psutil.Process(paged.daemon.pid)
    page = next(each for each in daemon.children(recursive=True) if PAGE in each.cmdline())
    with asked(paged.port) if loaded else contextlib.nullcontext():
        began_ns, cpu_s = time.monotonic_ns(), sum(page.cpu_times()[:2])
        late_ms = []
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            late_ms.append(paged.daemon.status()["pose_latency_p95_ms"] or 0.0)
            time.sleep(1.0)
        took_s = (time.monotonic_ns() - began_ns) * 1e-9
        n = sum(got.monotonic_ns >= began_ns for got in paged.autopilot.of("ODOMETRY"))
        pss = {
            each.pid: each.memory_full_info().pss / 1e6
            for each in [daemon, *daemon.children(recursive=True)]
        }
        cpu_s = sum(page.cpu_times()[:2]) - cpu_s
    return Turn(
        n / took_s, statistics.median(late_ms), sum(pss.values()), pss[page.pid], cpu_s / took_s
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--dense", action="store_true", help="with the dense map")
    parser.add_argument("--real-time", action="store_true", help="for the pose, as in the service")
    parser.add_argument("--ask", type=int, metavar="PORT", help="be who asks, for this bench")
    given = parser.parse_args()
    if given.ask:
        ask(given.ask)
        return
    found: dict[bool, list[Turn]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder, Paged(Path(folder), depth=given.dense) as paged:
        paged.until_served()
        paged.autopilot.arm()
        paged.daemon.until(lambda health: health["feedback"]["sending"], "poses", timeout_s=FLY_S)
        if given.real_time:
            give_real_time(psutil.Process(paged.daemon.pid))
        for number in range(given.rounds):
            for loaded in (False, True):
                turn = measured(paged, given.seconds, loaded)
                found[loaded].append(turn)
                print(
                    f"{number + 1} {'loaded' if loaded else 'alone '} {turn.poses_hz:6.2f} poses/s,"
                    f" p95 {turn.p95_ms:5.1f} ms, {turn.pss_mb:4.0f} MB in all, page"
                    f" {turn.page_mb:3.0f} MB and {turn.page_cpu:5.1%} of a core",
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
