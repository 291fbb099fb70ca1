"""What a value must be, and what is said of one that is not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

Values = Mapping[str, float]
"""An autopilot's parameters, as far as they were read."""
ARDUPILOT, PX4 = "ardupilot", "px4"
FIRMWARES = (ARDUPILOT, PX4)


@dataclass(frozen=True, slots=True)
class Finding:
    """One parameter and what is said of it; `in_the_way`, or only to be known.

    `value` is None where the firmware has no such parameter, `set_to` where nothing can be set.
    """

    name: str
    value: float | None
    wanted: str
    why: str
    set_to: float | None = None
    reboot: bool = False
    in_the_way: bool = True


class Wanted(Protocol):
    """What a value must be."""

    def met_by(self, value: float) -> bool:
        """Whether a value will do."""

    def repaired(self, value: float) -> float:
        """The nearest that will do."""


@dataclass(frozen=True, slots=True)
class Among:
    """One of these; the first is the best."""

    values: tuple[float, ...]

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return any(abs(value - each) < 1e-6 for each in self.values)

    def repaired(self, value: float) -> float:
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

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return self.least - 1e-6 <= value <= self.most + 1e-6

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return min(max(value, self.least), self.most)

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class Bits:
    """All of these bits, whatever the others are."""

    mask: int
    words: str

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return int(value) & self.mask == self.mask

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return int(value) | self.mask

    def __str__(self) -> str:
        return f"bits {self.words}"


@dataclass(frozen=True, slots=True)
class Near:
    """A value, as nearly as matters."""

    value: float
    tolerance: float

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return abs(value - self.value) <= self.tolerance

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return self.value

    def __str__(self) -> str:
        return f"{self.value:g}"
