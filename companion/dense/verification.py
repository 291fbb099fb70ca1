"""Photo-consistency check of swept depth, and classification of pixels."""

from __future__ import annotations

import cv2
import numpy as np
import pyopencl as cl

from companion.config import DepthConfig
from companion.dense.opencl import ComputeDevice
from companion.dense.plane_sweep import PlaneSweep, Run
from companion.geometry.transforms import Array
from companion.messages import Bytes

MAX_DISTANCE_PX = 1.5
"""Larger offsets in an image are mismatches."""
DIVERGED_RATIO = 0.2
AREA = 25
"""Pixels of the compared window."""
NOISE_BOUND = 1.8
"""99 % quantile of window noise relative to its expectation (chi squared, 24 degrees of freedom).
"""
MIN_TEXTURE_GREY = 1.0
"""Patches whose grey levels vary less than this, an image's rounding, have no texture."""
NOISE_BLOCK, NOISE_QUANTILE = 16, 0.1
"""Side in pixels of the blocks in which noise is measured, and the quantile used."""
MAX_NOISE_GREY = 6.0
"""Larger values are texture, not noise."""
BORDER = 2


class Verification:
    """Counts consistent images per grid pixel on the device; classifies by count and margin."""

    def __init__(self, device: ComputeDevice, sweep: PlaneSweep, config: DepthConfig) -> None:
        self._device = device
        self._sweep = sweep
        self._config = config
        program = device.build("measure.cl", {})
        names = ("follow", "to_grid", "verify", "judge")
        self._kernels = {name: cl.Kernel(program, name) for name in names}
        n = sweep.grid[0] * sweep.grid[1]
        self._grey, self._value, self._change, self._good, self._bad, self._similar = (
            device.buffer(4 * n) for _ in range(6)
        )
        self.sigma, self.ratio, self.weight = (device.buffer(4 * n) for _ in range(3))
        self.label = device.buffer(n)
        self._zeros = np.zeros(n, np.float32)

    def run(self, projections: Array, step: float, noise_grey: float, run: Run) -> None:
        """Verify the result of the sweep in its images; `step` as there.

        `noise_grey` is `image_noise` of the reference.
        """
        sweep, config = self._sweep, self._config
        grid = tuple(map(np.int32, sweep.grid))
        eights = (-(-sweep.grid[0] // 8), sweep.grid[1])
        width, height = map(np.int32, sweep.size)
        stride = np.int32(sweep.stride)
        for counts in (self._good, self._bad, self._similar):
            self._device.write(counts, self._zeros)
        run(
            "grey", self._kernels["to_grid"], grid, (64, 1), sweep.reference, width, self._grey,
            *grid, stride,
        )  # fmt: skip
        max_similar = NOISE_BOUND * AREA * 2.0 * noise_grey**2
        limits = np.array(
            [config.min_zncc, MIN_TEXTURE_GREY, MAX_DISTANCE_PX, max_similar], np.float32
        )
        for slot, rows in enumerate(projections.astype(np.float32).reshape(-1, 3, 4)):
            run(
                "follow", self._kernels["follow"], eights, (16, 1), sweep.images[slot], width,
                height, sweep.rho, *(np.ascontiguousarray(row) for row in rows), self._value,
                self._change, *grid, stride,
            )  # fmt: skip
            run(
                "verify", self._kernels["verify"], eights, (16, 1),
                self._grey, self._value, self._change, self._good, self._bad, self._similar, limits,
                *grid,
            )  # fmt: skip
        accept = (
            config.converged_sigma, config.min_inlier_ratio, DIVERGED_RATIO,
            min(2, len(projections)),
        )  # fmt: skip
        run(
            "judge", self._kernels["judge"], grid, (64, 1), sweep.rho, sweep.margin, self._good,
            self._bad, self._similar, sweep.noise, np.float32(step),
            np.array(accept, np.float32), np.int32(BORDER), self.sigma, self.ratio, self.label,
            self.weight, *grid,
        )  # fmt: skip


def image_noise(grey: Bytes) -> float:
    """Standard deviation of the noise of an image (H, W), grey levels (Immerkaer 1996).

    Measured in the smoothest blocks, as texture adds to it; 0 where a tenth of them is constant, at
    most `MAX_NOISE_GREY`.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    rough = np.abs(cv2.filter2D(grey, cv2.CV_32F, mask))
    height, width = grey.shape
    blocks = (max(1, width // NOISE_BLOCK), max(1, height // NOISE_BLOCK))
    means = cv2.resize(rough, blocks, interpolation=cv2.INTER_AREA)
    # the mask has norm 6; the mean of |x| of a Gaussian is 0.798 standard deviations
    found = float(np.quantile(means, NOISE_QUANTILE)) * float(np.sqrt(np.pi / 2)) / 6.0
    return min(found, MAX_NOISE_GREY)
