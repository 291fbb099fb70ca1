"""Accelerations that are integrated only while the verdict on the IMU allows it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.imu_verdict import ImuVerdict
from companion.geometry.transforms import Array
from companion.messages import Georeference, Warned
from companion.telemetry import AttitudeSample, ImuSample

BY_ACCELERATION = "accelerometers"
"""In the words for where a scale comes from."""
MAX_NOTED = 200
"""Georeferences that can be taken back: those of twenty seconds and more."""


class ByAcceleration:
    """Georeferences that accelerometers had a part in, and what was known before each."""

    def __init__(self) -> None:
        self._noted: deque[tuple[int, int, Georeference | None]] = deque(maxlen=MAX_NOTED)

    def note(
        self, t_ns: int, key: int, known: dict[int, Georeference], found: Georeference
    ) -> None:
        """Note what is `known` by `key` before it gives way to what was found."""
        if BY_ACCELERATION in found.method:
            self._noted.append((t_ns, key, known.get(key)))

    def withdraw(self, since_ns: int, known: dict[int, Georeference]) -> None:
        """Restore in `known` what was there before a time; drop it, where that is not known."""
        full = len(self._noted) == MAX_NOTED
        while self._noted and self._noted[-1][0] >= since_ns:
            _, key, before = self._noted.pop()
            known.pop(key, None)
            if before is not None:
                known[key] = before
        if full and not self._noted:
            for key in [k for k, each in known.items() if BY_ACCELERATION in each.method]:
                del known[key]


class JudgedAcceleration:
    """Passes samples on to integrals; what the verdict does not allow is a gap there.

    `withdraw` is called with the time since which accelerations were wrong, after the integrals
    have dropped them.
    """

    def __init__(
        self, integrals: Sequence[AccelerationIntegral], withdraw: Callable[[int], None]
    ) -> None:
        self._integrals, self._withdraw = integrals, withdraw
        self._verdict = ImuVerdict()
        self._warnings: list[Warned] = []
        self._believe(False)

    def take(self, sample: AttitudeSample | ImuSample) -> None:
        """Add a sample; samples of a kind come in order of time."""
        if isinstance(sample, AttitudeSample) or not self._verdict.fault:
            for each in self._integrals:
                each.take(sample)
        change = self._verdict.take(sample)
        if change is not None:
            self._warnings.append(change.warning)
            if change.invalid_since_ns is not None:
                for each in self._integrals:
                    each.withdraw(change.invalid_since_ns)
                self._withdraw(change.invalid_since_ns)
        # what is left in the integrals after a fault was found right before
        self._believe(self._verdict.believed or bool(self._verdict.fault))

    def prune(self, before_ns: int, keyframes_ns: Array) -> None:
        """Drop integrals before a time, except at the times of keyframes (N,), sorted."""
        for each in self._integrals:
            each.prune(before_ns, keyframes_ns)

    def _believe(self, believed: bool) -> None:
        for each in self._integrals:
            each.believed = believed

    def warnings(self) -> list[Warned]:
        """Changes of the verdict since the last call."""
        out, self._warnings = self._warnings, []
        return out
