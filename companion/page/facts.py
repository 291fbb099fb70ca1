"""Facts that the daemon hands to the page when it starts it: one line of JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from companion.config import Config
from companion.config_file import config_of_text, load_config


@dataclass(frozen=True, slots=True)
class Facts:
    """The daemon that this page belongs to, as it was started."""

    config: Config
    """Configuration with which it began."""
    path: Path | None
    """Its file of settings; None where it was started without one."""
    overrides: tuple[str, ...]
    """Values given on the command line, as `--set` has them; they go over the file."""
    socket: Path
    """Its status socket."""
    supervised: bool
    """True where a service manager starts it again."""

    @classmethod
    def of_line(cls, line: bytes | str) -> Facts:
        """Facts of the line that the daemon writes."""
        told = json.loads(line)
        return cls(
            config=config_of_text(told["config"], "the daemon", lambda _: None),
            path=Path(told["path"]) if told["path"] is not None else None,
            overrides=tuple(told["overrides"]),
            socket=Path(told["socket"]),
            supervised=bool(told["supervised"]),
        )

    def configured(self) -> Config:
        """Configuration of the file as it is now, with what goes over it; ConfigError."""
        return load_config(self.path, self.overrides, lambda _: None)

    def arguments(self) -> list[str]:
        """Arguments by which another command has configuration and socket of the daemon."""
        out = ["--config", str(self.path)] if self.path is not None else []
        for override in self.overrides:
            out += ["--set", override]
        return [*out, "--set", f"expert.daemon.socket={self.socket}"]

    @property
    def overridden(self) -> frozenset[str]:
        """Keys given on the command line."""
        return frozenset(each.partition("=")[0].strip() for each in self.overrides)
