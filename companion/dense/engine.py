"""Dense depth of a reference image from images with known poses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyopencl as cl

from companion.config import DepthConfig
from companion.dense.opencl import READ_BACK, UPLOAD, ComputeDevice, event_ms
from companion.dense.plane_sweep import PLANES, PlaneSweep
from companion.dense.regularisation import Regularisation, edges
from companion.dense.verification import Verification, image_noise
from companion.dense.view_selection import Intrinsics, View, Views
from companion.geometry.transforms import Pose
from companion.messages import Bytes, DepthMap, Floats, PixelState

STEP_PX = 0.75
"""Disparity between planes in the image of largest parallax: smaller steps are indistinguishable.
"""
MIN_PLANES = 8
MIN_VIEWS = 3
FIRST_SPREAD, NEXT_SPREAD = 0.07, 3.0
"""Spread of the kept views, relative to depth, at the first sweep; then the factor between sweeps.
"""


SMOOTHING_SCALE = 8.0
"""Range of inverse depths after scaling for the regulariser."""


class DepthEngine:
    """Depth of reference images of one size and camera: `begin`, several `update`s, `finish`.

    If `eager`, estimates are computed as images arrive and refined with better ones; else all is
    done in `finish`.
    """

    def __init__(
        self,
        device: ComputeDevice,
        width: int,
        height: int,
        intrinsics: Intrinsics,
        config: DepthConfig,
        *,
        eager: bool = True,
    ) -> None:
        self._device = device
        self._config = config
        self._eager = eager
        self.intrinsics = intrinsics
        self._views = Views(intrinsics, width, height)
        self._searched: set[View] = set()
        self._sweep = PlaneSweep(device, width, height, config.stride)
        self._verification = Verification(device, self._sweep, config)
        self._regularisation = Regularisation(device, self._sweep.grid)
        self._shape = self._sweep.grid[::-1]
        self._grey, self._noise_grey = np.zeros((height, width), np.uint8), 0.0
        self._labels = np.zeros(self._shape, np.uint8)
        self._rho = (0.0, 0.0)
        self._events: list[tuple[str, cl.Event]] = []
        self._n_taken, self._n_swept, self._due = 0, 0, FIRST_SPREAD

    @property
    def n_novel(self) -> int:
        """Images of this reference that were considered; the others were redundant."""
        return self._views.n_novel

    @property
    def n_searched(self) -> int:
        """Images of this reference used in any sweep."""
        return len(self._searched)

    @property
    def labels(self) -> Bytes:
        """`PixelState` of each grid pixel (H, W) so far."""
        return self._labels

    def begin(self, grey: Bytes, near: float, far: float) -> None:
        """Start a reference image (H, W) with depths between `near` and `far`, map units."""
        self._events = []
        self._device.copies.clear()
        self._grey, self._noise_grey = grey, image_noise(grey)
        self._rho = (1.0 / far, 1.0 / near)
        self._views.begin(*self._rho)
        self._searched = set()
        self._sweep.set_reference(grey, self._run)
        self._labels[:] = PixelState.UPDATING.value
        self._n_taken, self._n_swept, self._due = 0, 0, FIRST_SPREAD

    def update(self, grey: Bytes, current_from_reference: Pose) -> int:
        """Add an image (H, W); returns the number of pixels not converged.

        Images from nearly the same position as another are skipped.
        """
        self._n_taken += 1
        view = self._views.consider(current_from_reference)
        if view is not None:
            self._sweep.set_image(view.slot, grey)
            if self._eager and len(self._views.kept) >= MIN_VIEWS:
                spread = self._views.spread()
                if spread >= self._due:
                    self._due = NEXT_SPREAD * spread
                    self._estimate()
        return int((self._labels == PixelState.UPDATING.value).sum())

    def _estimate(self) -> None:
        projections = self._views.projections()
        self._searched.update(self._views.kept)
        wanted = math.ceil(self._views.parallax_px() / STEP_PX) + 1
        n_planes = min(max(wanted, MIN_PLANES), PLANES[-1])
        step = (self._rho[1] - self._rho[0]) / (n_planes - 1)
        self._sweep.run(projections, self._rho[0], step, n_planes, self._run)
        self._verification.run(projections, step, self._noise_grey, self._run)
        self._device.read(self._labels, self._verification.label)
        self._n_swept = self._views.n_kept

    def finish(self, keyframe_id: int, t_ns: int, rgb: Bytes) -> DepthMap:
        """The regularised depth map; 0 where unknown.

        Pixels not converged are filled in by regularisation: see `state`, and `measured_only`.
        """
        if self._views.n_kept > self._n_swept:
            self._estimate()
        stride, k, shape = self._config.stride, self.intrinsics, self._shape
        intrinsics = (k.fx / stride, k.fy / stride, k.cx / stride, k.cy / stride)
        colours = np.ascontiguousarray(rgb[::stride, ::stride])
        if self._n_swept == 0:
            nothing = np.zeros(shape, np.float32)
            return DepthMap(
                keyframe_id, t_ns, intrinsics, nothing, nothing.copy(), self._labels.copy(),
                nothing.copy(), colours, self._n_taken, self._kernel_ms(),
            )  # fmt: skip
        rho, sigma_rho, ratio, weight = (
            self._read(b)
            for b in (
                self._sweep.rho, self._verification.sigma, self._verification.ratio,
                self._verification.weight,
            )
        )  # fmt: skip
        if self._config.regularise_iterations:
            rho = self._regularised(rho, weight)
        rho = np.clip(rho, self._rho[0], self._rho[1])
        return DepthMap(
            keyframe_id, t_ns, intrinsics, 1.0 / rho, sigma_rho / (rho * rho), self._labels.copy(),
            ratio, colours, self._n_taken, self._kernel_ms(),
        )  # fmt: skip

    def _regularised(self, rho: Floats, weight: Floats) -> Floats:
        low, high = self._rho
        stride = self._config.stride
        edge = edges(self._grey[::stride, ::stride].astype(np.float32))
        scale = np.float32(SMOOTHING_SCALE / (high - low))
        smooth = self._regularisation.run(
            (rho - np.float32(low)) * scale, weight * np.float32(self._config.regularise_weight),
            edge, self._config.regularise_iterations, self._run,
        )  # fmt: skip
        return smooth / scale + np.float32(low)

    def _read(self, buffer: cl.Buffer) -> Floats:
        out = np.empty(self._shape, np.float32)
        self._device.read(out, buffer)
        return out

    def _run(
        self, name: str, kernel: cl.Kernel, size: tuple[int, ...], group: tuple[int, ...],
        *arguments: Any,
    ) -> None:  # fmt: skip
        kernel.set_args(*arguments)
        whole = tuple(-(-int(n) // g) * g for n, g in zip(size, group, strict=True))
        event = cl.enqueue_nd_range_kernel(self._device.queue, kernel, whole, group)
        self._events.append((name, event))

    def n_commands(self) -> int:
        """Commands enqueued since `begin`, copies included."""
        self._events.extend(self._device.copies)
        self._device.copies.clear()
        return len(self._events)

    def device_ms(self, first: int = 0, beyond: int | None = None) -> dict[str, float]:
        """Device time by kernel name, or `UPLOAD` or `READ_BACK`.

        `first` and `beyond` are values of `n_commands`; waits for completion.
        """
        self.n_commands()
        out: dict[str, float] = {}
        for name, event in self._events[first:beyond]:
            out[name] = out.get(name, 0.0) + event_ms(event)
        return out

    def _kernel_ms(self) -> dict[str, float]:
        every = self.device_ms()
        return {name: ms for name, ms in every.items() if name not in (UPLOAD, READ_BACK)}
