"""Exit condition: a camera or an autopilot that stays missing."""

from __future__ import annotations

from companion.health import Health


class MissingDevices:
    """Reports a camera or an autopilot missing for too long; never in the air."""

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._since_s: dict[str, float] = {}

    def step(self, health: Health, now_s: float, armed: bool) -> str:
        """Reason to end the daemon; "" without one."""
        for source in health.sources:
            there = source.state not in ("missing", "opening", "silent", "driver fault")
            if there or armed or not self._limit_s:
                self._since_s.pop(source.name, None)
                continue
            since_s = self._since_s.setdefault(source.name, now_s)
            if now_s - since_s > self._limit_s:
                detail = f" ({source.detail})" if source.detail else ""
                return (
                    f"the {source.name} has been {source.state} for {self._limit_s:g} s{detail}; "
                    "expert.daemon.missing_device_s says how long to wait"
                )
        return ""
