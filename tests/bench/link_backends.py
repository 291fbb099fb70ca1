"""Cost of the MAVLink backends: time from sending to callback, and processor time.

    python -m tests.bench.link_backends [--seconds 20] [--busy] [WAY ...]

A process of its own sends ATTITUDE_QUATERNION at 100 Hz and RAW_IMU at 200 Hz over loopback UDP,
with the time of sending (CLOCK_MONOTONIC) in each; another listens:

    pymavlink  PymavlinkPort       our wire, stamps of the kernel
    mavsdk     PymavlinkPort       MAVSDK's wire, packets taken as they are
    json       MavlinkDirectAsync  MAVSDK's own way to give out messages, as JSON

`stamp` is how much later than its sending a message is stamped, `callback` how much later it is
handed over; `processor` is the processor time of the listening process, all its threads, as a
share of one core, and `idle` that of the same process before anything is sent. With --busy the
event loop of the listener is held up for 5 ms in every 20 ms, and a thread of it computes without a
pause, as stages beside it would; processor time then says nothing.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import socket
import threading
import time
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import LinkConfig, RouterConfig
from companion.timing.clock import FlightClock

WAYS = ("pymavlink", "mavsdk", "json")
TICK_S = 0.005  # 200 Hz
IDLE_S = 2.0
SETTLE_S = 1.0


class Measured:
    """Times of the messages that came, in microseconds since they were sent."""

    def __init__(self) -> None:
        self.stamp_us: list[float] = []
        self.callback_us: list[float] = []
        self.n = {"ATTITUDE_QUATERNION": 0, "RAW_IMU": 0}

    def clear(self) -> None:
        self.__init__()  # type: ignore[misc]

    def take(self, kind: str, sent: int, stamp_ns: int) -> None:
        """`sent`: microseconds of CLOCK_MONOTONIC, as far as the message had room for them."""
        if kind not in self.n:
            return
        self.n[kind] += 1
        now_ns = time.monotonic_ns()
        self.stamp_us.append(since_us(sent, stamp_ns))
        self.callback_us.append(since_us(sent, now_ns))


def since_us(sent: int, then_ns: int) -> float:
    """Both are told apart by their lowest 32 bits of microseconds."""
    whole_us, rest_ns = divmod(then_ns, 1000)
    difference = (whole_us - sent) % 2**32
    return (difference - 2**32 if difference >= 2**31 else difference) + rest_ns / 1000


def sent_in(message: Any) -> int:
    kind = message.get_type()
    if kind == "RAW_IMU":
        return int(message.time_usec)
    return int(message.time_boot_ms) if kind == "ATTITUDE_QUATERNION" else 0


def send(port: int, seconds: float) -> None:
    """The autopilot: heartbeat, then both messages at their rates."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    codec = mavlink.MAVLink(None, 1, 1)

    def say(message: Any) -> None:
        packet = bytes(message.pack(codec))
        codec.seq = (codec.seq + 1) % 256
        out.sendto(packet, ("127.0.0.1", port))

    begin = time.monotonic()
    for tick in range(int(seconds / TICK_S)):
        time.sleep(max(0.0, begin + tick * TICK_S - time.monotonic()))
        if tick % 200 == 0:
            say(mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 4, 3))
        say(mavlink.MAVLink_raw_imu_message(time.monotonic_ns() // 1000, *range(9)))
        if tick % 2 == 0:
            sent = time.monotonic_ns() // 1000 % 2**32
            say(mavlink.MAVLink_attitude_quaternion_message(sent, 1, 0, 0, 0, 0.1, 0.2, 0.3))
    out.close()


async def by_port(way: Any, port: int, measured: Measured) -> None:
    clock = FlightClock()
    config = LinkConfig(url=f"udpin:127.0.0.1:{port}", backend=way)

    def take(message: Any, t_ns: int) -> None:
        measured.take(message.get_type(), sent_in(message), t_ns - clock.epoch_ns)

    from drivers.mavlink.wire.link_port import link_port

    await link_port(config, RouterConfig(), clock).run(take)


async def by_json(port: int, measured: Measured) -> None:
    import mavsdk
    from mavsdk.asyncio import Configuration, Mavsdk
    from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync

    mavsdk.log_subscribe(lambda *_: True)
    async with Mavsdk(Configuration.create_manual(1, 197, False)) as held:
        await held.add_any_connection(f"udpin://127.0.0.1:{port}")
        while (system := await held.first_autopilot(0.2)) is None:
            pass
        async for message in MavlinkDirectAsync(system).subscribe_message(""):
            fields = json.loads(message.fields_json)
            sent = fields.get("time_usec") or fields.get("time_boot_ms") or 0
            measured.take(message.message_name, sent, time.monotonic_ns())


async def hold_up() -> None:
    while True:
        end = time.monotonic() + 0.005
        while time.monotonic() < end:
            pass
        await asyncio.sleep(0.015)


def compute(stop: threading.Event) -> None:
    matrix = np.random.default_rng(1).random((300, 300))
    while not stop.is_set():
        matrix = matrix @ matrix
        matrix /= np.abs(matrix).max()


async def listen(way: str, port: int, seconds: float, busy: bool, ready: Connection) -> Any:
    measured = Measured()
    work = by_json(port, measured) if way == "json" else by_port(way, port, measured)
    tasks = [asyncio.ensure_future(work)]
    await asyncio.sleep(SETTLE_S)
    before_s = time.process_time()
    await asyncio.sleep(IDLE_S)
    idle = (time.process_time() - before_s) / IDLE_S
    stop = threading.Event()
    if busy:
        tasks.append(asyncio.ensure_future(hold_up()))
        threading.Thread(target=compute, args=(stop,), daemon=True).start()
    ready.send("go")
    await asyncio.sleep(SETTLE_S)
    measured.clear()
    before_s, begin_s = time.process_time(), time.monotonic()
    await asyncio.sleep(seconds)
    processor = (time.process_time() - before_s) / (time.monotonic() - begin_s)
    result = vars(measured) | {"idle": idle, "processor": processor}
    stop.set()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return result


def measure(way: str, port: int, seconds: float, busy: bool, out: Connection) -> None:
    out.send(asyncio.run(listen(way, port, seconds, busy, out)))


def compare(ways: list[str], seconds: float, busy: bool) -> None:
    processes = multiprocessing.get_context("spawn")
    load = ", ".join(f"{each:.1f}" for each in os.getloadavg())
    print(f"{seconds:g} s each, {os.cpu_count()} cores{', busy' if busy else ''}; times in µs; "
          f"load of the machine before: {load}")  # fmt: skip
    print(f"{'':10}{'came':>7}{'stamp p50':>11}{'p99':>8}{'callback p50':>14}{'p99':>8}{'max':>8}"
          f"{'processor':>11}{'idle':>7}")  # fmt: skip
    for way in ways:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        ours, theirs = processes.Pipe()
        listener = processes.Process(target=measure, args=(way, port, seconds, busy, theirs))
        listener.start()
        ours.recv()
        sender = processes.Process(target=send, args=(port, seconds + 3 * SETTLE_S))
        sender.start()
        result = ours.recv()
        listener.join()
        sender.join()
        stamp, callback = np.array(result["stamp_us"]), np.array(result["callback_us"])
        came = sum(result["n"].values()) / (300 * seconds)
        print(f"{way:10}{came:7.1%}{np.median(stamp):11.0f}{np.percentile(stamp, 99):8.0f}"
              f"{np.median(callback):14.0f}{np.percentile(callback, 99):8.0f}{callback.max():8.0f}"
              f"{result['processor']:11.1%}{result['idle']:7.1%}")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("ways", nargs="*", default=list(WAYS), metavar="WAY")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--busy", action="store_true")
    given = parser.parse_args()
    compare(given.ways, given.seconds, given.busy)


if __name__ == "__main__":
    main()
