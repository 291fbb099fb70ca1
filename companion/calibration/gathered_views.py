"""Views of a board as images come, of a recording or of a live camera."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from companion.calibration.board_readout import TimedView
from companion.calibration.board_views import (
    Coverage,
    IlluminatedArea,
    View,
    coverage,
    novelty,
)
from companion.calibration.chart import Chart
from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.messages import Bytes

LIVE_NOVELTY, LIVE_GAIN = 0.05, 0.005
"""Least novelty, or gain of coverage, of a view of a live camera."""
N_UNFOUND_KEPT = 12
"""Images without the board that are kept, to detect another board on them."""
N_TIMED = 3000
"""Newest views of a live camera that are kept to measure its readout: some minutes, 3 MB."""


@dataclass(slots=True)
class GatheredViews:
    """Views of the board found so far."""

    chart: Chart
    views: list[View] = field(default_factory=list)
    lit: IlluminatedArea = field(default_factory=IlluminatedArea)
    size: tuple[int, int] = (0, 0)
    n_searched: int = 0
    n_found: int = 0
    n_blurred: int = 0
    n_small: int = 0
    unfound: list[Bytes] = field(default_factory=list)
    middles_px: list[tuple[int, Array]] = field(default_factory=list)
    """Number of each image with the board, and the board's middle in it."""
    timed: deque[TimedView] = field(default_factory=lambda: deque(maxlen=N_TIMED))
    """Views of a camera that stamps its images, also where they are no good for the lens."""

    def look(self, number: int, grey: Bytes, *, only_new: bool, t_ns: int | None = None) -> str:
        """Search an image for the board; "" when it gives a view, else the reason."""
        height, width = grey.shape
        if self.n_searched and self.size != (width, height):
            raise InputError(
                f"picture {number} is {width} x {height}, those before were {self.size[0]} x "
                f"{self.size[1]}: a calibration is for one size"
            )
        self.size = width, height
        self.n_searched += 1
        self.lit.see(grey)
        detection = self.chart.find(grey)
        if detection is None:
            self._keep_unfound(grey)
            return "the board is not to be seen"
        self.n_found += 1
        view = View(number, detection, width, height)
        self.middles_px.append((number, detection.image_px.mean(0)))
        if t_ns is not None:
            self.timed.append(TimedView(t_ns, view))
        if view.blurred:
            self.n_blurred += 1
            return "hold the board still"
        if view.small:
            self.n_small += 1
            return "bring the board nearer"
        if only_new and not self._is_new(view):
            return "move the board"
        self.views.append(view)
        return ""

    def covered(self) -> Coverage:
        """Coverage of the image by the views so far."""
        return coverage(self.views, self.lit.mask(*self.size))

    def _is_new(self, view: View) -> bool:
        if novelty(view, self.views) >= LIVE_NOVELTY:
            return True
        lit = self.lit.mask(*self.size)
        before, after = coverage(self.views, lit), coverage([*self.views, view], lit)
        return after.share >= before.share + LIVE_GAIN

    def _keep_unfound(self, grey: Bytes) -> None:
        if len(self.unfound) < N_UNFOUND_KEPT:
            self.unfound.append(grey)
        elif self.n_searched % 10 == 0:  # some of them from later on too
            self.unfound[(self.n_searched // 10) % N_UNFOUND_KEPT] = grey
