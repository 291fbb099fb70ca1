"""Which parameters keep an autopilot from flying on our pose. Looks only: no link, no writing."""

from __future__ import annotations

from companion.advice.firmware_rules import COMPARED, EITHER_OF, RULES, Asked, Rule, fused
from companion.advice.wanted import ARDUPILOT, PX4, Finding, Values
from companion.config import FeedbackConfig


def names_to_read(firmware: str) -> list[str]:
    """The parameters that this looks at."""
    return [*(rule.name for rule in RULES[firmware]), *COMPARED[firmware]]


def advise(
    firmware: str,
    values: Values,
    feedback: FeedbackConfig,
    mode: str,
    latency_ms: float | None = None,
) -> list[Finding]:
    """What of an autopilot's parameters stands in the way of `mode`, in the order of the table.

    `values` holds what the autopilot has of `names_to_read`.
    """
    asked = Asked(feedback, mode, latency_ms)
    findings = []
    for rule in RULES[firmware]:
        value = values.get(rule.name)
        if value is None:
            if rule.lacking:
                findings.append(Finding(rule.name, None, _text(rule, asked, values), rule.lacking))
            continue
        wanted = rule.wanted(asked, values)
        if wanted is None or wanted.met_by(value):
            continue
        findings.append(
            Finding(
                rule.name, value, str(wanted), rule.why, wanted.repaired(value), rule.reboot
            )
        )  # fmt: skip
    if firmware == PX4 and not any(name in values for name in EITHER_OF[0]):
        findings.append(
            Finding(
                "EKF2_EV_CTRL", None, str(fused(asked, values)),
                "this firmware was built without external vision in EKF2",
            )
        )  # fmt: skip
    if firmware == ARDUPILOT and latency_ms is None and "VISO_DELAY_MS" in values:
        findings.append(
            Finding(
                "VISO_DELAY_MS", values["VISO_DELAY_MS"], "the latency that is measured in flight",
                "`companion status` shows it; run doctor while the daemon runs to have it compared",
                in_the_way=False,
            )
        )  # fmt: skip
    return findings


def _text(rule: Rule, asked: Asked, values: Values) -> str:
    wanted = rule.wanted(asked, values)
    return "" if wanted is None else str(wanted)
