"""`reset_counter` of poses sent to an autopilot, consistent over restarts of this program.

An autopilot compares the counter of successive poses. It is therefore counted per boot of the
autopilot: 0 with the first pose sent to that boot, and one more at each discontinuity, restarts of
this process included. `BootIdentity` identifies the boot; `companion.daemon.pose.kept_counter`
stores what was sent.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_BACKWARD_S = 2.0
"""A larger step back of autopilot time is a reboot; a smaller one a clock correction."""
TOLERANCE_S, DRIFT = 10.0, 0.02
"""Tolerance of two estimates of the boot time, and ratio of the time between them: more than a link
error from buffered messages, less than any autopilot has run before its first pose; and
`timing.link_clock.PRIOR_DRIFT`."""
WALL_TOLERANCE_S = 600.0
"""The same by the date, used where this computer rebooted as well. One without a battery-backed
clock resumes the date of shutdown and lags by the time in between, some ten seconds; clocks set by
hand or network are no better than this."""


@dataclass(frozen=True, slots=True)
class BootIdentity:
    """One boot of one autopilot, as observed from this computer."""

    system_id: int
    autopilot_s: float
    """The autopilot's time since boot at observation."""
    monotonic_s: float
    """This computer's monotonic clock at boot of the autopilot."""
    unix_s: float
    """The date by this computer's clock at boot of the autopilot."""
    computer: str
    """Boot id of this computer, within which its monotonic clock is valid; "" if unknown."""


def same_boot(before: BootIdentity, now: BootIdentity) -> bool:
    """True if an autopilot has not rebooted since `before`.

    False where unknown: counting on is safe, restarting at 0 may hide a discontinuity.
    """
    passed_s = now.autopilot_s - before.autopilot_s
    if now.system_id != before.system_id or passed_s < -MAX_BACKWARD_S:
        return False
    if before.computer and before.computer == now.computer:
        apart_s, allowed_s = now.monotonic_s - before.monotonic_s, TOLERANCE_S
    else:
        apart_s, allowed_s = now.unix_s - before.unix_s, WALL_TOLERANCE_S
    return abs(apart_s) <= allowed_s + DRIFT * abs(passed_s)


class ResetCounter:
    """Counter for the present boot of the autopilot; initially 0 and nothing sent."""

    def __init__(self) -> None:
        self.value = 0
        """Counter of the next pose; its lowest eight bits are sent."""
        self.sent = False
        """True once a pose was sent in this boot, or may have been."""

    def discontinuity(self) -> None:
        """Count a discontinuity."""
        if self.sent:
            self.value += 1

    def booted(self, last_sent: int | None) -> None:
        """Set the counter for a new or newly known boot, from what it was last sent, if at all.

        Poses to come are discontinuous with those sent before.
        """
        self.sent = last_sent is not None
        self.value = 0 if last_sent is None else last_sent + 1


def initial_counter(unix_s: float) -> int:
    """Initial counter where what was sent is unknown: 1 to 255, different each second.

    It differs from the previous one in 254 of 255 cases. Never 0, which means that nothing was
    sent.
    """
    return 1 + int(unix_s) % 255
