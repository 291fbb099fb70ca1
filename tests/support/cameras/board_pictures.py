"""Pictures of a calibration board through a lens known exactly: rendered, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from companion.calibration.chart import ChessboardChart, parse_chart
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array, rotation_from_vector
from companion.messages import Bytes

RADTAN = Camera(
    640, 480, 520.0, 505.0, 331.0, 228.0, Distortion.RADTAN, (-0.28, 0.09, 0.0012, -0.0008, -0.012)
)
FISHEYE = Camera(
    640, 480, 260.0, 252.0, 309.0, 251.0, Distortion.EQUIDISTANT, (-0.012, 0.006, -0.003, 0.0006)
)
CHARUCO = "charuco:7x5:0.04:0.03:DICT_5X5_100"
CHESSBOARD = "chessboard:9x6:0.025"
MARGIN = 0.4
"""White around the board, in squares."""
PX_PER_SQUARE = 70


@dataclass(frozen=True)
class Placing:
    """Where a board is: its middle at this place of the picture, this wide, tilted and turned."""

    u: float
    v: float
    """Shares of the picture."""
    width: float
    """Of the board as seen squarely, share of the picture's."""
    tilt_right_deg: float = 0.0
    tilt_down_deg: float = 0.0
    turn_deg: float = 0.0
    parallel: bool = False
    """To the picture, whatever the tilts; else these are from where it faces the camera."""


def placings(n: int, *, tilt_deg: float = 35.0, width: float = 0.5, seed: int = 1) -> list[Placing]:
    """A board shown as it should be: in every corner, at the edges, near and far, tilted."""
    rng = np.random.default_rng(seed)
    places = [(u, v) for v in (0.22, 0.5, 0.78) for u in (0.2, 0.5, 0.8)]
    out = []
    for i in range(n):
        u, v = places[i % len(places)]
        about = rng.uniform(-1, 1, 3)
        way = 2 * np.pi * (i * 0.381966)
        out.append(
            Placing(
                u + 0.04 * about[0], v + 0.04 * about[1], width * rng.uniform(0.85, 1.25),
                tilt_deg * np.cos(way), tilt_deg * np.sin(way), 20 * about[2],
            )
        )  # fmt: skip
    return out


class BoardPictures:
    """Renders one board through one camera."""

    def __init__(self, camera: Camera, board: str = CHARUCO, *, seed: int = 7) -> None:
        self.camera = camera
        self._rng = np.random.default_rng(seed)
        self._texture, self._square_m = _texture(board)
        self._size_m = np.array(self._texture.shape[1::-1]) / PX_PER_SQUARE * self._square_m
        # four samples a pixel, against stairs at the edges
        self._rays = _rays(camera)
        self._background: Array = self._scene()

    def picture(
        self, placing: Placing | None, *, blur_px: float = 0.0, noise: float = 2.0,
        bend: float = 0.0,
    ) -> Bytes:  # fmt: skip
        """The board there; None for the scene without it.

        `blur_px` is motion to the right; `bend` bows the board: its sides are behind its middle by
        so many of its widths.
        """
        picture = self._background
        if placing is not None:
            picture = self._with_board(placing, bend)
        size = self.camera.width, self.camera.height
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        small = cv2.GaussianBlur(small, (0, 0), 0.6)
        if blur_px > 1:
            n = round(blur_px)
            small = cv2.filter2D(small, -1, np.full((1, n), 1 / n, np.float32))
        noisy = small + noise * self._rng.standard_normal(small.shape, np.float32)
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)

    def pictures(self, places: Sequence[Placing]) -> list[Bytes]:
        """One for each placing."""
        return [self.picture(placing) for placing in places]

    def _with_board(self, placing: Placing, bend: float) -> Array:
        rotation, shift = self.pose(placing)
        part = self._part_with(rotation, shift)
        # the ray in the board's frame, where it begins at -shift and the sheet is z = depth
        x, y = self._rays[part][..., 0], self._rays[part][..., 1]
        begin = -rotation.T @ shift
        ray = [rotation[0, i] * x + rotation[1, i] * y + rotation[2, i] for i in range(3)]
        ray[2] = np.where(ray[2] > 1e-2, ray[2], np.nan)
        depth: Array | float = 0.0
        across = down = x
        for _ in range(5 if bend else 1):
            along = (depth - begin[2]) / ray[2]
            across, down = begin[0] + along * ray[0], begin[1] + along * ray[1]
            away = np.clip(across / self._size_m[0] - 0.5, -1, 1)
            depth = bend * 4 * self._size_m[0] * away**2
        scale = PX_PER_SQUARE / self._square_m
        u, v = (np.clip(at * scale - 0.5, -99, 1e4) for at in (across, down))
        board = cv2.remap(
            self._texture, np.nan_to_num(u, nan=-9).astype(np.float32),
            np.nan_to_num(v, nan=-9).astype(np.float32), cv2.INTER_LINEAR,
        )  # fmt: skip
        height, width = self._texture.shape
        inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
        picture = self._background.copy()
        picture[part][inside] = board[inside]
        return picture

    def _part_with(self, rotation: Array, shift: Array) -> tuple[slice, slice]:
        """The samples among which the board is, generously."""
        along = np.linspace(-0.1, 1.1, 25)
        edge = np.array([[a, b, 0] for a in along for b in along]) * [*self._size_m, 0]
        pixels = self.camera.project(edge @ rotation.T + shift)
        if not np.isfinite(pixels).all():
            return slice(None), slice(None)
        low = np.maximum(2 * pixels.min(0) - 20, 0).astype(int)
        high = np.maximum(2 * pixels.max(0) + 20, 1).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def pose(self, placing: Placing) -> tuple[Array, Array]:
        """Rotation and shift, camera from board; the board begins with its white margin."""
        camera = self.camera
        middle = np.array([placing.u * camera.width, placing.v * camera.height])
        half = 0.5 * placing.width * min(camera.width, 1.4 * camera.height)
        few = np.array([5.0, 0.0])
        rays = camera.normalise(np.array([middle, middle - few, middle + few]))
        ray = np.append(rays[0], 1.0)
        angle = _angle(rays[1], rays[2]) * half / few[0]
        distance = self._size_m[0] / 2 / np.tan(angle / 2)
        # squarely to the ray, then tilted and turned
        forward = ray / np.linalg.norm(ray)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        facing = np.stack([right, np.cross(forward, right), forward], 1)
        tilts = np.radians([-placing.tilt_down_deg, placing.tilt_right_deg, placing.turn_deg])
        if placing.parallel:
            facing, tilts[:2] = np.eye(3), 0.0
        rotation: Array = facing @ rotation_from_vector(tilts)
        shift: Array = forward * distance - rotation @ np.append(self._size_m / 2, 0)
        return rotation, shift

    def _scene(self) -> Array:
        coarse = self._rng.uniform(60, 190, (9, 12)).astype(np.float32)
        size = (self._rays.shape[1], self._rays.shape[0])
        scene = np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), np.float32)
        return np.where(np.isfinite(self._rays[..., 0]), scene, 0.0).astype(np.float32)


@cache
def well_shown(camera: Camera, board: str, bend: float) -> tuple[Bytes, ...]:
    """Pictures that a calibration can be made of."""
    pictures = BoardPictures(camera, board)
    # a chessboard must be in view as a whole
    n, width = (19, 0.5) if board == CHARUCO else (17, 0.42)
    return tuple(pictures.picture(p, bend=bend) for p in placings(n, width=width))


@cache
def _rays(camera: Camera) -> Array:
    """Ray of each sample, (2 H, 2 W, 2): exact at every fourth, straight between."""
    across, down = (np.arange(n // 2 + 2) * 2.0 for n in (camera.width, camera.height))
    knots = np.stack(np.meshgrid(across, down), -1) - 1.0
    exact = camera.normalise(knots.reshape(-1, 2)).reshape(*knots.shape)
    v, u = np.mgrid[0 : camera.height * 2, 0 : camera.width * 2].astype(np.float32)
    between = cv2.remap(exact, (u / 2 - 0.25 + 1) / 2, (v / 2 - 0.25 + 1) / 2, cv2.INTER_LINEAR)
    return np.asarray(between, np.float64)


@cache
def _texture(board: str) -> tuple[Array, float]:
    """Drawn by other means than the program's own, as far as there are any."""
    chart = parse_chart(board)
    columns, rows = chart.columns + 1, chart.rows + 1
    if isinstance(chart, ChessboardChart):
        squares = (np.indices((rows, columns)).sum(0) % 2).astype(np.uint8) * 255
        image = np.kron(squares, np.ones((PX_PER_SQUARE, PX_PER_SQUARE), np.uint8))
    else:
        _, _, square, marker, dictionary, *legacy = board.split(":")
        drawn = cv2.aruco.CharucoBoard(
            (columns, rows), float(square), float(marker),
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)),
        )  # fmt: skip
        drawn.setLegacyPattern(bool(legacy))
        image = drawn.generateImage((columns * PX_PER_SQUARE, rows * PX_PER_SQUARE))
    margin = round(MARGIN * PX_PER_SQUARE)
    image = cv2.copyMakeBorder(
        image, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    )
    return np.asarray(image, np.float64) * 0.8 + 25, chart.square_m


def _angle(one: Array, other: Array) -> float:
    a, b = np.append(one, 1.0), np.append(other, 1.0)
    return float(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
