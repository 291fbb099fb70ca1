"""Whether images fit the depths that are believed, and what is to be thought of each pixel."""

from __future__ import annotations

import cv2
import numpy as np
import pyopencl as cl

from companion.config import DepthConfig
from companion.dense.opencl import ComputeDevice
from companion.dense.plane_sweep import PlaneSweep, Run
from companion.geometry.transforms import Array
from companion.messages import Bytes

FURTHEST_PX = 1.5
"""An image that would have a pixel further away than this does not fit."""
DIVERGED_RATIO = 0.2
AREA = 25
"""Pixels of the window that is compared."""
NOISE_BOUND = 1.8
"""Times the noise expected of a window that 1 % of them are above (chi squared, 24 degrees)."""
NOISE_BLOCK, NOISE_QUANTILE = 16, 0.1
"""Side in pixels of the blocks that noise is measured in, and which of them is believed."""
MOST_NOISE_GREY = 6.0
"""No camera that is of use has more; what looks like more is texture."""
BORDER = 2


class Verification:
    """Counts, on the device, which images fit each grid pixel; judges it by that and the margin."""

    def __init__(self, device: ComputeDevice, sweep: PlaneSweep, config: DepthConfig) -> None:
        self._device = device
        self._sweep = sweep
        self._config = config
        program = device.build("measure.cl", {})
        names = ("follow", "to_grid", "verify", "judge")
        self._kernels = {name: cl.Kernel(program, name) for name in names}
        n = sweep.grid[0] * sweep.grid[1]
        self._grey, self._value, self._change, self._good, self._bad, self._alike = (
            device.buffer(4 * n) for _ in range(6)
        )
        self.sigma, self.ratio, self.weight = (device.buffer(4 * n) for _ in range(3))
        self.label = device.buffer(n)
        self._zeros = np.zeros(n, np.float32)

    def run(self, projections: Array, step: float, noise_grey: float, run: Run) -> None:
        """Verify the sweep's result in the images that it was made of; `step` as there.

        `noise_grey` is what `image_noise` says of the reference.
        """
        sweep, config = self._sweep, self._config
        grid = tuple(map(np.int32, sweep.grid))
        width, height = map(np.int32, sweep.size)
        stride = np.int32(sweep.stride)
        for counts in (self._good, self._bad, self._alike):
            self._device.write(counts, self._zeros)
        run(
            "grey", self._kernels["to_grid"], grid, (64, 1), sweep.reference, width, self._grey,
            *grid, stride,
        )  # fmt: skip
        alike = NOISE_BOUND * AREA * 2.0 * noise_grey**2
        limits = np.array([config.min_zncc, config.noise_grey, FURTHEST_PX, alike], np.float32)
        for slot, rows in enumerate(projections.astype(np.float32).reshape(-1, 3, 4)):
            run(
                "follow", self._kernels["follow"], grid, (64, 1), sweep.images[slot], width, height,
                sweep.rho, *(np.ascontiguousarray(row) for row in rows), self._value, self._change,
                *grid, stride,
            )  # fmt: skip
            run(
                "verify", self._kernels["verify"], (-(-sweep.grid[0] // 8), sweep.grid[1]), (16, 1),
                self._grey, self._value, self._change, self._good, self._bad, self._alike, limits,
                *grid,
            )  # fmt: skip
        accept = (
            config.converged_sigma, config.min_inlier_ratio, DIVERGED_RATIO,
            min(2, len(projections)),
        )  # fmt: skip
        run(
            "judge", self._kernels["judge"], grid, (64, 1), sweep.rho, sweep.margin, self._good,
            self._bad, self._alike, sweep.noise, np.float32(step),
            np.array(accept, np.float32), np.int32(BORDER), self.sigma, self.ratio, self.label,
            self.weight, *grid,
        )  # fmt: skip


def image_noise(grey: Bytes) -> float:
    """One standard deviation of an image's (H, W) noise, in grey levels (Immerkaer 1996).

    From where it is smoothest, as texture adds to it; 0 where a tenth of it does not vary at all,
    `MOST_NOISE_GREY` at most.
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    rough = np.abs(cv2.filter2D(grey, cv2.CV_32F, mask))
    height, width = grey.shape
    blocks = (max(1, width // NOISE_BLOCK), max(1, height // NOISE_BLOCK))
    means = cv2.resize(rough, blocks, interpolation=cv2.INTER_AREA)
    # the mask's weights have a norm of 6; the mean of |x| of a Gaussian is 0.798 of its deviation
    found = float(np.quantile(means, NOISE_QUANTILE)) * float(np.sqrt(np.pi / 2)) / 6.0
    return min(found, MOST_NOISE_GREY)
