"""Kernels of the dense engine against numpy, at unaligned sizes."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest
from numpy.typing import NDArray

from companion.dense.opencl import ComputeDevice
from companion.dense.regularisation import HUBER, Regularisation
from companion.dense.view_selection import Intrinsics, Views
from companion.geometry.transforms import Pose, rotation_from_vector
from tests.support.flights.scene import texture
from tests.support.reference import opencl_devices
from tests.support.reference import reference_depth as reference

PLANES = 32
SMALL, LARGE, SOFT = 7, 54, 16
MOST_APART = 9000.0
"""What the sum of squared differences of a window may be where it is alike."""


@pytest.fixture(scope="module", params=opencl_devices.working())
def device(request: pytest.FixtureRequest) -> ComputeDevice:
    return opencl_devices.opened(request.param)


@pytest.fixture(scope="module")
def sweep(device: ComputeDevice) -> cl.Program:
    return device.build("sweep.cl", {"PLANES": PLANES})


@pytest.fixture(scope="module")
def measure(device: ComputeDevice) -> cl.Program:
    return device.build("measure.cl", {})


BUILT = """
import sys
from companion.dense.opencl import devices_of, open_device, platform_names
listed = [each for i in range(len(platform_names())) for each in devices_of(i)]
device = open_device(next(each for each in listed if each.named == sys.argv[1]))
for source, constants in (("sweep.cl", {"PLANES": 32}), ("measure.cl", {}), ("regularise.cl", {})):
    device.build(source, constants)
"""


def test_compilers_have_nothing_to_remark(device: ComputeDevice, tmp_path: Path) -> None:
    """What they say goes to standard error, past pyopencl, and is not said of what is cached."""
    built = subprocess.run(
        [sys.executable, "-c", BUILT, device.name], capture_output=True, text=True, timeout=120,
        env={**os.environ, "POCL_CACHE_DIR": str(tmp_path), "PYOPENCL_NO_CACHE": "1"}, check=False,
    )  # fmt: skip
    assert (built.returncode, built.stderr) == (0, "")


def put(device: ComputeDevice, array: NDArray[Any]) -> cl.Buffer:
    buffer = device.buffer(array.nbytes)
    device.write(buffer, np.ascontiguousarray(array))
    return buffer


def run(
    device: ComputeDevice, program: cl.Program, name: str, size: tuple[int, ...], *arguments: Any
) -> None:
    kernel = cl.Kernel(program, name)
    kernel.set_args(*arguments)
    group = (8,) if len(size) == 1 else (16, 1)
    whole = tuple(-(-n // g) * g for n, g in zip(size, group, strict=True))
    cl.enqueue_nd_range_kernel(device.queue, kernel, whole, group).wait()


def i32(*values: int) -> list[np.int32]:
    return [np.int32(value) for value in values]


def some_blocks(rng: np.random.Generator, grid: tuple[int, int]) -> NDArray[np.uint32]:
    """Blocks of planes (H, W) for a grid (width, height), one or more for each pixel."""
    return rng.integers(1, 1 << PLANES // 8, grid[::-1]).astype(np.uint32)


def placed(device: ComputeDevice, sweep: cl.Program, blocks: NDArray[np.uint32]) -> Placed:
    """Where the kernels keep vectors of planes of these blocks (H, W)."""
    height, width = blocks.shape
    wanted, first = put(device, blocks), put(device, blocks)
    run(device, sweep, "places", (height,), wanted, first, *i32(width, height))
    places = np.zeros_like(blocks)
    device.read(places, first)
    return Placed(wanted, first, places, reference.stored(blocks, PLANES))


@dataclass(frozen=True)
class Placed:
    """Blocks and places on a device; here the latter, and which planes (H, W, planes) are kept."""

    wanted: cl.Buffer
    first: cl.Buffer
    places: NDArray[np.uint32]
    there: NDArray[np.bool_]

    def packed(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (H, W, planes) as kernels keep them; 0 where nothing is kept."""
        out = np.zeros_like(values).ravel()
        for (y, x), place in np.ndenumerate(self.places):
            kept = values[y, x, self.there[y, x]]
            out[16 * place : 16 * place + len(kept)] = kept
        return out

    def unpacked(self, kept: NDArray[Any], otherwise: int = 0) -> NDArray[Any]:
        """The reverse; `otherwise` where nothing is kept."""
        out = np.full(self.there.shape, otherwise, kept.dtype)
        for (y, x), place in np.ndenumerate(self.places):
            there = self.there[y, x]
            out[y, x, there] = kept[16 * place : 16 * place + there.sum()]
        return out


def pictures(width: int, height: int, n: int) -> list[NDArray[np.uint8]]:
    big = texture(np.random.default_rng(3), 256)
    return [
        np.ascontiguousarray(big[40 + k : 40 + k + height, 60 + 3 * k : 60 + 3 * k + width])
        for k in range(n)
    ]


def some_projections(width: int, height: int, n: int) -> NDArray[np.float32]:
    views = Views(Intrinsics(0.8 * width, 0.79 * width, 0.49 * width, 0.51 * height), width, height)
    views.begin(1 / 30, 1 / 6)
    for k in range(1, n + 1):
        turn = rotation_from_vector(np.array([0.004, -0.006, 0.02]) * k)
        assert views.consider(Pose(turn, np.array([-0.6 * k, (-1) ** k * 0.9, 0.3 * k])))
    return views.projections().astype(np.float32)


@pytest.mark.parametrize(("width", "height"), [(64, 48), (65, 49), (97, 33), (13, 9), (5, 4)])
def test_census(device: ComputeDevice, sweep: cl.Program, width: int, height: int) -> None:
    (image,) = pictures(width, height, 1)
    out = np.full((2, height, width), 7, np.uint32)
    buffer = put(device, out)
    size, first = (-(-width // 8), height), width * height
    run(device, sweep, "census", size, put(device, image), *i32(width, height), buffer, *i32(first))
    device.read(out, buffer)
    np.testing.assert_array_equal(out[1], reference.census(image))
    assert (out[0] == 7).all()


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize(("n", "n_dropped"), [(1, 0), (3, 1), (5, 2)])
def test_costs(
    device: ComputeDevice, sweep: cl.Program, rng: np.random.Generator, stride: int, n: int,
    n_dropped: int,
) -> None:  # fmt: skip
    width, height = 65, 49
    words = [reference.census(image) for image in pictures(width, height, n + 1)]
    projections = some_projections(width, height, n)
    grid = -(-width // stride), -(-height // stride)
    out = np.zeros(grid[1] * grid[0] * PLANES, np.uint8)
    buffer = put(device, out)
    blocks = some_blocks(rng, grid)
    at = placed(device, sweep, blocks)
    rho0, step = np.float32(1 / 30), np.float32((1 / 6 - 1 / 30) / (PLANES - 1))
    run(
        device, sweep, "costs", grid, put(device, words[0]), put(device, np.stack(words[1:])),
        *i32(width, height), put(device, projections), *i32(n, n_dropped), rho0, step,
        at.wanted, at.first, np.int32(99), buffer, *i32(*grid, stride),
    )  # fmt: skip
    device.read(out, buffer)
    rhos = rho0 + step * np.arange(PLANES)
    want = reference.costs(words[0], words[1:], projections, n_dropped, rhos, stride)
    looked_at = blocks[..., None] >> (np.arange(PLANES) // 8).astype(np.uint32) & np.uint32(1)
    want = np.where(looked_at, want, 99)
    # float32: a projection falls to the other side of a pixel's edge here and there
    assert (at.unpacked(out, 99) == want).mean() > 0.998


@pytest.mark.parametrize("direction", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1)])
@pytest.mark.parametrize("stride", [1, 2])
def test_aggregate(
    device: ComputeDevice, sweep: cl.Program, rng: np.random.Generator,
    direction: tuple[int, int], stride: int,
) -> None:  # fmt: skip
    width, height = 31, 19
    grid = -(-width // stride), -(-height // stride)
    (image,) = pictures(width, height, 1)
    cost = rng.integers(0, 255 - SMALL - LARGE, (grid[1], grid[0], PLANES)).astype(np.uint8)
    at = placed(device, sweep, some_blocks(rng, grid))
    out = rng.integers(0, 9, cost.size).astype(np.uint16)
    before = out.copy()
    buffer = put(device, out)
    for begin in (1, 0):
        run(
            device, sweep, "aggregate", (grid[0] if direction[1] else grid[1],),
            put(device, at.packed(cost)), at.wanted, at.first, buffer, put(device, image),
            *i32(width, *grid, stride, *direction, SMALL, LARGE, SOFT, begin),
        )  # fmt: skip
        device.read(out, buffer)
        grey = np.ascontiguousarray(image[::stride, ::stride])
        want = reference.aggregate(cost, at.there, grey, *direction, SMALL, LARGE, SOFT)
        want = np.where(at.there, want, 0)
        np.testing.assert_array_equal(at.unpacked(out), want if begin else 2 * want)
    assert not np.array_equal(out, before)


def test_winner(device: ComputeDevice, sweep: cl.Program, rng: np.random.Generator) -> None:
    total = rng.integers(200, 2000, (77, PLANES)).astype(np.uint16)
    total[5], total[6, 0], total[7, -1] = 300, 1, 1  # no best, and bests at the ends
    blocks = some_blocks(rng, (77, 1))
    blocks[0, 5:8] = 0b1111
    at = placed(device, sweep, blocks)
    rho, margin = np.zeros(77, np.float32), np.zeros(77, np.float32)
    buffers = put(device, rho), put(device, margin)
    run(
        device, sweep, "winner", (77,), put(device, at.packed(total[None])), at.wanted, at.first,
        *i32(77), np.float32(0.25), np.float32(0.01), *i32(1500), *buffers,
    )  # fmt: skip
    device.read(rho, buffers[0])
    device.read(margin, buffers[1])
    want = reference.winner(total.astype(float), at.there[0], 0.25, 0.01, 1500)
    np.testing.assert_allclose(rho, want[0], atol=1e-6)
    np.testing.assert_allclose(margin, want[1], rtol=1e-5, atol=1e-6)


def test_median(device: ComputeDevice, sweep: cl.Program, rng: np.random.Generator) -> None:
    values = rng.uniform(0, 1, (21, 37)).astype(np.float32)
    out = np.zeros_like(values)
    buffer = put(device, out)
    noise = put(device, out)
    run(device, sweep, "median", (37, 21), put(device, values), *i32(37, 21), buffer, noise)
    device.read(out, buffer)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, 1, mode="edge"), (3, 3))
    np.testing.assert_array_equal(out, np.median(around, axis=(2, 3)))
    device.read(out, noise)
    pairs = [
        (around[..., j, i], around[..., 2 - j, 2 - i]) for j, i in ((0, 0), (0, 1), (0, 2), (1, 0))
    ]
    second = sum(np.abs(a + b - 2 * around[..., 1, 1]) for a, b in pairs)
    np.testing.assert_allclose(out, second / (4 * 1.95), atol=1e-6)


def test_blocks_cover_the_planes_of_coarse_neighbours(
    device: ComputeDevice, sweep: cl.Program, rng: np.random.Generator
) -> None:
    coarse, fine = (17, 11), (33, 21)
    planes = rng.integers(0, PLANES, coarse[::-1])
    rho = (0.1 + 0.02 * planes).astype(np.float32)
    out = np.zeros(fine[::-1], np.uint32)
    buffer = put(device, out)
    run(
        device, sweep, "blocks_about", fine, put(device, rho), *i32(*coarse), np.float32(0.1),
        np.float32(0.02), np.uint32(0b0111), buffer, *i32(*fine),
    )  # fmt: skip
    device.read(out, buffer)
    for y, x in np.ndindex(out.shape):
        for cy, cx in ((y // 2, x // 2), (min((y + 1) // 2, 10), min((x + 1) // 2, 16))):
            block = int(planes[cy, cx]) // 8
            assert out[y, x] >> block & 1 == (block < 3)
    assert not (out >> np.uint32(3)).any()


@pytest.mark.parametrize(("width", "height", "stride"), [(65, 49, 1), (97, 66, 2), (40, 48, 3)])
def test_follow_and_verify(
    device: ComputeDevice, measure: cl.Program, rng: np.random.Generator,
    width: int, height: int, stride: int,
) -> None:  # fmt: skip
    first, second = pictures(width, height, 2)
    (projection,) = some_projections(width, height, 1)
    grid = -(-width // stride), -(-height // stride)
    rho = rng.uniform(1 / 30, 1 / 6, grid[::-1]).astype(np.float32)
    value, change = (put(device, np.zeros(grid[::-1], np.float32)) for _ in range(2))
    rows = [np.ascontiguousarray(row) for row in projection.reshape(3, 4)]
    run(
        device, measure, "follow", (-(-grid[0] // 8), grid[1]), put(device, second),
        *i32(width, height), put(device, rho), *rows, value, change, *i32(*grid, stride),
    )  # fmt: skip
    got = np.zeros((2, grid[1], grid[0]), np.float32)
    for array, buffer in zip(got, (value, change), strict=True):
        device.read(array, buffer)
    want = reference.follow(second.astype(float), projection.astype(float), rho, stride)
    seen = ~np.isnan(want[0])
    assert 0.2 < seen.mean()
    np.testing.assert_array_equal(got[0] > -1e3, seen)
    np.testing.assert_allclose(got[0][seen], want[0][seen], atol=0.02)
    np.testing.assert_allclose(got[1][seen], want[1][seen], atol=0.02)

    grey = np.ascontiguousarray(first[::stride, ::stride]).astype(np.float32)
    counts = np.full((3, grid[1], grid[0]), 3, np.float32)
    good, bad, alike = (put(device, array) for array in counts)
    limits = np.array([0.3, 1.5, 1.5, MOST_APART], np.float32)
    size = (-(-grid[0] // 8), grid[1])
    run(
        device, measure, "verify", size, put(device, grey), value, change, good, bad, alike,
        limits, *i32(*grid),
    )  # fmt: skip
    for array, buffer in zip(counts, (good, bad, alike), strict=True):
        device.read(array, buffer)
    unseen_as_nan = np.where(seen, got[0].astype(float), np.nan)
    fits, fails, like = reference.verify(
        grey.astype(float), unseen_as_nan, got[1], 0.3, 1.5, 1.5, MOST_APART
    )
    assert fits.sum() > 5 and fails.sum() > 5 and 5 < like.sum() < fails.sum() - 5
    np.testing.assert_array_equal(counts[:2].sum(0) - 6, fits + fails)
    assert (counts[0] - 3 == fits).mean() > 0.995  # thresholds fall the other way in float32
    assert (counts[2] - 3 == like).mean() > 0.995


@pytest.mark.parametrize("shape", [(5, 7), (33, 127), (48, 64)])
def test_regularise(
    device: ComputeDevice, rng: np.random.Generator, shape: tuple[int, int]
) -> None:
    events: list[str] = []

    def launch(name: str, kernel: cl.Kernel, size: Any, group: Any, *arguments: Any) -> None:
        kernel.set_args(*arguments)
        whole = tuple(-(-n // g) * g for n, g in zip(size, group, strict=True))
        cl.enqueue_nd_range_kernel(device.queue, kernel, whole, group)
        events.append(name)

    data = rng.uniform(0, 1, shape)
    weight = rng.uniform(0, 20, shape) * (rng.uniform(size=shape) > 0.4)
    edge = rng.uniform(0, 1, shape)
    d, w, e = (a.astype(np.float32) for a in (data, weight, edge))
    out = Regularisation(device, shape[::-1]).run(d, w, e, 12, launch)
    want = reference.regularise(data, data, weight, edge, 12, HUBER)
    np.testing.assert_allclose(out, want, atol=2e-5)  # float32 over a dozen steps
    assert events.count("dual") == events.count("primal") == 12
