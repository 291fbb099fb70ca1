"""Frames of a film: the cloud as it grows, the path, the picture beside them, and what they are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from companion.errors import InputError
from companion.geometry.transforms import Array
from companion.messages import Bytes
from companion.products.export.flight_pictures import camera_of
from companion.products.film.first_seen import first_seen_ns
from companion.products.film.scene_drawing import (
    Viewpoint,
    draw_camera,
    draw_path,
    draw_points,
)
from companion.products.report.cloud_views import oblique_heading_rad
from companion.products.report.report_page import path_segments
from companion.products.run_folder import FinishedRun

TURN_RAD = np.radians(50.0)
"""The view turns by so much from beginning to end."""
DOWN_RAD = np.radians(38.0)
IN_VIEW = 0.998
"""Share of points and path that lie in the picture, and under no inset or words, all the time."""
ACROSS = 0.4
"""The middle lies left of the picture's, at this share of the width, to make room for the inset."""
INSET_SHARE = 0.34
"""Width of the picture, of the film's."""
MARGIN_SHARE = 0.018
LINE_SHARE, WORDS_SHARE = 26 / 720, 0.2
"""Height of a line of words, of the film's, and width of the longest, of the film's."""
INK, SOFT = (236, 238, 241), (150, 157, 166)
AFTERWARDS_S = 2.0
"""The whole is shown for so long at the end."""
N_SPACING = 2000


@dataclass(frozen=True, slots=True)
class FilmSize:
    """Pixels of the film, its frames a second, and its length in seconds."""

    width: int = 1280
    height: int = 720
    rate_hz: int = 25
    length_s: float = 30.0


def film_frames(
    run: FinishedRun, pictures: Iterable[tuple[int, Bytes]], size: FilmSize
) -> Iterator[Bytes]:
    """Frames (H, W, 3) of the film; `pictures` are the flight's, with times, in order.

    The flight takes `length_s` but for the last seconds. InputError where the run has no path or
    no cloud.
    """
    if len(run.poses) < 2 or len(run.cloud) < 4:
        raise InputError(f"{run.path}: it has no path or no cloud to be shown")
    n = max(round(size.length_s * size.rate_hz), 2)
    n_flown = max(n - round(AFTERWARDS_S * size.rate_hz), 1)
    first, last = run.poses[0].t_ns, run.poses[-1].t_ns
    times = first + (last - first) * np.minimum(np.arange(n) / max(n_flown - 1, 1), 1.0)
    scene = _Scene(run, size)
    shown = _newest(pictures, times)
    for k, (t_ns, picture) in enumerate(zip(times, shown, strict=True)):
        yield scene.frame(float(t_ns), k / (n - 1), picture)


class _Scene:
    def __init__(self, run: FinishedRun, size: FilmSize) -> None:
        self._run, self._size = run, size
        cloud = run.cloud
        self._points = cloud.points.astype(np.float64)
        self._seen_ns = first_seen_ns(cloud, run.poses, camera_of(run))
        places = np.stack([pose.world_from_camera.translation for pose in run.poses])
        low, high = np.percentile(self._points, [1, 99], axis=0)
        low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
        self._extent = float(np.linalg.norm(high - low))
        self._middle = (low + high) / 2
        self._heading = oblique_heading_rad(cloud, [places])
        some = self._points[:: max(1, len(cloud) // N_SPACING)]
        self._distance = self._fitting_distance(some, places)
        tree = cKDTree(self._points)
        distance, _ = tree.query(some, k=2)
        self._spacing = float(np.median(distance[:, 1]))
        self._segments = path_segments(run.poses)
        self._t_ns = np.array([pose.t_ns for pose in run.poses])
        flown = np.linalg.norm(np.diff(places, axis=0), axis=1)
        self._flown = np.concatenate([[0.0], np.cumsum(flown)])

    def frame(self, t_ns: float, share: float, picture: Bytes | None) -> Bytes:
        """The frame of a time of the flight; `share` of the film is over."""
        size = self._size
        view = self._view(share, self._distance)
        seen = self._seen_ns <= t_ns
        out = draw_points(
            view, self._points[seen], self._run.cloud.rgb[seen], self._spacing, size.width,
            size.height,
        )  # fmt: skip
        draw_path(out, view, [part[times <= t_ns] for times, part in self._segments])
        at = int(np.searchsorted(self._t_ns, t_ns, side="right")) - 1
        draw_camera(out, view, self._run.poses[at].world_from_camera, 0.035 * self._extent)
        if picture is not None:
            self._inset(out, picture)
        self._words(out, at, int(seen.sum()))
        return out

    def _view(self, share: float, distance: float) -> Viewpoint:
        heading = self._heading + TURN_RAD * (share - 0.5)
        return Viewpoint(self._middle, distance, heading, DOWN_RAD, ACROSS)

    def _fitting_distance(self, *parts: Array) -> float:
        """The nearest distance from which each of the parts (N, 3) is in the picture."""
        width, height = self._size.width, self._size.height
        margin = MARGIN_SHARE * width
        left, bottom = (1 - INSET_SHARE) * width - 2 * margin, 0.75 * INSET_SHARE * width + margin
        words = WORDS_SHARE * width, height - 3.5 * LINE_SHARE * height - margin
        for distance in self._extent * np.geomspace(0.5, 3, 30):
            shares = []
            for part in parts:
                for share in np.linspace(0, 1, 5):
                    pixels, _ = self._view(share, distance).pixels(part, width, height)
                    inside = ((pixels > margin) & (pixels < [width - margin, height - margin])).all(
                        1
                    )
                    inside &= (pixels[:, 0] < left) | (pixels[:, 1] > bottom)
                    inside &= (pixels[:, 0] > words[0]) | (pixels[:, 1] < words[1])
                    shares.append(inside.mean())
            if min(shares) >= IN_VIEW:
                break
        return float(distance)

    def _inset(self, out: Bytes, picture: Bytes) -> None:
        margin = round(MARGIN_SHARE * self._size.width)
        width = round(INSET_SHARE * self._size.width)
        height = round(width * picture.shape[0] / picture.shape[1])
        small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        right, top = self._size.width - margin, margin
        out[top : top + height, right - width : right] = small
        cv2.rectangle(out, (right - width, top), (right - 1, top + height - 1), (60, 66, 74), 1)

    def _words(self, out: Bytes, at: int, n_points: int) -> None:
        run, unit = self._run, "m" if self._run.metric else "map units"
        place = run.poses[at].world_from_camera.translation
        height = f", {-place[2]:.0f} m up" if run.metric else ""
        lines = [
            f"{(self._t_ns[at] - self._t_ns[0]) * 1e-9:.0f} s",
            f"{self._flown[at]:.0f} {unit} flown{height}",
            f"{n_points:,} points",
        ]
        height_px = self._size.height
        margin = round(MARGIN_SHARE * self._size.width)
        for k, line in enumerate(lines):
            place_px = margin, height_px - margin - round(LINE_SHARE * height_px * (2 - k))
            ink = INK if k == 0 else SOFT
            cv2.putText(
                out, line, place_px, cv2.FONT_HERSHEY_DUPLEX, 0.62 * height_px / 720, ink, 1,
                cv2.LINE_AA,
            )  # fmt: skip


def _newest(
    pictures: Iterable[tuple[int, Bytes]], times: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> Iterator[Bytes | None]:
    """The newest picture at each time; None before the first."""
    source = iter(pictures)
    newest: Bytes | None = None
    ahead = next(source, None)
    for t_ns in times:
        while ahead is not None and ahead[0] <= t_ns:
            newest, ahead = ahead[1], next(source, None)
        yield newest
