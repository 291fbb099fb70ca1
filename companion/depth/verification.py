"""Whether images fit the depths that are believed, and what is to be thought of each pixel."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from companion.config import DepthConfig
from companion.depth.opencl import ComputeDevice
from companion.depth.sweep import PlaneSweep, Run
from companion.geometry import Array

FURTHEST_PX = 1.5
"""An image that would have a pixel further away than this does not fit."""
DIVERGED_RATIO = 0.2
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
        self._grey, self._value, self._change, self._good, self._bad = (
            device.buffer(4 * n) for _ in range(5)
        )
        self.sigma, self.ratio, self.weight = (device.buffer(4 * n) for _ in range(3))
        self.label = device.buffer(n)
        self._zeros = np.zeros(n, np.float32)

    def run(self, projections: Array, step: float, run: Run) -> None:
        """Verify the sweep's result in the images that it was made of; `step` as there."""
        sweep, config = self._sweep, self._config
        grid = tuple(map(np.int32, sweep.grid))
        width, height = map(np.int32, sweep.size)
        stride = np.int32(sweep.stride)
        for counts in (self._good, self._bad):
            self._device.write(counts, self._zeros)
        run(
            "grey", self._kernels["to_grid"], grid, (64, 1), sweep.reference, width, self._grey,
            *grid, stride,
        )  # fmt: skip
        limits = np.array([config.min_zncc, config.noise_grey, FURTHEST_PX, 0.0], np.float32)
        for slot, rows in enumerate(projections.astype(np.float32).reshape(-1, 3, 4)):
            run(
                "follow", self._kernels["follow"], grid, (64, 1), sweep.images[slot], width, height,
                sweep.rho, *(np.ascontiguousarray(row) for row in rows), self._value, self._change,
                *grid, stride,
            )  # fmt: skip
            run(
                "verify", self._kernels["verify"], (-(-sweep.grid[0] // 8), sweep.grid[1]), (16, 1),
                self._grey, self._value, self._change, self._good, self._bad, limits, *grid,
            )  # fmt: skip
        accept = (
            config.converged_sigma, config.min_inlier_ratio, DIVERGED_RATIO,
            min(2, len(projections)),
        )  # fmt: skip
        run(
            "judge", self._kernels["judge"], grid, (64, 1), sweep.rho, sweep.margin, self._good,
            self._bad, sweep.noise, np.float32(step), np.array(accept, np.float32),
            np.int32(BORDER), self.sigma, self.ratio, self.label, self.weight, *grid,
        )  # fmt: skip
