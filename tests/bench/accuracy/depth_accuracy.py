"""Accuracy of depth maps against ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

RIM_PX = 20
"""Border pixels that are ignored."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Shares 0..1: pixels estimated, of those with truth; and of these within 1, 2 and 5 %.

    `median` is the median relative error. All but `estimated` are nan where nothing is estimated.
    """

    estimated: float
    within_1: float
    within_2: float
    within_5: float
    median: float


def accuracy(depth: Floats, truth: Floats, counted: NDArray[np.bool_]) -> Accuracy:
    """Accuracy of depths (H, W) where `counted`, without the border; truth 0 is unknown."""
    known = truth > 0
    known[:RIM_PX] = known[-RIM_PX:] = False
    known[:, :RIM_PX] = known[:, -RIM_PX:] = False
    estimated = known & counted & (depth > 0)
    if not estimated.any():
        nan = float("nan")
        return Accuracy(0.0, nan, nan, nan, nan)
    error = np.abs(depth[estimated] - truth[estimated]) / truth[estimated]
    share = [float((error < limit).mean()) for limit in (0.01, 0.02, 0.05)]
    return Accuracy(
        float(estimated.sum() / known.sum()), share[0], share[1], share[2], float(np.median(error))
    )
