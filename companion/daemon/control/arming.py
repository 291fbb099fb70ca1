"""Arming state, and changes held until the motors are disarmed.

A silent link disarms nobody, nor does an autopilot that reboots in the air and reports disarmed:
held changes stay held.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from companion.config import Config
from companion.daemon.control.armed_settings import (
    ArmedSettings,
    Resumed,
    computer_boot,
    encoded,
    resumed,
    settings_of,
)
from companion.products.newest_file import NewestFile

CERTAIN_S = 2.5
"""Time with the same clock after which a report of disarmed is believed: a ClockFilter detects
another clock a second after its first stamps."""
SAME_BOOT_S, SAME_BOOT_SHARE = 5.0, 0.02
"""Largest deviation of the autopilot's clock within one boot: link delays, and clock drift
(companion.timing.link_clock.PRIOR_DRIFT)."""


class Arming:
    """State of the motors, and the changes held until disarming. Used in the event loop.

    `before` is left by a daemon that ended while armed. `boot_s` is the boot time of the autopilot
    (CLOCK_MONOTONIC), None while unknown; `heard` is True while the autopilot is heard.
    """

    def __init__(
        self, file: NewestFile, before: ArmedSettings | None,
        boot_s: Callable[[], float | None], heard: Callable[[], bool],
    ) -> None:  # fmt: skip
        self._file, self._held, self._boot_s, self._heard = file, before, boot_s, heard
        self._said: bool | None = None
        self._disarmed_s: float | None = None
        self.waiting: dict[str, Any] = {}
        """Changes that wait for disarming, by key."""

    @property
    def armed(self) -> bool:
        """True while the motors are armed; before the first report, as of the previous process."""
        return self._held is not None if self._said is None else self._said

    @property
    def holds(self) -> bool:
        """True while changes are held back until disarming."""
        return self._held is not None

    def resume(self, read: Config) -> Resumed:
        """Initial configuration."""
        if self._held is None:
            return Resumed(read, {}, {})
        found = resumed(read, self._held)
        self.waiting = dict(found.waiting)
        return found

    def take(self, armed: bool, now_s: float) -> bool:
        """Take a report of the autopilot; True if held changes are to be applied before it.

        That is only so where the motors were disarmed and are armed again before that was certain.
        """
        again = armed and self._disarmed_s is not None and self._is_same_boot(now_s)
        if armed:
            self._disarmed_s = None
        elif self._said is not False:
            self._disarmed_s = now_s
        self._said = armed
        return again

    def step(self, now_s: float) -> bool:
        """True once disarming is certain: held changes may be applied."""
        held = self._held
        if held is None:
            return False
        if self._said and held.autopilot_boot_s is None and self._boot_s() is not None:
            self._put(replace(held, autopilot_boot_s=self._boot_s(), written_s=now_s))
        if self._disarmed_s is None or now_s - self._disarmed_s < CERTAIN_S or not self._heard():
            return False
        # after a reboot of the computer: the power was off, so that the vehicle was on the ground
        return held.computer_boot != computer_boot() or self._is_same_boot(now_s)

    def hold(self, config: Config, by_ground: Mapping[str, Any], now_s: float) -> None:
        """Keep the settings in force for a restart in the air; while armed, or as long as held."""
        settings = settings_of(config, by_ground, self._boot_s(), now_s)
        if not self._said and self._held is not None:  # it stays that of when they were armed
            settings = replace(self._held, values=settings.values, by_ground=settings.by_ground)
        self._put(settings)

    def let_go(self) -> dict[str, Any]:
        """Disarmed: end holding; returns the changes that were waiting."""
        waiting, self.waiting = self.waiting, {}
        self._held = self._disarmed_s = None
        self._file.put(None)
        return waiting

    def _put(self, settings: ArmedSettings) -> None:
        self._held = settings
        self._file.put(encoded(settings))

    def _is_same_boot(self, now_s: float) -> bool:
        """True if the autopilot has not rebooted since it was armed; False where unknown."""
        held, boot_s = self._held, self._boot_s()
        if held is None or held.autopilot_boot_s is None or boot_s is None:
            return False
        allowed_s = SAME_BOOT_S + SAME_BOOT_SHARE * abs(now_s - held.written_s)
        return abs(boot_s - held.autopilot_boot_s) < allowed_s
