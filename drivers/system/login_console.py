"""Login consoles on serial ports, which disturb the autopilot's link.

Found in the file system alone, without privileges: consoles of the kernel, getty services of
systemd, and nvgetty, which a Jetson runs on its header's port.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

WANTS = ("etc/systemd/system", "run/systemd/generator", "run/systemd/system")
GETTY = re.compile(r"(?:serial-)?getty@(tty(?:S|AMA|THS|USB|ACM|mxc)\d+)\.service$")
NVGETTY = "nvgetty.service"


@dataclass(frozen=True, slots=True)
class LoginConsole:
    """A login console on a serial port.

    `port` is as in /dev; on a Jetson it is ttyTHS* for nvgetty, which takes any of them.
    """

    port: str
    remedy: str

    @property
    def what(self) -> str:
        """Port and remedy, as a clause."""
        return f"a login console sits on /dev/{self.port}: {self.remedy}"


def login_consoles(root: Path = Path("/")) -> list[LoginConsole]:
    """All login consoles, by port."""
    found: dict[str, LoginConsole] = {}
    for name in _kernel_consoles(root):
        found[name] = LoginConsole(name, "remove its console= from the kernel's command line")
    for folder in WANTS:
        for unit in sorted((root / folder).glob("*.wants/*.service")):
            match = GETTY.match(unit.name)
            if match and not _masked(root, unit.name):
                found[match[1]] = _console(match[1], unit.name)
            if unit.name == NVGETTY and not _masked(root, NVGETTY):
                for port in sorted((root / "dev").glob("ttyTHS*")):
                    found[port.name] = _console(port.name, "nvgetty")
    return [found[name] for name in sorted(found)]


def login_console_on(device: str, root: Path = Path("/")) -> LoginConsole | None:
    """Login console on the port that a path leads to."""
    name = Path(os.path.realpath(device)).name
    return next((each for each in login_consoles(root) if each.port == name), None)


def _console(port: str, unit: str) -> LoginConsole:
    return LoginConsole(port, f"sudo systemctl disable --now {unit}, and restart the computer")


def _kernel_consoles(root: Path) -> list[str]:
    try:
        names = (root / "sys/class/tty/console/active").read_text("ascii").split()
    except OSError:
        return []
    return [name for name in names if name.startswith(("ttyS", "ttyAMA", "ttyTHS", "ttymxc"))]


def _masked(root: Path, unit: str) -> bool:
    return os.path.realpath(root / "etc/systemd/system" / unit) == "/dev/null"
