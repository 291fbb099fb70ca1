"""Textures of the drawn ground, seamless: pebbles and tufts of all sizes, or photographs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from companion.geometry.transforms import Array
from companion.messages import Bytes, Floats

GROUND_PX, GRAIN_PX = 4096, 2048
LARGE_PX = 127
PALETTE = np.array([[104, 84, 62], [138, 122, 98], [92, 104, 60], [120, 116, 108]], np.float64)
"""Soil, dry soil, grass, gravel, as RGB."""
CONTRAST = 1.15
TILES = 3
"""Photographs along a side of the ground: 33 m is about what one of a low survey flight shows."""
SEAM_PX = 96
"""Width over which neighbouring photographs go over into each other."""
BRIGHT = 0.42
"""Mean of a photograph as a share of white: as an exposure control would have it."""


def octaves(rng: np.random.Generator, size: int, first: int, last: int, slope: float) -> Floats:
    """Smooth noise (size, size) of mean 0 and deviation 1, with 2**first to 2**last cells a side.

    The amplitude of each octave is that of the one before, divided by 2**slope.
    """
    out = np.zeros((size, size), np.float32)
    for octave in range(first, last + 1):
        n, pad = 2**octave, 2
        cells = np.pad(rng.normal(size=(n, n)).astype(np.float32), pad, mode="wrap")
        full = size * (n + 2 * pad) // n
        edge = size * pad // n
        smooth = cv2.resize(cells, (full, full), interpolation=cv2.INTER_CUBIC)
        out += smooth[edge : edge + size, edge : edge + size] * 2.0 ** (-slope * (octave - first))
    return np.asarray((out - out.mean()) / out.std(), np.float32)


def ground_texture(seed: int, photos: Path | None = None) -> Bytes:
    """The whole ground as RGB (GROUND_PX, GROUND_PX, 3)."""
    rng = np.random.default_rng(seed)
    if photos is not None:
        return _of_photographs(rng, photos)
    size = GROUND_PX
    patches = np.stack([octaves(rng, size // 8, 1, 6, 0.6) for _ in PALETTE], -1)
    share = np.exp(2.0 * patches)
    share /= share.sum(-1, keepdims=True)
    coarse = (share @ PALETTE).astype(np.float32)
    out = np.asarray(cv2.resize(coarse, (size, size), interpolation=cv2.INTER_LINEAR), np.uint8)

    def colour(place: Array) -> Array:
        row, column = (place.astype(int) % size) // 8
        # each of its own shade, and somewhat of its own hue
        shade = rng.normal(1.0, 0.2) * (1.0 + rng.normal(0.0, 0.04, 3))
        return np.asarray(coarse[row, column] * shade, np.float64)

    _scatter(rng, out, 26000, (1.5, 60.0), colour)
    fine = octaves(rng, size, 8, 11, 0.3) * 12.0 + octaves(rng, size, 3, 8, 0.4) * 10.0
    for row in range(0, size, 512):  # in parts, for the memory
        part = out[row : row + 512].astype(np.float32) + fine[row : row + 512, :, None]
        out[row : row + 512] = np.clip((part - 105.0) * CONTRAST + 105.0, 0, 255)
    return out


def grain_texture(seed: int) -> Bytes:
    """Grey grain of mean 128 (GRAIN_PX, GRAIN_PX): stones from 1 to 24 texels among sand."""
    rng = np.random.default_rng(seed + 1)
    out = np.full((GRAIN_PX, GRAIN_PX, 1), 120, np.uint8)
    _scatter(rng, out, 30000, (1.5, 24.0), lambda _: rng.normal(128.0, 42.0, 1))
    grey = out[..., 0].astype(np.float32) + octaves(rng, GRAIN_PX, 6, 11, 0.1) * 21.0
    # nothing that is large: of a pattern that is repeated it is what one would see from afar
    wide = np.pad(grey, 3 * LARGE_PX, mode="wrap")
    large = cv2.blur(cv2.blur(wide, (LARGE_PX, LARGE_PX)), (LARGE_PX, LARGE_PX))
    large = large[3 * LARGE_PX : -3 * LARGE_PX, 3 * LARGE_PX : -3 * LARGE_PX]
    return np.asarray(np.clip(grey - large + 128.0, 0, 255), np.uint8)


def _scatter(
    rng: np.random.Generator,
    out: Bytes,
    count: int,
    radii_px: tuple[float, float],
    colour: Callable[[Array], Array],
) -> None:
    """Draw ellipses over each other, the large ones first; as many per octave as cover alike."""
    low, high = radii_px
    uniform = rng.random(count)
    radii = np.sort(low / np.sqrt(1.0 - uniform * (1.0 - (low / high) ** 2)))[::-1]
    size = out.shape[0]
    for radius in radii:
        place = rng.uniform(0, size, 2)
        flat, turn = rng.uniform(0.4, 1.0), rng.uniform(0, 180)
        value = [float(v) for v in np.clip(colour(place), 0, 255)]
        reach = radius + 2
        for down in (0, -size, size):
            for right in (0, -size, size):
                y, x = place[0] + down, place[1] + right
                if -reach < y < size + reach and -reach < x < size + reach:
                    centre = round(16 * x), round(16 * y)
                    axes = round(16 * radius), round(16 * radius * flat)
                    cv2.ellipse(out, centre, axes, turn, 0, 360, value, -1, cv2.LINE_AA, 4)


def _of_photographs(rng: np.random.Generator, folder: Path) -> Bytes:
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    if not paths:
        raise FileNotFoundError(f"{folder}: there are no photographs in it")
    picked = [paths[k] for k in rng.permutation(len(paths))]
    side = GROUND_PX // TILES + 1
    total = np.zeros((GROUND_PX, GROUND_PX, 3), np.float32)
    weights = np.zeros((GROUND_PX, GROUND_PX, 1), np.float32)
    ramp = np.minimum(np.arange(side + SEAM_PX) + 1, SEAM_PX) / SEAM_PX
    ramp = np.minimum(ramp, ramp[::-1]).astype(np.float32)
    weight = (ramp[:, None] * ramp[None])[..., None]
    for k in range(TILES**2):
        tile = _square(picked[k % len(picked)], side + SEAM_PX)
        rows, columns = (
            (np.arange(side + SEAM_PX) + each * side) % GROUND_PX for each in divmod(k, TILES)
        )
        total[np.ix_(rows, columns)] += tile * weight
        weights[np.ix_(rows, columns)] += weight
    return np.asarray(np.clip(total / weights, 0, 255), np.uint8)


def _square(path: Path, side: int) -> Floats:
    """The middle of a photograph as RGB (side, side, 3), as bright as the others."""
    read = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if read is None:
        raise OSError(f"{path}: it is no photograph")
    height, width = read.shape[:2]
    edge = min(height, width)
    top, left = (height - edge) // 2, (width - edge) // 2
    cut = read[top : top + edge, left : left + edge, ::-1]
    tile = cv2.resize(cut, (side, side), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    power = np.log(BRIGHT) / np.log(np.clip(tile.mean(), 0.05, 0.95))
    return np.asarray(255.0 * tile**power, np.float32)
