"""A drone and a ground in network namespaces of one machine, and a thin link between them.

Needs root. Rate is `tc tbf` on either side, loss an nftables rule, and delay a relay between two
TUN devices, since not every kernel has netem.

    with TwoNamespaces(kbit_s=2000, delay_ms=60, loss=0.02) as link:
        subprocess.run([*link.in_ground, "ping", link.DRONE])
"""

from __future__ import annotations

import ctypes
import fcntl
import heapq
import itertools
import os
import select
import struct
import subprocess
import sys
import threading
import time
from types import TracebackType

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
CLONE_NEWNET = 0x40000000
MTU = 1400
RULES = """
table inet air {{
  chain lost {{
    type filter hook input priority 0
    iifname "air" numgen random mod 1000 < {n} drop
  }}
}}
"""
QUEUE_MS = 300
"""What waits before the rate's bottleneck; radios hold about so much."""


def why_not() -> str:
    """Why there can be no namespaces here; "" if there can."""
    if os.geteuid() != 0:
        return "needs root"
    if not os.path.exists("/dev/net/tun"):
        return "needs /dev/net/tun"
    name = f"cv{os.getpid()}probe"
    try:
        _run("ip", "netns", "add", name)
    except (OSError, subprocess.CalledProcessError):
        return "network namespaces are not allowed here"
    try:
        _run("ip", "-n", name, "tuntap", "add", "dev", "air", "mode", "tun")
        _run("tc", "-n", name, "qdisc", "add", "dev", "air", "root", "tbf",
             "rate", "1mbit", "burst", "4kb", "latency", "50ms")  # fmt: skip
        _run("ip", "netns", "exec", name, "nft", "add", "table", "inet", "probe")
    except (OSError, subprocess.CalledProcessError):
        return "TUN, tc tbf or nftables is not to be had here"
    finally:
        _run("ip", "netns", "del", name)
    return ""


class TwoNamespaces:
    """The namespaces, as long as this is open; delay is one way, loss is in both directions."""

    DRONE, GROUND = "10.77.0.1", "10.77.0.2"

    def __init__(self, kbit_s: float, delay_ms: float, loss: float = 0.0) -> None:
        self._kbit_s, self._loss = kbit_s, loss
        self._names = {side: f"cv{os.getpid()}{side}" for side in ("drone", "ground")}
        self._tuns: list[int] = []
        self._relay = Relay(delay_ms * 1e-3)

    @property
    def in_drone(self) -> list[str]:
        """What to put before a command that is to run there."""
        return ["ip", "netns", "exec", self._names["drone"]]

    @property
    def in_ground(self) -> list[str]:
        """What to put before a command that is to run there."""
        return ["ip", "netns", "exec", self._names["ground"]]

    def cut(self, is_cut: bool) -> None:
        """Nothing gets through any more, or again."""
        self._relay.is_cut = is_cut

    @property
    def to_ground_bytes(self) -> int:
        """All that the drone has put on the air."""
        return self._relay.n_bytes[0]

    def __enter__(self) -> TwoNamespaces:
        try:
            self._make()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def _make(self) -> None:
        for (_, name), address in zip(self._names.items(), (self.DRONE, self.GROUND), strict=True):
            _run("ip", "netns", "add", name)
            self._tuns.append(_tun_in(name))
            _run("ip", "-n", name, "link", "set", "lo", "up")
            _run("ip", "-n", name, "addr", "add", f"{address}/24", "dev", "air")
            _run("ip", "-n", name, "link", "set", "air", "up", "mtu", str(MTU))
            _run("tc", "-n", name, "qdisc", "add", "dev", "air", "root", "tbf",
                 "rate", f"{self._kbit_s:.0f}kbit", "burst", "4kb",
                 "latency", f"{QUEUE_MS}ms")  # fmt: skip
            if self._loss:
                rules = RULES.format(n=round(1000 * self._loss))
                _run("ip", "netns", "exec", name, "nft", "-f", "-", said=rules)
        self._relay.start(self._tuns)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._relay.stop()
        for fd in self._tuns:
            os.close(fd)
        for name in self._names.values():
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


class Relay:
    """Packets of one TUN device to the other, each so much later; in a thread of its own."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self.is_cut = False
        self.n_bytes = [0, 0]
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, tuns: list[int]) -> None:
        """Begin."""
        self._thread = threading.Thread(target=self._work, args=(tuns,), daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, and wait for that."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    def _work(self, tuns: list[int]) -> None:
        waiting: list[tuple[float, int, int, bytes]] = []
        count = itertools.count()
        while not self._stop.is_set():
            now_s = time.monotonic()
            while waiting and waiting[0][0] <= now_s:
                _, _, to, packet = heapq.heappop(waiting)
                os.write(tuns[to], packet)
            timeout_s = min(0.1, max(0.0, waiting[0][0] - now_s)) if waiting else 0.1
            for fd in select.select(tuns, [], [], timeout_s)[0]:
                packet = os.read(fd, 65536)
                side = tuns.index(fd)
                self.n_bytes[side] += len(packet)
                if not self.is_cut:
                    due_s = time.monotonic() + self._delay_s
                    heapq.heappush(waiting, (due_s, next(count), 1 - side, packet))


def _tun_in(namespace: str) -> int:
    """A new TUN device `air` in a namespace; its descriptor, which can be used from anywhere."""
    libc = ctypes.CDLL(None, use_errno=True)

    def enter(path: str) -> None:
        fd = os.open(path, os.O_RDONLY)
        try:
            if libc.setns(fd, CLONE_NEWNET) != 0:
                raise OSError(ctypes.get_errno(), f"cannot enter {path}")
        finally:
            os.close(fd)

    # by way of the thread, whose namespace it is: that of others stays
    home = f"/proc/{os.getpid()}/task/{threading.get_native_id()}/ns/net"
    kept = os.open(home, os.O_RDONLY)
    try:
        enter(f"/var/run/netns/{namespace}")
        tun = os.open("/dev/net/tun", os.O_RDWR)
        fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH22x", b"air", IFF_TUN | IFF_NO_PI))
    finally:
        if libc.setns(kept, CLONE_NEWNET) != 0:
            sys.exit("cannot leave the namespace")
        os.close(kept)
    return tun


def _run(*command: str, said: str = "") -> None:
    subprocess.run(command, check=True, capture_output=True, input=said.encode())
