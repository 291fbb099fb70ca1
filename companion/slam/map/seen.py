"""View of a keyframe: its features and their refinement, in memory or read once they are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Features


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Features of an image, N of them.

    `normalised` (N, 2) and `whitening` (N, 2, 2) are as those of the features, refined where patch
    alignment succeeded.
    """

    features: Features
    normalised: Array
    whitening: Array

    def copied(self) -> Seen:
        """The same, to be refined apart."""
        return Seen(self.features, self.normalised.copy(), self.whitening.copy())


class SeenLater:
    """The same of a keyframe that nothing changes: `read` is called when it is first used."""

    def __init__(self, read: Callable[[], Seen]) -> None:
        self._read = read
        self._seen: Seen | None = None

    @property
    def features(self) -> Features:
        """Features as they were found."""
        return self._now().features

    @property
    def normalised(self) -> Array:
        """Refined coordinates (N, 2)."""
        return self._now().normalised

    @property
    def whitening(self) -> Array:
        """Their whitening (N, 2, 2)."""
        return self._now().whitening

    def _now(self) -> Seen:
        if self._seen is None:
            self._seen = self._read()
        return self._seen
