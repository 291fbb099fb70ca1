"""Health in words: one line for the journal, and when one is due."""

from __future__ import annotations

from collections.abc import Hashable

from companion.health import (
    FeedbackHealth,
    FlowHealth,
    Health,
    LandingHealth,
    SourceHealth,
    StageHealth,
)

MIN_BETWEEN_LINES_S = 1.0
"""Least interval of lines about changes."""


class StatusLines:
    """Schedule of status lines: at intervals, and at once after a change."""

    def __init__(self, every_s: float) -> None:
        self._every_ns = round(every_s * 1e9)
        self._key: Hashable = None
        self._last_ns: int | None = None

    def step(self, health: Health) -> str | None:
        """Line that is due now, or None; to be called several times a second."""
        since_ns = None if self._last_ns is None else health.t_ns - self._last_ns
        if since_ns is not None and since_ns < self._every_ns:
            if change_key(health) == self._key or since_ns < MIN_BETWEEN_LINES_S * 1e9:
                return None
        self._key, self._last_ns = change_key(health), health.t_ns
        return line_of(health)


def line_of(health: Health) -> str:
    """One line for the journal, the most important first."""
    flow, landing, place = health.flow, health.landing, health.global_position
    within = _in_brackets(place.detail) if place.sending else ""
    parts = [
        _pose(health), _feedback(health), _sent("flow", flow, flow.message),
        _sent("landing marker", landing, landing.marker),
        _sent("global position", place, place.mode) + within,
    ]  # fmt: skip
    parts += [_source(source) for source in health.sources]
    parts += [_stage(stage) for stage in health.stages if not stage.alive or stage.n_restarted]
    parts.append(_computer(health))
    if health.degraded:
        parts.append(f"reduced: {health.degraded}")
    parts.append(f"flight {health.flight}" if health.flight else "no flight")
    return "; ".join(part for part in parts if part)


def change_key(health: Health) -> Hashable:
    """A key that stays equal as long as nothing has changed that deserves a line at once."""
    return (
        health.tracker,
        bool(health.scale),
        tuple((source.name, source.state, source.n_reopened) for source in health.sources),
        tuple((stage.name, stage.alive, stage.n_restarted) for stage in health.stages),
        (health.feedback.mode, health.feedback.sending, health.feedback.why_not),
        (health.flow.message, health.flow.sending),
        (health.landing.marker, health.landing.sending),
        (health.global_position.mode, health.global_position.sending),
        health.flight,
        health.degradation,
    )


def _pose(health: Health) -> str:
    text = health.tracker
    if health.quality > 0:
        text += f", quality {health.quality}"
    if health.pose_latency_p95_ms is not None:
        text += f", {health.pose_latency_p95_ms:.0f} ms"
    return text + ("" if health.scale else ", no scale")


def _feedback(health: Health) -> str:
    feedback = health.feedback
    if feedback.mode == "off":
        return "feedback off"
    if feedback.sending:
        by = " by dead reckoning" if feedback.bridging else ""
        return f"feedback {feedback.rate_hz:.0f}/s{by}"
    return f"no feedback: {feedback.why_not or 'not yet'}" + _in_brackets(feedback.detail)


def _sent(name: str, given: FlowHealth | LandingHealth | FeedbackHealth, of: str) -> str:
    """Something else that is sent, unless it is off: that is what it is `of`."""
    if of == "off":
        return ""
    if given.sending:
        return f"{name} {given.rate_hz:.0f}/s"
    return f"no {name}: {given.why_not or 'not yet'}"


def _computer(health: Health) -> str:
    load = health.load
    parts = []
    if load.cpu_share is not None:
        parts.append(f"cpu {100 * load.cpu_share:.0f} %")
    if load.memory_share is not None:
        parts.append(f"memory {100 * load.memory_share:.0f} %")
    if load.temperature_c is not None:
        parts.append(f"{load.temperature_c:.0f} C")
    if load.disk_free_mib is not None:
        parts.append(f"disk {load.disk_free_mib / 1024:.1f} GiB free")
    return ", ".join(parts)


def _source(source: SourceHealth) -> str:
    text = f"{source.name} "
    if source.state == "running":
        text += f"{source.rate_hz:.0f}/s"
        if source.exposure_us is not None:
            text += f", exposed {1e-3 * source.exposure_us:.1f} ms"
            text += "" if source.gain is None else f", gain {source.gain}"
    elif source.state == "silent" and source.age_s is not None:
        text += f"silent for {source.age_s:.0f} s"
    else:
        text += source.state + _in_brackets(source.detail)
    return text + (f" ({source.n_dropped} dropped)" if source.n_dropped else "")


def _stage(stage: StageHealth) -> str:
    if not stage.alive:
        return f"{stage.name} down" + _in_brackets(stage.detail)
    return f"{stage.name} restarted {stage.n_restarted} x"


def _in_brackets(detail: str) -> str:
    return f" ({detail})" if detail else ""
