"""Dense depth of one reference image from images with known poses."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from companion.config import DepthConfig
from companion.depth.opencl import ComputeDevice, event_ms
from companion.geometry import Array, Pose
from companion.messages import Bytes, DepthMap, Floats, PixelState

Mask = NDArray[np.bool_]
RADIUS = 3
MAX_STEPS = 48
GROUP = 64
BORDER_PX = RADIUS + 1
A0, B0 = 4.0, 2.0
"""Inlier ratio believed at the start: two thirds, worth six measurements."""
HUBER = 0.01
EDGE_GREY = 12.0


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """An ideal pinhole camera, in pixels."""

    fx: float
    fy: float
    cx: float
    cy: float


class DepthEngine:
    """A depth filter for images of one size and camera. `begin`, some `update`s, `finish`."""

    def __init__(
        self,
        device: ComputeDevice,
        width: int,
        height: int,
        intrinsics: Intrinsics,
        config: DepthConfig,
    ) -> None:
        self._device = device
        self._size = (height, width)
        self._config = config
        self.intrinsics = intrinsics
        stride = config.stride
        self._grid = ((height + stride - 1) // stride, (width + stride - 1) // stride)
        n = self._grid[0] * self._grid[1]
        program = device.build("depth_filter.cl", {"RADIUS": RADIUS, "MAX_STEPS": MAX_STEPS})
        self._update = cl.Kernel(program, "update")
        self._dual = cl.Kernel(program, "dual")
        self._primal = cl.Kernel(program, "primal")
        self._reference, self._current = (device.buffer(4 * width * height) for _ in range(2))
        self._active = device.buffer(4 * n)
        self._state, self._label = device.buffer(16 * n), device.buffer(n)
        self._x, self._x_bar, self._edge, self._data, self._weight = (
            device.buffer(4 * n) for _ in range(5)
        )
        self._p = device.buffer(8 * n)
        self._labels = np.zeros(n, np.uint8)
        self._border = self._find_border()
        self._grey = np.zeros(self._size, np.float32)
        self._rho = (0.0, 0.0)
        self._kernel_ms: defaultdict[str, float] = defaultdict(float)
        self._n_updates = 0

    def _find_border(self) -> Mask:
        height, width = self._size
        v = np.arange(self._grid[0]) * self._config.stride
        u = np.arange(self._grid[1]) * self._config.stride
        inside_v = (v >= BORDER_PX) & (v < height - BORDER_PX)
        inside_u = (u >= BORDER_PX) & (u < width - BORDER_PX)
        return ~(inside_v[:, None] & inside_u[None, :]).ravel()

    def begin(self, grey: Bytes, near: float, far: float) -> None:
        """Start on an image (H, W) whose depths lie between `near` and `far` (map units)."""
        self._grey = np.ascontiguousarray(grey, np.float32)
        self._device.write(self._reference, self._grey)
        self._rho = (1.0 / far, 1.0 / near)
        low, high = self._rho
        state = np.empty((len(self._labels), 4), np.float32)
        state[:] = (0.5 * (low + high), (0.5 * (high - low)) ** 2, A0, B0)
        self._device.write(self._state, state)
        self._labels[:] = PixelState.UPDATING.value
        self._labels[self._border] = PixelState.BORDER.value
        self._device.write(self._label, self._labels)
        self._kernel_ms.clear()
        self._n_updates = 0

    def update(self, grey: Bytes, current_from_reference: Pose) -> int:
        """Take another image (H, W); returns how many pixels were still worked on.

        An image from the same place says nothing and is passed over.
        """
        active = np.flatnonzero(self._labels == PixelState.UPDATING.value).astype(np.int32)
        baseline = float(np.linalg.norm(current_from_reference.translation))
        if len(active) == 0 or baseline * self._rho[1] * self.intrinsics.fx < 0.5:
            return 0
        device, config, k = self._device, self._config, self.intrinsics
        pose = current_from_reference
        device.write(self._current, np.ascontiguousarray(grey, np.float32))
        device.write(self._active, active)
        rows = [np.array([*pose.rotation[i], pose.translation[i]], np.float32) for i in range(3)]
        height, width = self._size
        area = (2 * RADIUS + 1) ** 2
        self._update.set_args(
            self._reference, self._current, np.int32(width), np.int32(height),
            self._active, np.int32(len(active)), self._state, self._label,
            np.int32(self._grid[1]), np.int32(config.stride), _float4(k.fx, k.fy, k.cx, k.cy),
            *rows, np.array(self._rho, np.float32),
            _float4(
                config.min_zncc, config.peak_margin, area * config.noise_grey**2,
                config.pose_error_px,
            ),
            _float4(config.converged_sigma, config.min_inlier_ratio, 0.2, 0.0),
        )  # fmt: skip
        event = cl.enqueue_nd_range_kernel(
            device.queue, self._update, (-(-len(active) // GROUP) * GROUP,), (GROUP,)
        )
        self._kernel_ms["update"] += event_ms(event)
        device.read(self._labels, self._label)
        self._n_updates += 1
        return len(active)

    def finish(self, keyframe_id: int, t_ns: int, rgb: Bytes) -> DepthMap:
        """The depth so far, regularised; pixels that did not converge have none."""
        state = np.empty((len(self._labels), 4), np.float32)
        self._device.read(state, self._state)
        rho, sigma_rho = state[:, 0], np.sqrt(state[:, 1])
        ratio = state[:, 2] / (state[:, 2] + state[:, 3])
        good = (self._labels == PixelState.CONVERGED.value) & (rho > 0)
        smooth: Array = rho.astype(np.float64)
        if self._config.regularise_iterations and good.any():
            smooth = self._regularise(rho, sigma_rho, good)
            # smoothing may move a value within its error, not replace it
            good &= np.abs(smooth - rho) < np.maximum(3.0 * sigma_rho, 0.01 * rho)
        safe = np.where(good, smooth, 1.0)
        depth = np.where(good, 1.0 / safe, 0.0).astype(np.float32)
        sigma = np.where(good, sigma_rho / safe**2, 0.0).astype(np.float32)
        stride, k, shape = self._config.stride, self.intrinsics, self._grid
        return DepthMap(
            keyframe_id, t_ns, (k.fx / stride, k.fy / stride, k.cx / stride, k.cy / stride),
            depth.reshape(shape), sigma.reshape(shape), self._labels.reshape(shape).copy(),
            ratio.reshape(shape), np.ascontiguousarray(rgb[::stride, ::stride]),
            self._n_updates, dict(self._kernel_ms),
        )  # fmt: skip

    def _regularise(self, rho: Floats, sigma_rho: Floats, good: Mask) -> Array:
        """Huber-TV on inverse depth, weighted by confidence and edges (Chambolle & Pock 2011)."""
        device, config = self._device, self._config
        height, width = self._grid
        low = self._rho[0]
        span = float(np.median(rho[good]))
        data = np.where(good, (rho - low) / span, 0.0).astype(np.float32)
        start = np.where(good, data, float(np.median(data[good]))).astype(np.float32)
        confidence = np.clip((0.01 * rho / np.maximum(sigma_rho, 1e-12)) ** 2, 0.0, 4.0)
        weight = np.where(good, config.regularise_weight * confidence, 0.0).astype(np.float32)
        grey = self._grey[:: config.stride, :: config.stride]
        gradient = np.zeros_like(grey)
        gradient[:, :-1] += np.abs(np.diff(grey, axis=1))
        gradient[:-1] += np.abs(np.diff(grey, axis=0))
        edge = np.exp(-gradient / EDGE_GREY).astype(np.float32)
        for buffer, array in (
            (self._x, start), (self._x_bar, start), (self._data, data), (self._weight, weight),
            (self._edge, edge), (self._p, np.zeros(2 * height * width, np.float32)),
        ):  # fmt: skip
            device.write(buffer, np.ascontiguousarray(array))
        w, h, step = np.int32(width), np.int32(height), np.float32(1.0 / np.sqrt(8.0))
        self._dual.set_args(self._x_bar, self._edge, self._p, w, h, step, np.float32(HUBER))
        self._primal.set_args(
            self._x, self._x_bar, self._edge, self._p, self._data, self._weight, w, h, step
        )
        grid = (-(-width // 32) * 32, height)
        for _ in range(config.regularise_iterations):
            first = cl.enqueue_nd_range_kernel(device.queue, self._dual, grid, (32, 1))
            last = cl.enqueue_nd_range_kernel(device.queue, self._primal, grid, (32, 1))
        # all iterations cost the same: one is measured
        one_ms = event_ms(last) + event_ms(first)
        self._kernel_ms["regularise"] += one_ms * config.regularise_iterations
        out = np.empty(height * width, np.float32)
        device.read(out, self._x)
        return out.astype(np.float64) * span + low


def _float4(a: float, b: float, c: float, d: float) -> Floats:
    return np.array([a, b, c, d], np.float32)
