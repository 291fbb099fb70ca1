"""Huber total variation of inverse depth, weighted by confidence and image edges."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from companion.dense.opencl import ComputeDevice
from companion.dense.plane_sweep import Run
from companion.messages import Floats

HUBER = 0.01
EDGE_GREY = 12.0


class Regularisation:
    """Buffers and kernels for a grid of one size."""

    def __init__(self, device: ComputeDevice, grid: tuple[int, int]) -> None:
        self._device = device
        self._grid = grid
        program = device.build("regularise.cl", {})
        self._dual, self._primal = cl.Kernel(program, "dual"), cl.Kernel(program, "primal")
        n = grid[0] * grid[1]
        self._x, self._x_bar, self._edge, self._data, self._weight = (
            device.buffer(4 * n) for _ in range(5)
        )
        self._p = device.buffer(8 * n)

    def run(self, data: Floats, weight: Floats, edge: Floats, iterations: int, run: Run) -> Floats:
        """Smoothed `data` (H, W), all f32 of that shape; pixels of weight 0 are filled in."""
        device, (width, height) = self._device, self._grid
        for buffer, array in (
            (self._x, data), (self._x_bar, data), (self._data, data), (self._weight, weight),
            (self._edge, edge), (self._p, np.zeros(2 * height * width, np.float32)),
        ):  # fmt: skip
            device.write(buffer, np.ascontiguousarray(array, np.float32))
        w, h, step = np.int32(width), np.int32(height), np.float32(1.0 / np.sqrt(8.0))
        for _ in range(iterations):
            run(
                "dual", self._dual, self._grid, (64, 1), self._x_bar, self._edge, self._p, w, h,
                step, np.float32(HUBER),
            )  # fmt: skip
            run(
                "primal", self._primal, self._grid, (64, 1), self._x, self._x_bar, self._edge,
                self._p, self._data, self._weight, w, h, step,
            )  # fmt: skip
        out = np.empty((height, width), np.float32)
        device.read(out, self._x)
        return out


def edges(grey: Floats) -> Floats:
    """Edge weight of each pixel of an image (H, W), 0 to 1: small across edges."""
    gradient = np.zeros_like(grey)
    gradient[:, :-1] += np.abs(np.diff(grey, axis=1))
    gradient[:-1] += np.abs(np.diff(grey, axis=0))
    return np.asarray(np.exp(-gradient / EDGE_GREY), np.float32)
