"""Autopilot parameters that prevent flight on our pose. Reads only: no link, no writing."""

from __future__ import annotations

from companion.config import FeedbackConfig, GpsConfig, LandingConfig
from companion.doctor.parameter_rules import COMPARED, EITHER_OF, RULES, Context, Rule, fused
from companion.doctor.wanted import ARDUPILOT, PX4, Finding, Values

NO_SWITCH, NO_MARKER = GpsConfig(), LandingConfig()


def names_to_read(firmware: str) -> list[str]:
    """Parameters read by this check."""
    return [*(rule.name for rule in RULES[firmware]), *COMPARED[firmware]]


def advise(
    firmware: str,
    values: Values,
    feedback: FeedbackConfig,
    mode: str,
    latency_ms: float | None = None,
    gps: GpsConfig = NO_SWITCH,
    landing: LandingConfig = NO_MARKER,
) -> list[Finding]:
    """Findings on the parameters of an autopilot for `mode`, in the order of the rules.

    `values` holds those of `names_to_read` that the autopilot has.
    """
    context = Context(feedback, mode, latency_ms, gps, landing)
    findings = []
    for rule in RULES[firmware]:
        value = values.get(rule.name)
        if value is None:
            if rule.lacking:
                findings.append(
                    Finding(rule.name, None, _wanted_text(rule, context, values), rule.lacking)
                )
            continue
        wanted = rule.wanted(context, values)
        if wanted is None or wanted.accepts(value):
            continue
        findings.append(
            Finding(
                rule.name, value, str(wanted), rule.why, wanted.corrected(value), rule.reboot
            )
        )  # fmt: skip
    if firmware == PX4 and not any(name in values for name in EITHER_OF[0]):
        findings.append(
            Finding(
                "EKF2_EV_CTRL", None, str(fused(context, values)),
                "this firmware was built without external vision in EKF2",
            )
        )  # fmt: skip
    if firmware == ARDUPILOT and latency_ms is None and "VISO_DELAY_MS" in values:
        findings.append(
            Finding(
                "VISO_DELAY_MS", values["VISO_DELAY_MS"], "the latency that is measured in flight",
                "`companion status` shows it; run doctor while the daemon runs to have it compared",
                blocking=False,
            )
        )  # fmt: skip
    return findings


def _wanted_text(rule: Rule, context: Context, values: Values) -> str:
    wanted = rule.wanted(context, values)
    return "" if wanted is None else str(wanted)
