"""`companion status`: status of the running daemon, as a table or as JSON."""

from __future__ import annotations

import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from companion.config import MEASUREMENTS
from companion.timing.clock import wait_s
from drivers.system.status_socket import ask_status

WATCH_EVERY_S = 1.0
CLEAR = "\x1b[H\x1b[2J"
NOTHING = "-"


def show_status(
    path: Path, out: TextIO, *, as_json: bool, watch: bool, stop: threading.Event
) -> None:
    """Ask once, or repeatedly until `stop`. SourceError where no daemon answers.

    While watching, a daemon that goes away ends it, too.
    """
    while True:
        document = ask_status(path)
        if as_json:
            print(json.dumps(document), file=out, flush=True)
        else:
            head = CLEAR if watch and out.isatty() else ""
            print(head + status_table(document), file=out, flush=True)
        if not watch or stop.is_set():
            return
        wait_s(stop, WATCH_EVERY_S)
        if stop.is_set():
            return


def status_table(document: Mapping[str, Any]) -> str:
    """The document as tables; a daemon of another version may lack any part of it."""
    return "\n".join(
        [
            *_pairs(document),
            "",
            *_table(
                ("source", "state", "rate", "received", "dropped", "reopened", "last", ""),
                [_source(each) for each in document.get("sources") or ()],
            ),
            "",
            *_table(
                ("stage", "state", "rate", "p50", "p95", "done", "dropped", "restarted", ""),
                [row for each in document.get("stages") or () for row in _stage(each)],
            ),
            *_processes((document.get("load") or {}).get("processes") or ()),
            *_warnings(document.get("n_warnings") or {}),
        ]
    )


def _pairs(document: Mapping[str, Any]) -> list[str]:
    load = document.get("load") or {}
    quality = document.get("quality", -1)
    pose = [str(document.get("tracker", NOTHING))]
    pose += [f"quality {quality}"] if quality is not None and quality > 0 else []
    pose += [f"{_number(document.get('pose_latency_p95_ms'), ' ms')} after exposure (p95)"]
    computer = [
        f"processor {_share(load.get('cpu_share'))}",
        f"memory {_share(load.get('memory_share'))}",
        f"{_number(load.get('temperature_c'), ' C')}",
        f"disk {_number(_scaled(load.get('disk_free_mib'), 1 / 1024), ' GiB', 1)} free",
    ]
    flow, landing = document.get("flow") or {}, document.get("landing") or {}
    place = document.get("global_position") or {}
    rows = [
        ("pose", ", ".join(pose)),
        ("scale", document.get("scale") or "not known"),
        *_belief(document.get("believed", MEASUREMENTS)),
        *_refused(document.get("refused") or {}),
        ("feedback", _feedback(document.get("feedback") or {})),
        *_sent(
            "flow", flow, "message",
            flow.get("why_not") or f"quality {flow.get('quality')} of 255", _after_exposure(flow),
        ),
        *_sent(
            "landing", landing, "marker",
            f"{_number(landing.get('distance_m'), ' m', 1)} away", _after_exposure(landing),
        ),
        *_sent("global", place, "mode", str(place.get("detail", NOTHING))),
        ("flight", document.get("flight") or "none"),
        ("reduced", document.get("degraded") or "nothing"),
        ("set", _settings(document.get("set_by_ground") or {})),
        ("computer", ", ".join(computer)),
        *_profile(document.get("profile", "none")),
        ("event loop", f"{_number(document.get('loop_delay_p99_ms'), ' ms', 1)} late (p99)"),
        ("running for", _number(document.get("uptime_s"), " s")),
    ]  # fmt: skip
    return [f"{name:12}{value}" for name, value in rows]


def _belief(believed: Sequence[Any]) -> list[tuple[str, str]]:
    """Row of the telemetry that is believed, where that is not everything."""
    if set(believed) >= set(MEASUREMENTS):
        return []
    return [("believed", f"{', '.join(map(str, believed)) or 'nothing'} (telemetry.use)")]


def _profile(name: Any) -> list[tuple[str, str]]:
    """Row of the profile, unless there is none."""
    return [] if name == "none" else [("profile", str(name))]


def _settings(settings: Mapping[str, Any]) -> str:
    """Settings changed by the ground station."""
    parts = [f"{key} = {value}" for key, value in sorted(settings.items())]
    return ", ".join(parts) + " (by the ground)" if parts else "nothing by the ground"


def _feedback(feedback: Mapping[str, Any]) -> str:
    if feedback.get("mode", "off") == "off":
        return "off"
    if not feedback.get("sending"):
        detail = feedback.get("detail")
        why = f"held back: {feedback.get('why_not') or 'not yet'}"
        return why + (f" ({detail})" if detail else "")
    by = " by dead reckoning" if feedback.get("bridging") else ""
    return (
        f"{feedback['mode']}{by}, {_number(feedback.get('rate_hz'), '/s')},"
        f" {_after_exposure(feedback)}"
        f" ({_number(feedback.get('latency_p95_ms'), ' ms')} p95),"
        f" {feedback.get('n_resets', 0)} resets,"
        f" {feedback.get('n_overtaken', 0)} overtaken by predictions"
    )


def _sent(name: str, given: Mapping[str, Any], key: str, *parts: str) -> list[tuple[str, str]]:
    """Row of something else that is sent, unless it is off by its `key`."""
    if given.get(key, "off") == "off":
        return []
    if not given.get("sending"):
        return [(name, f"not sent: {given.get('why_not') or 'not yet'}")]
    return [(name, ", ".join([str(given[key]), _number(given.get("rate_hz"), "/s"), *parts]))]


def _after_exposure(given: Mapping[str, Any]) -> str:
    return f"{_number(given.get('latency_p50_ms'), ' ms')} after exposure"


def _source(source: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        str(source.get("name", NOTHING)),
        str(source.get("state", NOTHING)),
        _number(source.get("rate_hz"), "/s", 1),
        _number(source.get("n")),
        _number(source.get("n_dropped")),
        _number(source.get("n_reopened")),
        _number(source.get("age_s"), " s ago", 1),
        str(source.get("detail", "")),
    )


def _stage(stage: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Its row, and below it a line for each other part of its detail.

    Those of the dense map's stage are the OpenCL devices that were refused, slower, or have failed.
    """
    detail, *others = str(stage.get("detail", "")).split("; ")
    row = (
        str(stage.get("name", NOTHING)),
        "runs" if stage.get("alive") else "down",
        _number(stage.get("rate_hz"), "/s", 1),
        _number(stage.get("latency_p50_ms"), " ms"),
        _number(stage.get("latency_p95_ms"), " ms"),
        _number(stage.get("n")),
        _number(stage.get("n_dropped")),
        _number(stage.get("n_restarted")),
        detail,
    )
    return [row, *[("",) * (len(row) - 1) + (f"  {other}",) for other in others]]


def _processes(processes: Sequence[Mapping[str, Any]]) -> list[str]:
    rows = [
        (
            str(each.get("name", NOTHING)),
            _number(each.get("pid")),
            _number(each.get("cpu_cores"), "", 2),
            _number(each.get("memory_mib"), " MiB"),
        )
        for each in processes
    ]
    return ["", *_table(("process", "pid", "cores", "memory"), rows)] if rows else []


def _refused(refused: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Measurements that did not fit the body's motion, if there are any."""
    counts = ", ".join(f"{_number(n)} of {kind}" for kind, n in sorted(refused.items()))
    return [("refused", counts)] if counts else []


def _warnings(n_warnings: Mapping[str, Any]) -> list[str]:
    rows = [(str(what), _number(n)) for what, n in sorted(n_warnings.items())]
    return ["", *_table(("event", "times"), rows)] if rows else []


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    lines = [head, *(rows or [(NOTHING,) + ("",) * (len(head) - 1)])]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    ]


def _number(value: Any, unit: str = "", digits: int = 0) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}{unit}"


def _share(value: Any) -> str:
    return _number(_scaled(value, 100), " %")


def _scaled(value: Any, factor: float) -> Any:
    return None if value is None else value * factor
