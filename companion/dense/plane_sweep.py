"""Multi-view plane sweep with semi-global aggregation of census costs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl as cl

from companion.dense.opencl import ComputeDevice
from companion.dense.view_selection import MAX_VIEWS
from companion.errors import DeviceError
from companion.geometry.transforms import Array
from companion.messages import Bytes

PLANES = (32, 64, 128)
"""Plane counts that kernels exist for; multiples of 16."""
BLOCK = 8
SMALL, LARGE = 3.5, 27.0
"""Penalties of steps by one plane and by more, bits per counted image."""
EDGE_GREY = 16
"""Grey-level difference at which the large penalty is halved."""
COARSE_STEP = 2
"""Planes from one to the next that coarse pixels look at: 1.5 pixels where points move most, which
a window of five pixels does not miss."""
SKIPPED_COST = 18
"""Bits per image of planes not evaluated: more than those of a mismatch."""
COARSE_PATHS = ((1, 0), (-1, 0), (0, 1), (0, -1))
PATHS = (*COARSE_PATHS, (1, 1), (-1, -1), (1, -1), (-1, 1))

Run = Callable[..., None]


class PlaneSweep:
    """Buffers and kernels of a sweep for one image size; results stay on the device.

    After `run`, `rho` is inverse depth f32 on the grid (3 x 3 median), `margin` the relative cost
    excess of the next best plane, and `noise` the local roughness of depth.
    """

    def __init__(self, device: ComputeDevice, width: int, height: int, stride: int) -> None:
        self._device = device
        self.size = (width, height)
        self.stride = stride
        self.grid = (-(-width // stride), -(-height // stride))
        self._coarse = (-(-width // (2 * stride)), -(-height // (2 * stride)))
        n = self.grid[0] * self.grid[1]
        largest = device.device.max_mem_alloc_size
        if 2 * PLANES[-1] * n > largest:
            raise DeviceError(
                f"{device.name}: images of {width} x {height} need a buffer of "
                f"{2 * PLANES[-1] * n >> 20} MB, it allows {largest >> 20}: "
                "raise expert.depth.stride"
            )
        self._kernels = {n: _kernels(device, n) for n in PLANES}
        self._n_pixels = width * height
        self.reference = device.buffer(self._n_pixels)
        self._words_r = device.buffer(4 * self._n_pixels)
        self.images = [device.buffer(self._n_pixels) for _ in range(MAX_VIEWS)]
        self._words = device.buffer(4 * self._n_pixels * MAX_VIEWS)
        self._stale: set[int] = set()
        self._views = device.buffer(4 * 12 * MAX_VIEWS)
        self._blocks, self._first = device.buffer(4 * n), device.buffer(4 * n)
        # a device that leaves out work is found out by its results: it reads beyond no buffer
        device.write(self._first, np.zeros(n, np.uint32))
        self._cost, self._sum = device.buffer(PLANES[-1] * n), device.buffer(2 * PLANES[-1] * n)
        self._winner = device.buffer(4 * n)
        self.rho, self.margin, self.noise = (device.buffer(4 * n) for _ in range(3))

    def set_reference(self, grey: Bytes, run: Run) -> None:
        """Set the reference image (H, W)."""
        self._device.write(self.reference, np.ascontiguousarray(grey))
        self._census(self.reference, self._words_r, 0, run)

    def set_image(self, slot: int, grey: Bytes) -> None:
        """Set an image (H, W) in a slot; transformed at the next sweep."""
        self._device.write(self.images[slot], np.ascontiguousarray(grey))
        self._stale.add(slot)

    def run(self, projections: Array, rho_low: float, step: float, n_planes: int, run: Run) -> None:
        """Sweep planes rho_low + k * step, at most `PLANES[-1]` of them.

        `projections` (n, 12) are of the images in slots 0 to n - 1.
        """
        n = len(projections)
        for slot in sorted(self._stale):
            self._census(self.images[slot], self._words, slot * self._n_pixels, run)
        self._stale.clear()
        dropped = 2 if n >= 5 else 1 if n >= 3 else 0
        self._device.write(self._views, np.ascontiguousarray(projections, np.float32))
        for skip in (COARSE_STEP, 1):
            every = -(-n_planes // skip)
            planes = next(n for n in PLANES if n >= every)
            blocks = (1 << -(-every // BLOCK)) - 1
            if skip > 1:
                everywhere = np.full(self._coarse[0] * self._coarse[1], blocks, np.uint32)
                self._device.write(self._blocks, everywhere)
            else:
                run(
                    "blocks", self._kernels[planes]["blocks_about"], self.grid, (64, 1), self.rho,
                    *map(np.int32, self._coarse), np.float32(rho_low), np.float32(step),
                    np.uint32(blocks), self._blocks, *map(np.int32, self.grid),
                )  # fmt: skip
            self._level(skip > 1, self._kernels[planes], n, dropped, rho_low, skip * step, run)

    def _level(
        self, coarse: bool, kernels: dict[str, cl.Kernel], n: int, dropped: int,
        rho_low: float, step: float, run: Run,
    ) -> None:  # fmt: skip
        grid = tuple(map(np.int32, self._coarse if coarse else self.grid))
        stride = np.int32(self.stride * (2 if coarse else 1))
        width, height = map(np.int32, self.size)
        counted = n - dropped
        small, large = int(SMALL * counted), int(LARGE * counted)
        level, paths = ("coarse", COARSE_PATHS) if coarse else ("fine", PATHS)
        elsewhere = int(SKIPPED_COST * counted)
        run("places", kernels["places"], (grid[1],), (1,), self._blocks, self._first, *grid)
        run(
            f"costs-{level}", kernels["costs"], grid, (16, 1), self._words_r, self._words,
            width, height, self._views, np.int32(n), np.int32(dropped), np.float32(rho_low),
            np.float32(step), self._blocks, self._first, np.int32(elsewhere), self._cost, *grid,
            stride,
        )  # fmt: skip
        for k, (dx, dy) in enumerate(paths):
            run(
                f"aggregate-{level}", kernels["aggregate"], (grid[0] if dy else grid[1],),
                (8,), self._cost, self._blocks, self._first, self._sum, self.reference, width,
                *grid, stride, np.int32(dx), np.int32(dy), np.int32(small), np.int32(large),
                np.int32(EDGE_GREY), np.int32(k == 0),
            )  # fmt: skip
        n_cells = grid[0] * grid[1]
        run(
            f"winner-{level}", kernels["winner"], (n_cells,), (64,), self._sum, self._blocks,
            self._first, n_cells, np.float32(rho_low), np.float32(step),
            np.int32(elsewhere * len(paths)), self._winner, self.margin,
        )  # fmt: skip
        run(
            f"median-{level}",
            kernels["median"],
            grid,
            (64, 1),
            self._winner,
            *grid,
            self.rho,
            self.noise,
        )

    def _census(self, image: cl.Buffer, words: cl.Buffer, first: int, run: Run) -> None:
        width, height = self.size
        run(
            "census", self._kernels[PLANES[0]]["census"], (-(-width // 8), height), (16, 1), image,
            np.int32(width), np.int32(height), words, np.int32(first),
        )  # fmt: skip


def _kernels(device: ComputeDevice, planes: int) -> dict[str, cl.Kernel]:
    program = device.build("sweep.cl", {"PLANES": planes})
    names = ("census", "costs", "aggregate", "winner", "blocks_about", "places", "median")
    return {name: cl.Kernel(program, name) for name in names}
