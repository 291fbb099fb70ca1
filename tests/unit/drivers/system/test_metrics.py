"""Metrics over real loopback TCP, parsed by the library."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import re
import socket
import urllib.error
import urllib.request
from collections.abc import AsyncIterator, Callable

import pytest
from prometheus_client.parser import text_string_to_metric_families

from companion.errors import ConfigError
from companion.health import (
    ComputerLoad,
    FeedbackHealth,
    Health,
    ProcessLoad,
    SourceHealth,
    StageHealth,
)
from drivers.system import metrics, short_answers
from drivers.system.metrics import Metrics
from tests.support.waiting import PATIENCE_S

HEALTH = Health(
    1,
    125.0,
    (SourceHealth("camera", "running", 29.96, 3000, 12, 1, 0.02),),
    (StageHealth("pose", True, 29.9, 31.0, 41.4, 2990, 3, 1),),
    'tracking "well"\n',
    84,
    "from the autopilot's positions",
    41.4,
    FeedbackHealth("odometry", True, rate_hz=30.0, latency_p95_ms=45.0, n_sent=2900, n_resets=1),
    "2026-11-21",
    ComputerLoad(
        cpu_share=0.5,
        temperatures_c={"cpu": 71.5},
        memory_used_mib=100,
        processes=(ProcessLoad("stage", 1, 0.5, 10), ProcessLoad("stage", 2, 0.25, 20)),
    ),
    loop_delay_p99_ms=2.5,
    n_warnings={"frames are missing": 2},
)


@contextlib.asynccontextmanager
async def served(
    health: Callable[[], Health] = lambda: HEALTH,
) -> AsyncIterator[tuple[int, list[str]]]:
    warned: list[str] = []
    server = Metrics(0, health, warned.append)
    await server.start()
    try:
        yield server.port, warned
    finally:
        await server.stop()


def get(port: int, path: str = "/metrics") -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=PATIENCE_S) as reply:
        text: str = reply.read().decode()
    return text


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def scrape(health: Health) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    async def test() -> str:
        async with served(lambda: health) as (port, _):
            return await asyncio.to_thread(get, port)

    return samples(asyncio.run(test()))


def test_health_is_scraped_with_units_of_prometheus() -> None:
    found = scrape(HEALTH)
    camera = ("source", "camera")
    assert found["companion_source_rate_hz", (camera,)] == 29.96
    assert found["companion_source_dropped_total", (camera,)] == 12
    assert found["companion_source_state", (camera, ("state", "running"))] == 1
    assert found["companion_source_state", (camera, ("state", "missing"))] == 0
    latency = ("companion_stage_latency_seconds", (("quantile", "0.95"), ("stage", "pose")))
    assert found[latency] == pytest.approx(0.0414)
    assert found["companion_tracker_state", (("state", 'tracking "well"\n'),)] == 1
    assert found["companion_feedback_sent_total", ()] == 2900
    assert found["companion_memory_used_bytes", ()] == 100 * 2**20
    assert found["companion_temperature_celsius", (("sensor", "cpu"),)] == 71.5
    assert found["companion_process_cpu_cores", (("process", "stage"),)] == 0.75
    delay = found["companion_event_loop_delay_seconds", (("quantile", "0.99"),)]
    assert delay == pytest.approx(0.0025)
    assert found["companion_warnings_total", (("what", "frames are missing"),)] == 2


def test_what_is_not_known_has_no_sample() -> None:
    names = {name for name, _ in scrape(Health(1))}
    assert "companion_pose_quality" in names
    assert not names & {
        "companion_cpu_share", "companion_disk_free_bytes", "companion_pose_latency_seconds",
        "companion_event_loop_delay_seconds", "companion_temperature_celsius",
    }  # fmt: skip


def test_every_metric_is_described_and_every_described_one_exists() -> None:
    assert metrics.__doc__ is not None
    described = {
        name
        for row in re.findall(r"^\| (`.*?) \|", metrics.__doc__, re.MULTILINE)
        for name in re.findall(r"`([a-z_]+)`", row)
    } - {"companion_"}
    load = dataclasses.replace(HEALTH.load, gpu_share=0.1, memory_total_mib=200, disk_free_mib=1.0)
    feedback = dataclasses.replace(HEALTH.feedback, latency_p50_ms=20.0)
    found = {name for name, _ in scrape(dataclasses.replace(HEALTH, load=load, feedback=feedback))}
    assert found == {f"companion_{name}" for name in described}


def test_each_scrape_reads_the_health_of_its_moment() -> None:
    now = [HEALTH]

    async def test() -> list[float]:
        async with served(lambda: now[0]) as (port, _):
            first = samples(await asyncio.to_thread(get, port))
            now[0] = dataclasses.replace(HEALTH, quality=-1)
            second = samples(await asyncio.to_thread(get, port))
        return [found["companion_pose_quality", ()] for found in (first, second)]

    assert asyncio.run(test()) == [84, -1]


async def test_only_loopback_listens() -> None:
    async with served() as (port, _):
        with socket.socket() as other:
            other.bind(("127.0.0.2", port))  # would be in use, were it 0.0.0.0


async def test_a_port_in_use_is_named() -> None:
    async with served() as (port, _):
        with pytest.raises(ConfigError, match=f"prometheus_port: 127.0.0.1:{port}: "):
            await Metrics(port, lambda: HEALTH, print).start()


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET / HTTP/1.1\r\n\r\n", b"404"),
        (b"POST /metrics HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc", b"405"),
        (b"\x16\x03\x01 garbage\r\n\r\n", b"400"),
        (b"GET /" + b"a" * 50_000 + b"\r\n\r\n", b"400"),
        (b"GET /metrics?x HTTP/1.0\r\n\r\n", b"200"),
        (b"HEAD /metrics HTTP/1.1\r\n\r\n", b"200"),
    ],
)
def test_other_questions_get_short_answers(request_: bytes, status: bytes) -> None:
    async def test() -> bytes:
        async with served() as (port, warned):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(request_)
            answer = await reader.readline()
            writer.close()
            assert warned == []
            assert "companion_uptime_seconds" in await asyncio.to_thread(get, port)
        return answer

    assert asyncio.run(test()).split()[1] == status


async def test_clients_that_ask_nothing_hold_a_place_for_a_short_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(short_answers, "TIMEOUT_S", 0.2)
    async with served() as (port, _):
        stuck = [
            await asyncio.open_connection("127.0.0.1", port)
            for _ in range(3 * short_answers.MAX_CLIENTS)
        ]
        await asyncio.sleep(0.3)
        assert "companion_uptime_seconds" in await asyncio.to_thread(get, port)
        for _, writer in stuck:
            writer.close()


async def test_a_fault_in_health_is_told_and_survived() -> None:
    faults = iter([True, False])

    def health() -> Health:
        if next(faults):
            raise RuntimeError("no health")
        return HEALTH

    async with served(health) as (port, warned):
        with pytest.raises((OSError, urllib.error.URLError)):
            await asyncio.to_thread(get, port)
        assert warned == ["RuntimeError: no health"]
        assert "companion_uptime_seconds" in await asyncio.to_thread(get, port)
