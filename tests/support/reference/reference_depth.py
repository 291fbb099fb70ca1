"""The dense engine's kernels in plain numpy: slow, and easy to check by eye."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.geometry.transforms import Array

UNRELATED = 12
Real = NDArray[np.floating]


def census(image: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """A word for each pixel: bit n is whether the n-th of its 24 neighbours is brighter."""
    height, width = image.shape
    padded = np.pad(image, 2, mode="edge")
    out = np.zeros(image.shape, np.uint32)
    n = 0
    for j in range(5):
        for i in range(5):
            if (j, i) != (2, 2):
                brighter = padded[j : j + height, i : i + width] > image
                out |= brighter.astype(np.uint32) << np.uint32(n)
                n += 1
    return out


def project(projection: Real, x: float, y: float, rho: Real) -> tuple[Array, Array, Array]:
    """Where a pixel of the reference is seen at inverse depths, and the third component there."""
    rows = projection.reshape(3, 4)
    q = rows[:, :3] @ np.array([x, y, 1.0])
    points = q[:, None] + rows[:, 3:] * rho
    with np.errstate(divide="ignore", invalid="ignore"):
        return points[0] / points[2], points[1] / points[2], points[2]


def costs(
    words_r: NDArray[np.uint32], words: list[NDArray[np.uint32]], projections: Real,
    n_dropped: int, rhos: Real, stride: int,
) -> NDArray[np.uint8]:  # fmt: skip
    """Cost (grid height, grid width, planes) when all planes are looked at."""
    height, width = words_r.shape
    out = np.zeros((-(-height // stride), -(-width // stride), len(rhos)), np.uint8)
    for gy, gx in np.ndindex(out.shape[:2]):
        word = words_r[gy * stride, gx * stride]
        bits = np.full((len(words), len(rhos)), UNRELATED)
        told = np.zeros(bits.shape, bool)
        for k, projection in enumerate(projections):
            u, v, z = project(projection, gx * stride, gy * stride, rhos)
            with np.errstate(invalid="ignore"):
                iu, iv = np.floor(u + 0.5), np.floor(v + 0.5)
                seen = (z > 1e-6) & (iu >= 0) & (iv >= 0) & (iu < width) & (iv < height)
            for p in np.flatnonzero(seen):
                other = int(words[k][int(iv[p]), int(iu[p])])
                bits[k, p] = bin(other ^ int(word)).count("1")
            told[k] = seen
        counted = len(words) - n_dropped
        out[gy, gx] = np.sort(bits, axis=0)[:counted].sum(0)
        few = (told.sum(0) > 0) & (told.sum(0) < counted)
        mean = np.mean(bits[:, few], axis=0, where=told[:, few])
        out[gy, gx, few] = np.floor(counted * mean + 0.5)
    return out


def stored(blocks: NDArray[np.uint32], planes: int) -> NDArray[np.bool_]:
    """Planes (H, W, planes) that are stored: those of vectors of 16 with a wanted block of 8."""
    vector = np.arange(planes) // 16
    return (blocks[..., None] >> (2 * vector).astype(np.uint32) & np.uint32(3)) > 0


def aggregate(
    cost: NDArray[np.uint8], there: NDArray[np.bool_], grey: NDArray[np.uint8], dx: int, dy: int,
    small: int, large: int, soft: int,
) -> Array:  # fmt: skip
    """The path costs (H, W, planes) of one direction; `grey` (H, W) is on the grid.

    `there` tells which are stored; 255 - small stands for others.
    """
    height, width, _ = cost.shape
    out = np.zeros(cost.shape)
    for start in range(width if dy else height):
        x = start if dy else (0 if dx > 0 else width - 1)
        y = start if not dy else (0 if dy > 0 else height - 1)
        last: tuple[int, int] | None = None
        for _ in range(height if dy else width):
            now = cost[y, x].astype(float)
            if last is not None:
                path = out[last]
                low = path[there[last]].min()
                edge = abs(int(grey[y, x]) - int(grey[last]))
                jump = min(255, low + max(small, large * soft // (soft + edge)))
                side = np.minimum(np.r_[np.inf, path[:-1]], np.r_[path[1:], np.inf]) + small
                now = now + np.minimum(np.minimum(path, side), jump) - low
            out[y, x] = np.where(there[y, x], now, 255 - small)
            last = (y, x)
            x, y = x + dx, y + dy
            if dy and not 0 <= x < width:
                x, last = x % width, None
    return out


def winner(
    total: Array, there: NDArray[np.bool_], rho0: float, step: float, most: float
) -> tuple[Array, Array]:
    """Inverse depth and margin of sums (N, planes), of those that are stored."""
    rho, margin = np.zeros(len(total)), np.zeros(len(total))
    planes = np.arange(total.shape[1])
    for i, s in enumerate(total):
        at = int(np.where(there[i], s, np.inf).argmin())
        shift = 0.0
        beside = 0 < at < len(s) - 1 and there[i, at - 1] and there[i, at + 1]
        if beside and s[at - 1] + s[at + 1] > 2 * s[at]:
            shift = 0.5 * (s[at - 1] - s[at + 1]) / (s[at - 1] + s[at + 1] - 2 * s[at])
        rho[i] = rho0 + step * (at + shift)
        others = s[there[i] & (np.abs(planes - at) > 2)].min(initial=most)
        margin[i] = (others - s[at]) / (s[at] + 1)
    return rho, margin


def sample(image: Array, x: Array, y: Array) -> Array:
    """Bilinear, at positions that lie inside."""
    ix, iy = x.astype(int), y.astype(int)
    fx, fy = x - ix, y - iy
    top = image[iy, ix] * (1 - fx) + image[iy, ix + 1] * fx
    bottom = image[iy + 1, ix] * (1 - fx) + image[iy + 1, ix + 1] * fx
    out: Array = top * (1 - fy) + bottom * fy
    return out


def follow(image: Array, projection: Real, rho: Real, stride: int) -> tuple[Array, Array]:
    """Value (nan where unseen) and change along the epipolar line of each grid pixel (H, W)."""
    height, width = image.shape
    m = projection.reshape(3, 4)
    gy, gx = np.indices(rho.shape).astype(float) * stride
    q = np.stack([gx, gy, np.ones(rho.shape)], -1) @ m[:, :3].T + rho[..., None] * m[:, 3]
    u, v = q[..., 0] / q[..., 2], q[..., 1] / q[..., 2]
    along = np.stack([m[0, 3] - u * m[2, 3], m[1, 3] - v * m[2, 3]], -1) / q[..., 2:]
    half = 0.5 * along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    seen = (q[..., 2] > 1e-6) & (u >= 1) & (v >= 1) & (u < width - 2) & (v < height - 2)
    value, change = np.full(rho.shape, np.nan), np.zeros(rho.shape)
    su, sv, e = u[seen], v[seen], half[seen]
    before = sample(image, su - e[:, 0], sv - e[:, 1])
    behind = sample(image, su + e[:, 0], sv + e[:, 1])
    value[seen], change[seen] = 0.5 * (before + behind), behind - before
    return value, change


def verify(
    reference: Array, value: Array, change: Array, least: float, noise: float, furthest_px: float,
    most_apart: float,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Whether one image fits (H, W), and whether it does not, by least squares over 5 x 5.

    And whether one that does not is alike: squared differences that sum to less than `most_apart`.
    """
    good, bad, alike = (np.zeros(reference.shape) for _ in range(3))
    for y in range(2, reference.shape[0] - 2):
        for x in range(2, reference.shape[1] - 2):
            window = slice(y - 2, y + 3), slice(x - 2, x + 3)
            t = reference[window].ravel()
            w, d = value[window].ravel(), change[window].ravel()
            t = t - t.mean()
            energy = float(t @ t)
            if np.isnan(w).any() or energy <= 25 * noise**2:
                continue
            design = np.stack([w - w.mean(), d - d.mean()], 1)
            (gain, slope), *_ = np.linalg.lstsq(design, t, rcond=None)
            explained = float(t @ (design @ [gain, slope]))
            fits = explained > least**2 * energy and 0.25 < gain < 4.0
            fits = fits and abs(slope / gain) < furthest_px
            good[y, x], bad[y, x] = fits, not fits
            apart = float(((t - (w - w.mean())) ** 2).sum())
            alike[y, x] = not fits and apart < most_apart
    return good, bad, alike


def regularise(
    start: Array, data: Array, weight: Array, edge: Array, iterations: int, huber: float
) -> Array:
    """Huber-TV by Chambolle & Pock's primal-dual steps, all arrays (H, W)."""
    step = 1.0 / np.sqrt(8.0)
    x, bar = start.copy(), start.copy()
    p = np.zeros((*x.shape, 2))
    for _ in range(iterations):
        gradient = np.zeros_like(p)
        gradient[:, :-1, 0] = np.diff(bar, axis=1)
        gradient[:-1, :, 1] = np.diff(bar, axis=0)
        p = (p + step * edge[..., None] * gradient) / (1 + step * huber)
        p = p / np.maximum(1.0, np.linalg.norm(p, axis=-1, keepdims=True))
        flow = edge[..., None] * p
        divergence = np.zeros_like(x)
        divergence[:, :-1] += flow[:, :-1, 0]
        divergence[:, 1:] -= flow[:, :-1, 0]
        divergence[:-1] += flow[:-1, :, 1]
        divergence[1:] -= flow[:-1, :, 1]
        new = (x + step * (divergence + weight * data)) / (1 + step * weight)
        bar = 2 * new - x
        x = new
    return x
