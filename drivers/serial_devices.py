"""The serial ports of this machine on which an autopilot may be."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

BY_ID = Path("/dev/serial/by-id")


@dataclass(frozen=True, slots=True)
class SerialDevice:
    """A port; `stable_path` stays the same when it is plugged in anew, "" where there is none."""

    path: str
    stable_path: str = ""
    name: str = ""
    usb_id: str = ""
    """Vendor and product in hexadecimal."""
    serial_number: str = ""


def serial_devices() -> list[SerialDevice]:
    """All ports that have hardware behind them."""
    links = {os.path.realpath(link): str(link) for link in sorted(BY_ID.glob("*"))}
    return [
        SerialDevice(
            port.device,
            links.get(os.path.realpath(port.device), ""),
            "" if port.description in (None, "n/a") else port.description,
            "" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            port.serial_number or "",
        )
        for port in sorted(list_ports.comports(), key=lambda port: str(port.device))
    ]
