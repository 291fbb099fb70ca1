"""Virtual display for windows, without a graphics card, with screenshots.

with VirtualDisplay(folder) as display:
    subprocess.Popen(command, env=display.environment)
    display.picture()
"""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from pathlib import Path
from types import TracebackType

import numpy as np

from companion.messages import Bytes

SIZE = (1280, 800)
DRIVERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"))
XWD_HEAD = struct.Struct(">25I")
"""The head of an X window dump (X11/XWDFile.h), which the server's framebuffer begins with."""
XWD_COLOUR_BYTES = 12


def why_not() -> str:
    """Why there can be no window here; "" if there can."""
    if shutil.which("Xvfb") is None:
        return "Xvfb is not installed"
    if not any(driver for folder in DRIVERS for driver in folder.glob("lvp_icd*.json")):
        return "there is no Vulkan that draws without a graphics card (mesa-vulkan-drivers)"
    return ""


class VirtualDisplay:
    """An X server that keeps its picture, and its windows' settings, in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._server: subprocess.Popen[bytes] | None = None
        self.environment: dict[str, str] = {}
        """For programs that are to be seen on it."""

    def __enter__(self) -> VirtualDisplay:
        told, tells = os.pipe()
        # without Composite no window is transparent: what a driver without a card draws in one
        # is not seen
        self._server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(tells), "-screen", "0", f"{SIZE[0]}x{SIZE[1]}x24",
             "-nolisten", "tcp", "-extension", "Composite", "-fbdir", str(self._folder)],
            pass_fds=[tells], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(tells)
        with os.fdopen(told) as line:
            number = line.readline().strip()
        assert number, "Xvfb did not start"
        self.environment = {
            **os.environ, "DISPLAY": f":{number}", "HOME": str(self._folder),
            "XDG_DATA_HOME": str(self._folder), "XDG_RUNTIME_DIR": str(self._folder),
        }  # fmt: skip
        self.environment.pop("WAYLAND_DISPLAY", None)
        return self

    def picture(self) -> Bytes:
        """What is on the screen, (H, W, 3) RGB."""
        data = (self._folder / "Xvfb_screen0").read_bytes()
        head = XWD_HEAD.unpack_from(data)
        begin = head[0] + XWD_COLOUR_BYTES * head[19]
        width, height, line = head[4], head[5], head[12]
        rows = np.frombuffer(data, np.uint8, height * line, begin).reshape(height, line)
        return np.ascontiguousarray(rows[:, : 4 * width].reshape(height, width, 4)[..., 2::-1])

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        assert self._server is not None
        self._server.terminate()
        self._server.wait()
