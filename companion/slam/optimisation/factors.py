"""Interface and robust loss of the factors that complement the images in bundle adjustment."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from companion.geometry.transforms import Array
from companion.slam.features.orb_features import Ints

CAUCHY_SCALE = 3.0
"""Scale of Cauchy's loss, in standard deviations: outliers among these measurements are gross."""
PairJacobians = tuple[tuple[Ints, Array], tuple[Ints, Array]]
"""For each of the two cameras of E pairs: camera index (E,), and Jacobian (E, 3, 3) of the errors
by three of its degrees of freedom."""


class Factor(Protocol):
    """A factor over `camera_from_map` poses (C, ...)."""

    def cost(self, rotation: Array, translation: Array) -> float:
        """Robust cost at these poses."""

    def add_normal_equations(
        self, information: Array, gradient: Array, rotation: Array, translation: Array
    ) -> None:
        """Add its information (n, 6, n, 6) and gradient (n, 6) for the first n cameras.

        Cameras are perturbed as in bundle adjustment: from the left, by rotation and translation
        (6,).
        """


def cauchy_cost(size: Array) -> float:
    """Cauchy's loss of whitened errors of these norms (E,)."""
    return float((0.5 * CAUCHY_SCALE**2 * np.log1p((size / CAUCHY_SCALE) ** 2)).sum())


def cauchy_root_weight(size: Array) -> Array:
    """Square root (E,) of the weights of Cauchy's loss, for errors and Jacobians."""
    out: Array = 1.0 / np.hypot(1.0, size / CAUCHY_SCALE)
    return out


def add_pairwise(
    information: Array, gradient: Array, jacobians: PairJacobians, residual: Array
) -> None:
    """Add pairwise errors (E, 3) to information (n, 3, n, 3) and gradient (n, 3)."""
    n = len(gradient)
    blocks = information.transpose(0, 2, 1, 3)
    for a, jacobian_a in jacobians:
        part = np.matmul(jacobian_a.transpose(0, 2, 1), residual[..., None])[..., 0]
        np.add.at(gradient, a[a < n], part[a < n])
        for b, jacobian_b in jacobians:
            both = (a < n) & (b < n)
            block = np.matmul(jacobian_a.transpose(0, 2, 1), jacobian_b)[both]
            np.add.at(blocks, (a[both], b[both]), block)
