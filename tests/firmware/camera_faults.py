"""Faults of the drawn camera, by lines such as `freeze 3`, each for some seconds; several at once.

freeze S          no new pictures, the connection stays
repeat S          the same picture again and again, with new stamps
gone S            the connection is closed, and new ones are refused
black S           darkness, but for the sensor's noise
sun S             blinded: white, with glare
drop SHARE S      a share of pictures that never leave it
latency MS S      pictures are handed over so long after their exposure
exposure S        brightness steps by a factor of two every half second
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from companion.messages import Bytes

PLAIN = frozenset({"freeze", "repeat", "gone", "black", "sun", "exposure"})
VALUED = {"drop": (0.0, 1.0), "latency": (0.0, 5000.0)}
"""Faults with a value before the time, and its bounds."""
STEP_S = 0.5
DARK_NOISE = 2.0
"""Grey levels; half of it falls below black."""
SUN_WIDTH = 0.4
"""Radius of the glare's middle as a share of the picture's width."""


@dataclass(frozen=True, slots=True)
class Order:
    """One fault for some time."""

    fault: str
    seconds: float
    value: float = 0.0


def parse(line: str) -> Order:
    """The order of a line; ValueError where it is none."""
    word, *rest = line.split() or [""]
    if word not in PLAIN and word not in VALUED:
        raise ValueError(
            f"{word!r} is no fault; there are {', '.join(sorted(PLAIN | set(VALUED)))}"
        )
    wanted = 2 if word in VALUED else 1
    try:
        *values, seconds = (float(each) for each in rest)
    except ValueError:
        raise ValueError(f"{line.strip()!r}: wanted {wanted} numbers after {word}") from None
    if len(values) + 1 != wanted:
        raise ValueError(f"{line.strip()!r}: wanted {wanted} numbers after {word}")
    if not 0 <= seconds < 1e6:
        raise ValueError(f"{line.strip()!r}: it cannot last for {seconds:g} s")
    if not values:
        return Order(word, seconds)
    low, high = VALUED[word]
    if not low <= values[0] <= high:
        raise ValueError(f"{line.strip()!r}: wanted {low:g} to {high:g} after {word}")
    return Order(word, seconds, values[0])


class Faults:
    """Faults in force. Times are those of one clock, whichever; orders may come from any thread."""

    def __init__(self) -> None:
        self._until_s: dict[str, tuple[float, float]] = {}

    def take(self, order: Order, now_s: float) -> None:
        """Begin a fault, or set another end for it."""
        self._until_s[order.fault] = now_s + order.seconds, order.value

    def holds(self, fault: str, now_s: float) -> bool:
        """True while it is in force."""
        return now_s < self._until_s.get(fault, (0.0, 0.0))[0]

    def value(self, fault: str, now_s: float, otherwise: float) -> float:
        """Value of a fault while it is in force."""
        end_s, value = self._until_s.get(fault, (0.0, 0.0))
        return value if now_s < end_s else otherwise

    def seen(self, picture: Bytes, now_s: float) -> Bytes:
        """The picture as the blinded or misled camera has it."""
        if self.holds("exposure", now_s) and int(now_s / STEP_S) % 2:
            picture = np.asarray(cv2.convertScaleAbs(picture, alpha=0.5), np.uint8)
        if self.holds("sun", now_s):
            picture = np.asarray(cv2.add(picture // 4, _glare(picture)), np.uint8)
        if self.holds("black", now_s):
            picture = np.empty_like(picture)
            cv2.randn(picture, np.zeros(3), np.full(3, DARK_NOISE))
        return picture


def _glare(picture: Bytes) -> Bytes:
    """White in a wide disc above the middle, and nearly so elsewhere."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width]
    far = np.hypot(x - 0.55 * width, y - 0.3 * height) / (SUN_WIDTH * width)
    grey = np.clip(300.0 - 60.0 * far, 200, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2)
