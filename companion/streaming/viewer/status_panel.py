"""Status panel, in the pilot's words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

MEANINGS = {
    "Standing": "On the ground: the place is fixed until it lifts off.",
    "Tracking": "The camera knows where it is.",
    "Initialising": "Move sideways, so that the camera sees depth.",
    "Dead reckoning": "Nothing is recognised; the place follows from attitude and speed.",
    "Lost": "The camera does not know where it is. Go back to where it did.",
    "Waiting": "No pictures yet.",
}
HOT_C = 80.0


def status_text(facts: Mapping[str, Any], flight: str) -> str:
    """Markdown: the state as a headline, problems, other values.

    Unknown values are left out.
    """
    state = str(facts.get("state", "Waiting"))
    lines = [f"# {state}", MEANINGS.get(state, ""), ""]
    problems = [*_problems(facts), *map(str, facts.get("warnings") or ())]
    lines += [f"**⚠ {problem}**  " for problem in problems]
    lines += [""] if problems else []
    for label, text in _rows(facts):
        lines.append(f"**{label}** {text}  ")
    if flight:
        lines.append(f"**Flight** {flight}  ")
    return "\n".join(lines)


def _rows(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("Pose", _joined(
            _with(facts, "quality", "quality {:.0f} %"), _with(facts, "rate_hz", "{:.0f}/s"),
            _with(facts, "latency_ms", "{:.0f} ms late"),
        )),
        ("Flying", _joined(
            _with(facts, "height_m", "{:.1f} m above home"), _with(facts, "speed_m_s", "{:.1f} m/s")
        )),
        ("Scale", _scale(facts)),
        ("Map", _joined(
            _with(facts, "n_keyframes", "{:.0f} views"), _points(facts.get("n_points"))
        )),
        ("Autopilot", _autopilot(facts)),
        ("Computer", _joined(
            _with(facts, "cpu_share", "processor {:.0f} %", 100),
            _with(facts, "temperature_c", "{:.0f} °C"),
            _with(facts, "memory_share", "memory {:.0f} %", 100),
            _with(facts, "disk_free_gib", "{:.0f} GiB free on disk"),
        )),
        ("Link", _link(facts)),
    ]  # fmt: skip
    return [(label, text) for label, text in rows if text]


def _scale(facts: Mapping[str, Any]) -> str:
    if "scale" not in facts:
        return "not known yet: lengths are not metres"
    sigma = _with(facts, "sigma_scale", "± {:.1f} %", 100)
    return f"{_joined('metres', sigma, sep=' ')}, by {facts['scale']}"


def _autopilot(facts: Mapping[str, Any]) -> str:
    if "feedback" not in facts:
        return ""
    if facts.get("sending"):
        return "gets our pose"
    return _joined("gets no pose", str(facts.get("why_not", "")), sep=": ")


def _link(facts: Mapping[str, Any]) -> str:
    if "link_kbit_s" not in facts:
        return ""
    budget = facts.get("budget_kbit_s")
    skipped = sum((facts.get("skipped") or {}).values())
    given_up = sum((facts.get("given_up") or {}).values())
    return _joined(
        _with(facts, "link_kbit_s", "{:.0f} kbit/s") + (f" of {budget:.0f}" if budget else ""),
        _with(facts, "round_trip_ms", "{:.0f} ms there and back"),
        f"{facts['waiting']} pieces of the map to come" if facts.get("waiting") else "",
        f"{skipped} older poses and pictures passed over" if skipped else "",
        f"{given_up} pieces given up" if given_up else "",
    )


def _problems(facts: Mapping[str, Any]) -> list[str]:
    out = [str(each) for each in facts.get("gone") or ()]
    if facts.get("reduced"):
        out.append(f"reduced: {facts['reduced']}")
    if (facts.get("temperature_c") or 0.0) > HOT_C:
        out.append("the computer is hot")
    if facts.get("has_origin") is False:
        out.append("heights count from where the map began")
    return out


def _points(n: Any) -> str:
    if not isinstance(n, int):
        return ""
    return f"{n * 1e-6:.1f} million points" if n >= 1_000_000 else f"{n // 1000} thousand points"


def _with(facts: Mapping[str, Any], name: str, form: str, factor: float = 1.0) -> str:
    value = facts.get(name)
    return form.format(value * factor) if isinstance(value, (int, float)) else ""


def _joined(*parts: str, sep: str = ", ") -> str:
    return sep.join(part for part in parts if part)
