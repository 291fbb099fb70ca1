"""Health as Prometheus text, at http://127.0.0.1:PORT/metrics.

| metric, after `companion_` | labels | |
|---|---|---|
| `uptime_seconds`, `flight_active` | | |
| `source_state` | source, state | 1 for the state it is in |
| `source_rate_hz`, `source_age_seconds` | source | |
| `source_received_total`, `source_dropped_total`, `source_reopened_total` | source | |
| `stage_alive`, `stage_rate_hz` | stage | |
| `stage_latency_seconds` | stage, quantile | exposure to result, last seconds |
| `stage_results_total`, `stage_dropped_total`, `stage_restarts_total` | stage | |
| `tracker_state` | state | 1 for the state it is in |
| `pose_quality`, `scale_known` | | quality -1 while lost |
| `pose_latency_seconds` | quantile | exposure to pose |
| `feedback_sending`, `feedback_rate_hz` | | |
| `feedback_sent_total`, `feedback_resets_total` | | |
| `feedback_latency_seconds` | quantile | exposure to sending |
| `flow_sending`, `flow_rate_hz`, `flow_sent_total` | | optical flow |
| `degradation_level` | | 0: nothing is left out |
| `cpu_share`, `gpu_share` | | 0 to 1 |
| `memory_used_bytes`, `memory_total_bytes`, `disk_free_bytes` | | |
| `temperature_celsius` | sensor | |
| `process_cpu_cores`, `process_memory_bytes` | process | of our processes |
| `event_loop_delay_seconds` | quantile | |
| `warnings_total` | what | |

What is not known has no sample. Each scrape reads the health of its moment.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from http import HTTPStatus
from typing import Any, get_args

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.registry import Collector

from companion.errors import ConfigError
from companion.health import Health, SourceState
from drivers.system.short_answers import ShortAnswers

MIB = 1 << 20
HOST = "127.0.0.1"
TEXT = "text/plain; charset=utf-8"


class Metrics:
    """HTTP server of the metrics on a loopback port; `warn` takes faults in making an answer."""

    def __init__(
        self, port: int, health: Callable[[], Health], warn: Callable[[str], None]
    ) -> None:
        self._port = port
        self._warn = warn
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(_HealthCollector(health))
        self._answers: ShortAnswers | None = None

    async def start(self) -> None:
        """Listen. ConfigError where the port is unavailable."""
        listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((HOST, self._port))
        except OSError as error:
            listening.close()
            raise ConfigError(
                f"expert.daemon.prometheus_port: {HOST}:{self._port}: {error.strerror}; "
                "choose another"
            ) from error
        self._port = listening.getsockname()[1]
        self._answers = ShortAnswers(listening, self._answer, self._warn)
        await self._answers.start()

    async def stop(self) -> None:
        """Stop listening."""
        if self._answers is not None:
            await self._answers.stop()
            self._answers = None

    @property
    def port(self) -> int:
        """Port in use; the one given, or, for 0, the one found."""
        return self._port

    async def _answer(self, reader: asyncio.StreamReader) -> bytes:
        try:
            head = await reader.readuntil(b"\r\n\r\n")
        except (asyncio.LimitOverrunError, asyncio.IncompleteReadError):
            return _response(HTTPStatus.BAD_REQUEST, TEXT, b"not an HTTP request\n")
        words = head.split(b"\r\n", 1)[0].split(b" ")
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            return _response(HTTPStatus.BAD_REQUEST, TEXT, b"not an HTTP request\n")
        if words[0] not in (b"GET", b"HEAD"):
            return _response(HTTPStatus.METHOD_NOT_ALLOWED, TEXT, b"only GET is answered\n")
        if words[1].split(b"?")[0] != b"/metrics":
            return _response(HTTPStatus.NOT_FOUND, TEXT, b"there is /metrics only\n")
        answer = _response(HTTPStatus.OK, CONTENT_TYPE_LATEST, generate_latest(self._registry))
        return answer if words[0] == b"GET" else answer[: answer.index(b"\r\n\r\n") + 4]


def _response(status: HTTPStatus, content_type: str, body: bytes) -> bytes:
    head = (
        f"HTTP/1.1 {status.value} {status.phrase}\r\n"
        f"Content-Type: {content_type}\r\n"
        f"Content-Length: {len(body)}\r\n"
        "Connection: close\r\n\r\n"
    )
    return head.encode() + body


class _HealthCollector(Collector):
    def __init__(self, health: Callable[[], Health]) -> None:
        self._health = health

    def collect(self) -> Iterable[Metric]:
        health = self._health()
        yield from _of_flight(health)
        yield from _of_sources(health)
        yield from _of_stages(health)
        yield from _of_computer(health)


Samples = Mapping[tuple[str, ...], float | None]


def _family(kind: Any, name: str, says: str, given: Samples | float | None, *labels: str) -> Metric:
    """Metric of one number, or of several samples by their labels."""
    family: Metric = kind(f"companion_{name}", says, labels=labels)
    for values, number in (given if isinstance(given, Mapping) else {(): given}).items():
        if number is not None:
            family.add_metric(values, number)  # type: ignore[attr-defined]
    return family


_gauge, _counter = partial(_family, GaugeMetricFamily), partial(_family, CounterMetricFamily)


def _times(number: float | None, factor: float) -> float | None:
    return None if number is None else number * factor


def _of_flight(health: Health) -> Iterator[Metric]:
    feedback = health.feedback
    yield _gauge("uptime_seconds", "Since the daemon started.", health.uptime_s)
    yield _gauge("flight_active", "Whether a flight goes on.", bool(health.flight))
    yield _gauge("tracker_state", "What the tracker does.", {(health.tracker,): 1}, "state")
    yield _gauge("pose_quality", "1 to 100; -1 while lost.", health.quality)
    yield _gauge("scale_known", "Whether the map is metric.", bool(health.scale))
    yield _gauge(
        "pose_latency_seconds", "From exposure to pose.",
        {("0.95",): _times(health.pose_latency_p95_ms, 1e-3)}, "quantile",
    )  # fmt: skip
    yield _gauge("feedback_sending", "Whether the autopilot is given poses.", feedback.sending)
    yield _gauge("feedback_rate_hz", "Poses sent a second.", feedback.rate_hz)
    yield _counter("feedback_sent", "Poses sent.", feedback.n_sent)
    yield _counter("feedback_resets", "Resets announced.", feedback.n_resets)
    yield _gauge(
        "feedback_latency_seconds", "From exposure to sending.",
        {
            ("0.5",): _times(feedback.latency_p50_ms, 1e-3),
            ("0.95",): _times(feedback.latency_p95_ms, 1e-3),
        },
        "quantile",
    )  # fmt: skip
    flow = health.flow
    yield _gauge("flow_sending", "Whether the autopilot is given flow.", flow.sending)
    yield _gauge("flow_rate_hz", "Flow messages sent a second.", flow.rate_hz)
    yield _counter("flow_sent", "Flow messages sent.", flow.n_sent)
    yield _gauge("degradation_level", "0 where nothing is left out.", health.degradation)
    yield _gauge(
        "event_loop_delay_seconds", "How late the event loop comes.",
        {("0.99",): _times(health.loop_delay_p99_ms, 1e-3)}, "quantile",
    )  # fmt: skip
    yield _counter(
        "warnings", "Things warned of.", {(what,): n for what, n in health.n_warnings.items()},
        "what",
    )  # fmt: skip


def _of_sources(health: Health) -> Iterator[Metric]:
    by, sources = "source", health.sources
    yield _gauge(
        "source_state", "1 for the state it is in.",
        {(s.name, state): s.state == state for s in sources for state in get_args(SourceState)},
        "source", "state",
    )  # fmt: skip
    yield _gauge("source_rate_hz", "Rate.", {(s.name,): s.rate_hz for s in sources}, by)
    yield _gauge("source_age_seconds", "Since the last.", {(s.name,): s.age_s for s in sources}, by)
    yield _counter("source_received", "What came.", {(s.name,): s.n for s in sources}, by)
    yield _counter("source_dropped", "Given up.", {(s.name,): s.n_dropped for s in sources}, by)
    yield _counter("source_reopened", "Came back.", {(s.name,): s.n_reopened for s in sources}, by)


def _of_stages(health: Health) -> Iterator[Metric]:
    by, stages = "stage", health.stages
    yield _gauge("stage_alive", "Whether it runs.", {(s.name,): s.alive for s in stages}, by)
    yield _gauge("stage_rate_hz", "Results a second.", {(s.name,): s.rate_hz for s in stages}, by)
    latency: dict[tuple[str, ...], float | None] = {}
    for s in stages:
        latency[s.name, "0.5"] = _times(s.latency_p50_ms, 1e-3)
        latency[s.name, "0.95"] = _times(s.latency_p95_ms, 1e-3)
    yield _gauge("stage_latency_seconds", "From exposure to result.", latency, "stage", "quantile")
    yield _counter("stage_results", "Results.", {(s.name,): s.n for s in stages}, by)
    yield _counter("stage_dropped", "Not done.", {(s.name,): s.n_dropped for s in stages}, by)
    yield _counter("stage_restarts", "Restarts.", {(s.name,): s.n_restarted for s in stages}, by)


def _of_computer(health: Health) -> Iterator[Metric]:
    load = health.load
    yield _gauge("cpu_share", "Of all cores.", load.cpu_share)
    yield _gauge("gpu_share", "Of the GPU.", load.gpu_share)
    yield _gauge("memory_used_bytes", "In use.", _times(load.memory_used_mib, MIB))
    yield _gauge("memory_total_bytes", "In all.", _times(load.memory_total_mib, MIB))
    yield _gauge("disk_free_bytes", "Where flights are written.", _times(load.disk_free_mib, MIB))
    yield _gauge(
        "temperature_celsius", "By sensor.",
        {(sensor,): celsius for sensor, celsius in load.temperatures_c.items()}, "sensor",
    )  # fmt: skip
    cores: dict[tuple[str, ...], float | None] = {}
    memory: dict[tuple[str, ...], float | None] = {}
    for process in load.processes:
        name = (process.name,)  # several of one name are one sample
        cores[name] = (cores.get(name) or 0.0) + process.cpu_cores
        memory[name] = (memory.get(name) or 0.0) + process.memory_mib * MIB
    yield _gauge("process_cpu_cores", "Cores kept busy.", cores, "process")
    yield _gauge("process_memory_bytes", "Resident memory.", memory, "process")
