"""Debian container that boots systemd, without a network.

    with Container(folder, "bookworm", ("python3.11",)) as container:
        container.boot()
        container.run("systemctl", "is-system-running")

It needs root, debootstrap and systemd-nspawn, and Debian's packages; `lacking` says what is not
there. The packages are had once and kept in `kept`, if that is given.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import time
import zlib
from pathlib import Path
from types import TracebackType

import psutil

ALWAYS = (
    "systemd", "systemd-sysv", "dbus", "libpam-systemd", "udev", "procps", "init-system-helpers",
)  # fmt: skip
TOOLS = {"debootstrap": "debootstrap", "systemd-nspawn": "systemd-container"}


def lacking() -> str:
    """What a container cannot do without, in words; "" where all is there."""
    if os.geteuid() != 0:
        return "needs root"
    packages = [package for tool, package in TOOLS.items() if shutil.which(tool) is None]
    return f"needs: apt install {' '.join(packages)}" if packages else ""


class Container:
    """See above. `mounts` are folders of this machine, read-only, by their places inside."""

    def __init__(
        self, folder: Path, suite: str, packages: tuple[str, ...], *,
        kept: Path | None = None, mounts: dict[str, Path] | None = None,
    ) -> None:  # fmt: skip
        self.root, self._log = folder / "root", folder / "console.log"
        self._mounts = mounts or {}
        self._process: subprocess.Popen[bytes] | None = None
        packages = tuple(sorted({*ALWAYS, *packages}))
        base = (
            self.root
            if kept is None
            else kept / f"{suite}-{zlib.crc32(repr(packages).encode()):08x}"
        )
        if not base.exists():
            partial = base.with_name(base.name + ".partial")
            shutil.rmtree(partial, ignore_errors=True)
            partial.parent.mkdir(parents=True, exist_ok=True)
            subprocess.run(
                ["debootstrap", "--variant=minbase", f"--include={','.join(packages)}", suite,
                 str(partial)], check=True, stdout=subprocess.DEVNULL,
            )  # fmt: skip
            partial.rename(base)
        if base != self.root:
            subprocess.run(["cp", "-a", str(base), str(self.root)], check=True)

    def __enter__(self) -> Container:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        if self._process is not None:
            for child in psutil.Process(self._process.pid).children():
                child.kill()  # its first process, and with it all others
            self._process.wait()
        shutil.rmtree(self.root, ignore_errors=True)

    def install(self, package: Path) -> str:
        """Install a .deb before the first boot, as an image is made; what dpkg said."""
        shutil.copy(package, self.root / "srv")
        done = subprocess.run(
            ["chroot", str(self.root), "dpkg", "-i", f"/srv/{package.name}"],
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        return done.stdout

    def boot(self, timeout_s: float = 120) -> None:
        """Boot, and wait until commands can be given."""
        mounts = [f"--bind-ro={here}:{there}" for there, here in self._mounts.items()]
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                ["systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--private-network",
                 *mounts, "-D", str(self.root), "-b"],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip
        until_s = time.monotonic() + timeout_s
        while not self._answers():
            assert self._process.poll() is None, self._log.read_text(errors="replace")[-2000:]
            assert time.monotonic() < until_s, "it does not boot"
            time.sleep(0.5)

    def run(self, *command: str, check: bool = True, timeout_s: float = 300) -> str:
        """Have a command done inside; what it printed, errors too."""
        done = subprocess.run(
            ["nsenter", "--target", str(self._first_process()), "--all", *command],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=timeout_s,
        )  # fmt: skip
        assert not check or done.returncode == 0, f"{command}: {done.returncode}: {done.stdout}"
        return done.stdout

    def reboot(self) -> None:
        """As its owner would, and wait until it is there again."""
        assert self._process is not None
        self.run("systemctl", "reboot", check=False)
        self._process.wait(120)  # which, kept in our unit, leaves the second boot to us
        self.boot()

    def _answers(self) -> bool:
        try:
            said = self.run("systemctl", "is-system-running", check=False)
        except (AssertionError, subprocess.TimeoutExpired):
            return False
        return said.strip() in ("running", "degraded", "starting")

    def _first_process(self) -> int:
        assert self._process is not None, "not booted"
        children = psutil.Process(self._process.pid).children()
        assert children, "it has no process yet, or none any more"
        return int(children[0].pid)
