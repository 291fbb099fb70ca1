"""Conditions on parameter values, and findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

Values = Mapping[str, float]
"""Parameters of an autopilot, as far as read."""
ARDUPILOT, PX4 = "ardupilot", "px4"
FIRMWARES = (ARDUPILOT, PX4)


@dataclass(frozen=True, slots=True)
class Finding:
    """A finding on one parameter; `blocking`, or for information.

    `value` is None where the firmware lacks the parameter, `set_to` where nothing can be set.
    """

    name: str
    value: float | None
    wanted: str
    why: str
    set_to: float | None = None
    reboot: bool = False
    blocking: bool = True


class Wanted(Protocol):
    """Condition on a value."""

    def accepts(self, value: float) -> bool:
        """True if a value of the parameter is acceptable."""

    def corrected(self, value: float) -> float:
        """The nearest acceptable value."""


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of these; the first is the best."""

    values: tuple[float, ...]

    def accepts(self, value: float) -> bool:
        """See `Wanted`."""
        return any(abs(value - each) < 1e-6 for each in self.values)

    def corrected(self, value: float) -> float:
        """See `Wanted`."""
        return self.values[0]

    def __str__(self) -> str:
        best, *others = (f"{each:g}" for each in self.values)
        return f"{best} (or {', '.join(others)})" if others else best


@dataclass(frozen=True, slots=True)
class Between:
    """From `least` to `most`."""

    least: float
    most: float

    def accepts(self, value: float) -> bool:
        """See `Wanted`."""
        return self.least - 1e-6 <= value <= self.most + 1e-6

    def corrected(self, value: float) -> float:
        """See `Wanted`."""
        return min(max(value, self.least), self.most)

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class Bits:
    """All of these bits set, others arbitrary."""

    mask: int
    words: str

    def accepts(self, value: float) -> bool:
        """See `Wanted`."""
        return int(value) & self.mask == self.mask

    def corrected(self, value: float) -> float:
        """See `Wanted`."""
        return int(value) | self.mask

    def __str__(self) -> str:
        return f"bits {self.words}"


@dataclass(frozen=True, slots=True)
class Near:
    """A value within a tolerance."""

    value: float
    tolerance: float

    def accepts(self, value: float) -> bool:
        """See `Wanted`."""
        return abs(value - self.value) <= self.tolerance

    def corrected(self, value: float) -> float:
        """See `Wanted`."""
        return self.value

    def __str__(self) -> str:
        return f"{self.value:g}"
