"""What `reset_counter` an autopilot is sent, also by a program that was started again in the air.

An autopilot compares the counter of each pose with that of the one before. So it is counted for
each boot of the autopilot: 0 with the first pose that this boot is ever sent, and one more at each
discontinuity after that, the start of another process among them. What was sent is kept by
`BootIdentity`; `companion.daemon.pose.kept_counter` has it on the disk.
"""

from __future__ import annotations

from dataclasses import dataclass

BACK_S = 2.0
"""An autopilot's own time that goes back by more has begun anew; less is a clock put right."""
TOLERANCE_S, DRIFT = 10.0, 0.02
"""Two estimates of when an autopilot was switched on agree within this, and this share of the time
between them: more than a link that gives out what had piled up makes of it at first, less than any
autopilot has run when it gets its first pose; and `timing.link_clock.PRIOR_DRIFT`."""
WALL_TOLERANCE_S = 600.0
"""The same by the date, which is all there is where this computer was switched on anew as well. One
without a battery clock takes up the date at which it was switched off: it lags by the time that
took, some ten seconds; clocks that were set by hand or by a network are not better than this."""


@dataclass(frozen=True, slots=True)
class BootIdentity:
    """One boot of one autopilot, as seen from this computer at some time."""

    system_id: int
    autopilot_s: float
    """The autopilot's time since boot when this was noted."""
    monotonic_s: float
    """This computer's monotonic clock when the autopilot's stood at 0."""
    unix_s: float
    """The date by this computer's clock when the autopilot's stood at 0."""
    computer: str
    """Names this computer's own boot, within which its monotonic clock counts; "" if not known."""


def same_boot(before: BootIdentity, now: BootIdentity) -> bool:
    """Whether an autopilot has not been switched on anew since `before` was noted.

    Where that cannot be told, it has not: to count on is safe, to begin at 0 again may hide a jump.
    """
    passed_s = now.autopilot_s - before.autopilot_s
    if now.system_id != before.system_id or passed_s < -BACK_S:
        return False
    if before.computer and before.computer == now.computer:
        apart_s, allowed_s = now.monotonic_s - before.monotonic_s, TOLERANCE_S
    else:
        apart_s, allowed_s = now.unix_s - before.unix_s, WALL_TOLERANCE_S
    return abs(apart_s) <= allowed_s + DRIFT * abs(passed_s)


class ResetCounter:
    """The counter for the autopilot's present boot; 0 and nothing sent to begin with."""

    def __init__(self) -> None:
        self.value = 0
        """Of the next pose; on the wire its lowest eight bits."""
        self.sent = False
        """Whether this boot has been sent a pose, or may have been."""

    def discontinuity(self) -> None:
        """Poses will not go on from where the last one was."""
        if self.sent:
            self.value += 1

    def booted(self, last_sent: int | None) -> None:
        """The autopilot's boot has become known, or is another: what it was last sent, if at all.

        What comes is not tied to what that was.
        """
        self.sent = last_sent is not None
        self.value = 0 if last_sent is None else last_sent + 1


def unlike_any(unix_s: float) -> int:
    """A counter to begin with where nobody knows what was sent: 1 to 255, another each second.

    It is unlike the one before in 254 of 255 cases. Never 0, which says that nothing came before.
    """
    return 1 + int(unix_s) % 255
