"""Huber total variation of inverse depth, weighted by confidence and image edges."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from companion.dense.opencl import ComputeDevice
from companion.dense.plane_sweep import Run
from companion.messages import Floats

HUBER = 0.01
EDGE_GREY = 12.0
STEP = np.float32(1.0 / np.sqrt(8.0))
"""Of both variables; the greatest for which the iteration converges on a grid of pixels."""
LANES = 8
"""Pixels of a work-item."""
GROUP = (8, 16)


class Regularisation:
    """Buffers and kernels for a grid of one size."""

    def __init__(self, device: ComputeDevice, grid: tuple[int, int]) -> None:
        self._device = device
        self._grid = grid
        program = device.build("regularise.cl", {})
        self._dual, self._primal = cl.Kernel(program, "dual"), cl.Kernel(program, "primal")
        self._pitch = -(-grid[0] // LANES) * LANES
        n = self._pitch * (grid[1] + 2)
        self._x, self._x_bar, self._edge, self._pull, self._share, self._px, self._py = (
            device.buffer(4 * n) for _ in range(7)
        )

    def run(self, data: Floats, weight: Floats, edge: Floats, iterations: int, run: Run) -> Floats:
        """Smoothed `data` (H, W), all f32 of that shape; pixels of weight 0 are filled in."""
        device, (width, height) = self._device, self._grid
        nothing = np.zeros((height, width), np.float32)
        for buffer, array in (
            (self._x, data), (self._x_bar, data), (self._edge, edge), (self._px, nothing),
            (self._py, nothing), (self._pull, STEP * weight * data),
            (self._share, 1.0 / (1.0 + STEP * weight)),
        ):  # fmt: skip
            device.write(buffer, self._framed(array))
        size = (self._pitch // LANES, height)
        w, h, pitch = np.int32(width), np.int32(height), np.int32(self._pitch)
        shrink = np.float32(1.0 / (1.0 + STEP * HUBER))
        for _ in range(iterations):
            run(
                "dual", self._dual, size, GROUP, self._x_bar, self._edge, self._px, self._py, w, h,
                pitch, STEP, shrink,
            )  # fmt: skip
            run(
                "primal", self._primal, size, GROUP, self._x, self._x_bar, self._edge, self._px,
                self._py, self._pull, self._share, h, pitch, STEP,
            )  # fmt: skip
        out = np.empty((height + 2, self._pitch), np.float32)
        device.read(out, self._x)
        return np.ascontiguousarray(out[1:-1, :width])

    def _framed(self, array: Floats) -> Floats:
        """As the kernels have it: rows of `_pitch` numbers, one of zeros above and one below."""
        (width, height) = self._grid
        framed = np.zeros((height + 2, self._pitch), np.float32)
        framed[1:-1, :width] = array
        return framed


def edges(grey: Floats) -> Floats:
    """Edge weight of each pixel of an image (H, W), 0 to 1: small across edges."""
    gradient = np.zeros_like(grey)
    gradient[:, :-1] += np.abs(np.diff(grey, axis=1))
    gradient[:-1] += np.abs(np.diff(grey, axis=0))
    return np.asarray(np.exp(-gradient / EDGE_GREY), np.float32)
