"""Another companion on the same vehicle, whose messages an autopilot passes on to us.

Two that send poses would have an autopilot jump between two worlds. Who sends already goes on; no
other begins.
"""

from __future__ import annotations

import secrets
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

FORGOTTEN_NS = 3_000_000_000
"""Heartbeats come once a second, poses more often."""
POSES = (
    mavlink.MAVLINK_MSG_ID_ODOMETRY, mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE,
)  # fmt: skip


class OtherCompanion:
    """Ear for one: poses of another component, or a heartbeat as ours with another mark.

    `mark` is drawn by each process anew, and goes as the custom mode of the HEARTBEAT of a
    companion that may send poses: so one that hears its own heartbeat again does not fear itself.
    """

    def __init__(self) -> None:
        self.mark = 1 + secrets.randbelow(2**32 - 1)
        self._heard_ns: int | None = None
        self._since_disarming = False

    def take(self, message: Any, identity: tuple[int, int], now_ns: int) -> bool:
        """Take a message of any component; True if it is the first of another companion."""
        source = message.get_srcSystem(), message.get_srcComponent()
        kind = message.get_msgId()
        if source == identity:
            other = kind == mavlink.MAVLINK_MSG_ID_HEARTBEAT and message.custom_mode not in (
                0, self.mark
            )  # fmt: skip
        else:
            other = kind in POSES and source[0] == identity[0]
        if not other:
            return False
        news = not self._heard_lately(now_ns)
        self._heard_ns, self._since_disarming = now_ns, True
        return news

    def is_heard(self, now_ns: int, armed: bool) -> bool:
        """True while another may be sending poses.

        An autopilot that has flown on its poses must not get ours in the air, which are of another
        world: there it counts as heard until disarming.
        """
        if not armed:
            self._since_disarming = self._heard_lately(now_ns)
        return self._since_disarming

    def _heard_lately(self, now_ns: int) -> bool:
        return self._heard_ns is not None and now_ns - self._heard_ns < FORGOTTEN_NS
