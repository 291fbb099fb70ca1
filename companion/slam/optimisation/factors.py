"""What is told of cameras beside the images, for bundle adjustment."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints

SOFT = 3.0
"""Standard deviations beyond which a pair pulls ever less: where one is wrong it is quite wrong."""
Ends = tuple[tuple[Ints, Array], tuple[Ints, Array]]
"""Of pairs of cameras, for each of the two: which camera (E,), and the errors' Jacobian (E, 3, 3)
by three of its degrees of freedom."""


class Tie(Protocol):
    """What is told, by the cameras' `camera_from_map` poses (C, …)."""

    def cost(self, rotation: Array, translation: Array) -> float:
        """What it costs that the cameras do not agree with it."""

    def add_to(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """Add its information (n, 6, n, 6) and gradient (n, 6) of the first n cameras.

        A camera moves as in bundle adjustment, by a turn and then a shift (6,).
        """


def soft_cost(size: Array) -> float:
    """Cauchy's loss of whitened errors of these sizes (E,)."""
    return float((0.5 * SOFT**2 * np.log1p((size / SOFT) ** 2)).sum())


def soft_root(size: Array) -> Array:
    """What errors and Jacobians count by for that loss (E,): the root of the weight."""
    out: Array = 1.0 / np.hypot(1.0, size / SOFT)
    return out


def add_pairs(information: Array, gradient: Array, ends: Ends, off: Array) -> None:
    """Add what errors (E, 3) of pairs tell to information (n, 3, n, 3) and gradient (n, 3)."""
    n = len(gradient)
    blocks = information.transpose(0, 2, 1, 3)
    for a, of_a in ends:
        pulled = np.matmul(of_a.transpose(0, 2, 1), off[..., None])[..., 0]
        np.add.at(gradient, a[a < n], pulled[a < n])
        for b, of_b in ends:
            both = (a < n) & (b < n)
            tied = np.matmul(of_a.transpose(0, 2, 1), of_b)[both]
            np.add.at(blocks, (a[both], b[both]), tied)
