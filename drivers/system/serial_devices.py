"""Serial ports of this machine that may have an autopilot."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

from drivers.system.login_console import login_consoles

BY_ID = Path("/dev/serial/by-id")
JETSON = "ttyTHS*"
"""Serial ports of a Jetson, which pyserial does not list."""


@dataclass(frozen=True, slots=True)
class SerialDevice:
    """A port; `stable_path` survives replugging, "" without one."""

    path: str
    stable_path: str = ""
    name: str = ""
    usb_id: str = ""
    """Vendor and product in hexadecimal."""
    serial_number: str = ""
    problem: str = ""
    """Other user of the port, and the remedy."""


def serial_devices() -> list[SerialDevice]:
    """All ports with hardware behind them."""
    links = {os.path.realpath(link): str(link) for link in sorted(BY_ID.glob("*"))}
    consoles = {f"/dev/{console.port}": console.what for console in login_consoles()}
    found = [
        SerialDevice(
            port.device,
            links.get(os.path.realpath(port.device), ""),
            "" if port.description in (None, "n/a") else port.description,
            "" if port.vid is None else f"{port.vid:04x}:{port.pid:04x}",
            port.serial_number or "",
            consoles.get(port.device, ""),
        )
        for port in list_ports.comports()
    ]
    listed = {device.path for device in found}
    found += [
        SerialDevice(str(path), problem=consoles.get(str(path), ""))
        for path in Path("/dev").glob(JETSON)
        if str(path) not in listed
    ]
    return sorted(found, key=lambda device: device.path)
