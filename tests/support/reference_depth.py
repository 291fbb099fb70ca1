"""The depth filter's update and regulariser in plain numpy: slow, and easy to check by eye."""

from __future__ import annotations

import numpy as np

from companion.config import DepthConfig
from companion.depth.engine import MAX_STEPS, RADIUS, Intrinsics
from companion.geometry import Array, Pose

OFFSETS = np.arange(-RADIUS, RADIUS + 1, dtype=np.float64)
AREA = (2 * RADIUS + 1) ** 2


def sample(image: Array, x: Array, y: Array) -> Array:
    """Bilinear, at positions that lie inside."""
    ix, iy = x.astype(int), y.astype(int)
    fx, fy = x - ix, y - iy
    top = image[iy, ix] * (1 - fx) + image[iy, ix + 1] * fx
    bottom = image[iy + 1, ix] * (1 - fx) + image[iy + 1, ix + 1] * fx
    out: Array = top * (1 - fy) + bottom * fy
    return out


def correlate(image: Array, template: Array, x: float, y: float) -> float:
    """ZNCC of a normalised template with the patch around (x, y); -1 outside."""
    height, width = image.shape
    left, top = int(x) - RADIUS, int(y) - RADIUS
    side = 2 * RADIUS + 1
    if not (x >= RADIUS and y >= RADIUS and left + side + 1 < width and top + side + 2 < height):
        return -1.0
    dx, dy = np.meshgrid(OFFSETS, OFFSETS)
    patch = sample(image, np.asarray(x + dx), np.asarray(y + dy))
    patch = patch - patch.mean()
    energy = float((patch * patch).sum())
    return float((patch * template).sum() / np.sqrt(energy)) if energy > 1.0 else -1.0


def update_pixel(
    reference: Array, current: Array, u: int, v: int, state: Array, pose: Pose,
    camera: Intrinsics, rho: tuple[float, float], config: DepthConfig,
) -> tuple[Array, int]:  # fmt: skip
    """One pixel's state (mu, sigma^2, a, b) and label after `current` (current_from_reference)."""
    mu, sigma2, a, b = state
    height, width = reference.shape
    reach = 2.5 * np.sqrt(sigma2)
    ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
    q0, t = pose.rotation @ ray, pose.translation

    def place(r: float) -> Array:
        out: Array = q0 + r * t
        return out

    def pixel(q: Array) -> Array:
        return np.array([camera.fx * q[0] / q[2] + camera.cx, camera.fy * q[1] / q[2] + camera.cy])

    low, high, middle = place(max(mu - reach, rho[0])), place(min(mu + reach, rho[1])), place(mu)
    if min(low[2], high[2], middle[2]) < 0.1:
        return state, 0
    begin, end = pixel(low), pixel(high)
    length = float(np.linalg.norm(end - begin))
    if length <= 0.02:
        return state, 0
    direction = (end - begin) / length
    # the derivative of the current pixel by the reference pixel, at depth 1 / mu
    affine = np.empty((2, 2))
    for k, (axis, focal) in enumerate(((0, camera.fx), (1, camera.fy))):
        d = pose.rotation[:, axis] / focal
        affine[0, k] = camera.fx * (d[0] - middle[0] / middle[2] * d[2]) / middle[2]
        affine[1, k] = camera.fy * (d[1] - middle[1] / middle[2] * d[2]) / middle[2]
    if not 0.2 < np.linalg.det(affine) < 5.0:
        return state, 0
    back = np.linalg.inv(affine)
    dx, dy = np.meshgrid(OFFSETS, OFFSETS)
    x = np.clip(u + dx * back[0, 0] + dy * back[0, 1], 0, width - 1.01)
    y = np.clip(v + dx * back[1, 0] + dy * back[1, 1], 0, height - 1.01)
    template = sample(reference, x, y)
    template = template - template.mean()
    energy = float((template * template).sum())
    if energy < AREA * config.noise_grey**2:
        return state, 3
    template = template / np.sqrt(energy)
    steps = max(int(np.ceil(np.float32(length + 2.0))), 4)
    if steps > MAX_STEPS:
        return state, 0
    step = (length + 2.0) / steps
    places = [begin - direction + direction * (k * step) for k in range(steps + 1)]
    scores = np.array([correlate(current, template, *p) for p in places])
    if (scores > -1.0).sum() < 3:
        return state, 0
    at = int(scores.argmax())
    best = float(scores[at])
    if best < config.min_zncc:
        b = b + 0.5
        return np.array([mu, sigma2, a, b]), 2 if a / (a + b) < 0.2 else 0
    far = np.abs(np.arange(steps + 1) - at) > 3
    if far.any() and scores[far].max() > best - config.peak_margin:
        return state, 0
    if at in (0, steps) or min(scores[at - 1], scores[at + 1]) <= -1.0:
        return state, 0
    bend = scores[at - 1] - 2 * best + scores[at + 1]
    if bend / step**2 > -1e-4:
        return state, 0
    shift = np.clip(0.5 * (scores[at - 1] - scores[at + 1]) / bend, -0.5, 0.5)
    found = places[0] + direction * ((at + shift) * step)
    variance = 2 * (1 - min(best, 1.0)) / (AREA * -bend / step**2) + config.pose_error_px**2
    if variance > 1.0:
        return state, 0
    n = np.array([(found[0] - camera.cx) / camera.fx, (found[1] - camera.cy) / camera.fy])
    k = 0 if abs(direction[0]) > abs(direction[1]) else 1
    measured = (n[k] * q0[2] - q0[k]) / (t[k] - n[k] * t[2])
    q = place(measured)
    if not (0.5 * rho[0] < measured < 1.5 * rho[1] and q[2] > 0.1):
        return state, 0
    slope = np.array([camera.fx, camera.fy]) * (t[:2] * q[2] - q[:2] * t[2]) / q[2] ** 2
    tau2 = variance / float(slope @ slope)
    return fuse(state, measured, tau2, rho), -1


def fuse(state: Array, measured: float, tau2: float, rho: tuple[float, float]) -> Array:
    """Gaussian x Beta update (Vogiatzis & Hernandez 2011)."""
    mu, sigma2, a, b = state
    s2 = 1.0 / (1.0 / sigma2 + 1.0 / tau2)
    m = s2 * (mu / sigma2 + measured / tau2)
    spread = sigma2 + tau2
    normal = np.exp(-0.5 * (measured - mu) ** 2 / spread) / np.sqrt(2 * np.pi * spread)
    c1, c2 = a / (a + b) * normal, b / (a + b) / (rho[1] - rho[0])
    c1, c2 = c1 / (c1 + c2), c2 / (c1 + c2)
    f = c1 * (a + 1) / (a + b + 1) + c2 * a / (a + b + 1)
    e = (c1 * (a + 1) * (a + 2) + c2 * a * (a + 1)) / ((a + b + 1) * (a + b + 2))
    new_mu = c1 * m + c2 * mu
    new_sigma2 = c1 * (s2 + m * m) + c2 * (sigma2 + mu * mu) - new_mu**2
    new_a = (e - f) / (f - e / f)
    return np.array([new_mu, new_sigma2, new_a, new_a * (1 - f) / f])


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
