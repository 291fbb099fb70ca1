"""The service on a booted Debian: that of the computer, or of one of its users."""

from __future__ import annotations

import json
import time
from typing import Any

from tests.support.processes.container import Container
from tests.support.waiting import until


class BootedService:
    """What systemd and the daemon say of it; `user` is whose it is, None for the computer's."""

    def __init__(self, container: Container, user: str | None = None) -> None:
        self._container, self._user = container, user

    def run(self, *command: str, check: bool = True) -> str:
        """Have a command done inside by whom it belongs to; what it printed."""
        if self._user is None:
            return self._container.run(*command, check=check)
        number = self._container.run("id", "--user", self._user).strip()
        environment = [f"HOME=/home/{self._user}", f"XDG_RUNTIME_DIR=/run/user/{number}"]
        return self._container.run(
            "runuser", "--user", self._user, "--", "env", "--chdir=/", *environment, *command,
            check=check,
        )  # fmt: skip

    def systemctl(self, *words: str, check: bool = True) -> str:
        """Have its manager asked something."""
        return self.run("systemctl", *(["--user"] if self._user else []), *words, check=check)

    def shown(self, name: str) -> str:
        """A property of its unit."""
        return self.systemctl("show", "companion", "--property", name, "--value").strip()

    def status(self) -> dict[str, Any]:
        """What `companion status --json` says; empty where it does not answer."""
        said = self.run("companion", "status", "--json", check=False)
        document: dict[str, Any] = json.loads(said) if said.startswith("{") else {}
        return document

    def until_flying(self, timeout_s: float = 420) -> dict[str, Any]:
        """Its status once it is active, tracks, and has camera and autopilot."""
        found: dict[str, Any] = {}

        def flies() -> bool:
            found.update(self.status())
            sources = [source["state"] == "running" for source in found.get("sources", ())]
            active = self.shown("ActiveState") == "active"
            return (
                active and all(sources) and found.get("tracker") in ("tracking", "dead reckoning")
            )

        try:
            until(flies, "a running service that tracks", timeout_s)
        except AssertionError:
            told(self._container.run("journalctl", "--no-pager", "--lines=60"))
            raise
        told("flies:", found["flight"], found["line"] if "line" in found else "")
        return found


def told(*words: object) -> None:
    """Say how far it is, for whoever waits."""
    print(time.strftime("%H:%M:%S"), *words, flush=True)
