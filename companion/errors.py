"""Every error that the program raises on purpose.

CompanionError            one clear line for the user: what, where, what to do
├── InputError            what the user gave cannot be used; exit status 2
│   ├── ConfigError       an unknown key, a wrong type or value
│   ├── FlightError       a flight folder, video, calibration or log that cannot be read
│   └── DeviceError       no OpenCL device, or not the one asked for
├── SourceError           a camera or a link is not there, or has gone; it may come back
├── InstallError          the service cannot be set up or taken away on this computer
├── StreamError           what came over a link to a viewer or a node is not what companion sends
└── StageError            a stage failed on input that it should have handled; exit status 1
"""

from __future__ import annotations


class CompanionError(Exception):
    """Root of the tree; its text is one line fit for the user."""


class InputError(CompanionError):
    """Invalid input of the user."""


class ConfigError(InputError):
    """A configuration key or value is not valid."""


class FlightError(InputError):
    """A flight folder, its video, calibration or telemetry cannot be read."""


class DeviceError(InputError):
    """The OpenCL device asked for is not there or does not compute correctly.

    `detail` is what a driver or its compiler said of it, on as many lines as that took.
    """

    def __init__(self, text: str, detail: str = "") -> None:
        super().__init__(text)
        self.detail = detail


class SourceError(CompanionError):
    """A camera or an autopilot's link cannot be opened now, or has gone; it may come back."""


class InstallError(CompanionError):
    """The service cannot be set up or taken away on this computer."""


class StreamError(CompanionError):
    """Invalid data on the link to a viewer or a node."""


class StageError(CompanionError):
    """A stage failed on input that it should have handled."""
