"""Configuration in force: as read, as changed from the ground, and as held while armed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.config.setting_keys import value_of_key, with_values
from companion.daemon.control.armed_settings import FILE, Resumed, read_settings
from companion.daemon.control.arming import Arming
from companion.daemon.control.kept_settings import kept_over
from companion.daemon.control.reload import reloaded
from companion.daemon.control.tightening import tightened
from companion.errors import CompanionError
from companion.pilot_messages import (
    LIMITS_WAIT,
    POSITION_ENABLED,
    POSITION_STAYS_OFF,
    PilotText,
)
from companion.products.newest_file import NewestFile
from companion.timing.clock import monotonic_s
from drivers.system.journal import ERROR, INFO, WARNING, Journal


class SettingsInForce:
    """Configuration in force. While armed it only tightens; the rest waits for disarming.

    Used in the event loop. `load` reads the configuration; CompanionError where it cannot be.
    `boot_s` and `heard` as in `Arming`. `not_kept` takes, in any thread, the reason why the
    settings could not be written; `applied` the old and the new configuration.
    """

    def __init__(
        self, load: Callable[[], Config], boot_s: Callable[[], float | None],
        heard: Callable[[], bool], journal: Journal, tell_pilot: Callable[[PilotText], None],
        not_kept: Callable[[str], None], applied: Callable[[Config, Config], None],
    ) -> None:  # fmt: skip
        self._load, self._journal = load, journal
        self._tell_pilot, self._applied = tell_pilot, applied
        read, self.by_ground = kept_over(load)
        flights = Path(read.daemon.flights)
        before, unreadable = read_settings(flights, read) if read.link.url else (None, "")
        self._file = NewestFile(flights / FILE, not_kept)
        self._arming = Arming(self._file, before, boot_s, heard)
        resumed = self._arming.resume(read)
        self.config = resumed.config
        self.by_ground |= resumed.by_ground
        """Values set from the ground, by key; changed in place."""
        self._stays_off = resumed.by_ground.get("feedback.mode") == "off"
        """True until the pilot was told, over the open link, that poses stay off."""
        self._resumed = "" if before is None else _resumed_text(resumed, unreadable)

    def say_resumed(self) -> None:
        """Report what a daemon that ended while armed has left, if one has."""
        if self._resumed:
            self._journal.say(self._resumed, WARNING)

    @property
    def armed(self) -> bool:
        """True while the motors are armed; the last known state while the autopilot is silent."""
        return self._arming.armed

    def set_armed(self, armed: bool) -> None:
        """Take a report of the autopilot."""
        if self._arming.take(armed, monotonic_s()):
            self._let_go()
        if armed:
            self._hold()
            if self._stays_off:
                self._tell_pilot(POSITION_STAYS_OFF())
        self._stays_off = False

    def step(self) -> None:
        """Apply the changes that were held once disarming is certain; to be called repeatedly."""
        if self._arming.step(monotonic_s()):
            self._let_go()

    def close(self, seconds: float) -> None:
        """Wait at most so long until all is written."""
        self._file.close(seconds)

    def take_over(self, config: Config) -> None:
        """Continue with another configuration."""
        old, self.config = self.config, config
        if self._arming.holds:
            for name in list(self._arming.waiting):
                if value_of_key(config, name) != value_of_key(old, name):
                    del self._arming.waiting[name]  # set since: the later value counts
            if config.feedback.mode == "off" != old.feedback.mode and not config.control.keep:
                self._arming.waiting["feedback.mode"] = old.feedback.mode
            self._hold()
        self._applied(old, config)

    def reload(self) -> None:
        """Read again: apply what can change while running, and report what cannot."""
        try:
            read, kept = kept_over(self._load)
        except CompanionError as error:
            self._journal.say(f"configuration not taken over: {error}", ERROR)
            return
        config, cannot = reloaded(self.config, read)
        waiting: dict[str, Any] = {}
        if self.armed or self._arming.holds:
            config, waiting = tightened(self.config, config)
        stays = {*cannot, *waiting}
        kept |= {name: value for name, value in self.by_ground.items() if name in stays}
        self.by_ground.clear()
        self.by_ground.update(kept)
        self.take_over(config)
        if "feedback.mode" in self._arming.waiting and read.feedback.mode != "off":
            waiting["feedback.mode"] = read.feedback.mode
        self._arming.waiting = waiting
        text = f"; these need a restart: {', '.join(cannot)}" if cannot else ""
        if set(waiting) - {"feedback.mode"}:
            text += f"; these are looser and wait for disarming: {', '.join(waiting)}"
            self._tell_pilot(LIMITS_WAIT())
        self._journal.say(f"configuration read again{text}", WARNING if stays else INFO)

    def _hold(self) -> None:
        """Keep the settings in force for a restart in the air."""
        self._arming.hold(self.config, self.by_ground, monotonic_s())

    def _let_go(self) -> None:
        """Disarmed: apply the changes that were held."""
        waiting = {
            name: value
            for name, value in self._arming.let_go().items()
            if value != value_of_key(self.config, name)
        }
        if not waiting:
            return
        for name in waiting:
            self.by_ground.pop(name, None)
        shown = ", ".join(f"{name} = {value}" for name, value in waiting.items())
        self._journal.say(f"disarmed: held changes take effect: {shown}", WARNING)
        if waiting.get("feedback.mode", "off") != "off":
            self._tell_pilot(POSITION_ENABLED())
        self.take_over(with_values(self.config, waiting))


def _resumed_text(resumed: Resumed, unreadable: str) -> str:
    text = "the daemon before ended while armed; until disarmed what counted then counts"
    if unreadable:
        text += f", which cannot be read, so that no pose is sent ({unreadable})"
    else:
        text += "".join(f"; {k} = {v} (by the ground)" for k, v in resumed.by_ground.items())
    if resumed.waiting:
        text += f"; these wait for disarming: {', '.join(resumed.waiting)}"
    return text
