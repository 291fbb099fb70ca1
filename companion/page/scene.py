"""Scene for the page: the newest picture with its points, and the map from above.

It comes from the exporter of the daemon, as that of any viewer, and only while somebody looks at
the page: nobody encodes pictures for a page that is not open.
"""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from companion.errors import StreamError
from companion.geometry.transforms import Array, Similarity
from companion.messages import Floats
from companion.streaming.ground_link import GroundLink
from companion.streaming.items import (
    FINE,
    AutopilotPathItem,
    FlightItem,
    Item,
    PathItem,
    PictureItem,
    PlacesItem,
    PointsItem,
    PoseItem,
)
from companion.timing.clock import monotonic_s, wait_s

LOOKED_S = 12.0
"""Time after the last question for which the link stays."""
AGAIN_S = 0.5
LOOPBACK = "127.0.0.1"
MOST_FOUND = 400
"""Tracked points that are shown in a picture."""
POINTS_OF_KEYFRAME = 200
MOST_KEYFRAMES = 2000
"""Keyframes whose points are kept, the newest: eight megabytes."""
MOST_POINTS, MOST_PATH = 6000, 1500
"""Points and positions in one view from above."""
CM = 100


class Scene:
    """Newest state of what is shown; a thread of its own takes what comes.

    `port` gives the port of the exporter of this machine, 0 where there is none.
    """

    def __init__(self, port: Callable[[], int]) -> None:
        self._port = port
        self._lock = threading.Lock()
        self._looked_s = -LOOKED_S
        self._told_picture: tuple[PictureItem | None, bytes] = None, b""
        """A picture and its document, the same for all who look."""
        self._stop = threading.Event()
        self._clear("")
        self._thread = threading.Thread(target=self._run, name="scene", daemon=True)
        self._thread.start()

    def picture_after(self, number: int) -> bytes | None:
        """Newest picture as JSON; None where there is none newer than the one of this number."""
        with self._lock:
            self._looked_s = monotonic_s()
            picture, n = self._picture, self._n_pictures
        if picture is None or n == number:
            return None
        if self._told_picture[0] is not picture:
            self._told_picture = picture, _picture_document(picture, n)
        return self._told_picture[1]

    def from_above(self) -> bytes:
        """Path, points and place as JSON: whole centimetres north and east."""
        with self._lock:
            self._looked_s = monotonic_s()
            world = self._world
            places = dict(self._places)
            strips = {key: list(each.values()) for key, each in self._strips.items()}
            points = dict(self._points)
            autopilot = [self._autopilot[piece] for piece in sorted(self._autopilot)]
            pose = self._pose
        document: dict[str, Any] = {
            "metric": world is not None, "path": [], "points": [], "autopilot": [], "here": None,
        }  # fmt: skip
        if world is not None:
            lines = [
                (world @ place).apply(strip.astype(np.float64))
                for key, pieces in sorted(strips.items())
                if (place := places.get(key)) is not None
                for strip in pieces
            ]
            document["path"] = _thinned_lines(lines)
            document["points"] = _seen(world, places, points)
            document["autopilot"] = _thinned_lines([each.astype(np.float64) for each in autopilot])
            if pose is not None and pose.world_from_camera is not None:
                here = pose.world_from_camera
                ahead = here.rotation[:, 2]
                document["here"] = [
                    *np.rint(here.translation[:2] * CM).astype(int).tolist(),
                    round(float(ahead[0]), 3), round(float(ahead[1]), 3),
                ]  # fmt: skip
                document["height_m"] = pose.height_m
                document["speed_m_s"] = pose.speed_m_s
        return json.dumps(document, separators=(",", ":")).encode()

    def close(self) -> None:
        """End the link; `join` waits for that."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the end."""
        self._thread.join()

    # -- what comes in -----------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop.is_set():
            port = self._port()
            if not port or not self._is_looked_at():
                wait_s(self._stop, AGAIN_S)
                continue
            link = GroundLink(LOOPBACK, port, lambda text: None, again=False)
            over = _Until(self._stop, partial(self._is_wanted, port))
            try:
                for item in link.items(over):
                    self._take(item)
            except StreamError:
                pass  # of another version: there is nothing to show
            wait_s(self._stop, AGAIN_S)

    def _is_wanted(self, port: int) -> bool:
        """False once nobody looks, or another flight is served at another port."""
        return self._is_looked_at() and self._port() == port

    def _is_looked_at(self) -> bool:
        return monotonic_s() - self._looked_s < LOOKED_S

    def _clear(self, flight_id: str) -> None:
        self._flight_id = flight_id
        self._picture: PictureItem | None = None
        self._n_pictures = 0
        self._pose: PoseItem | None = None
        self._world: Similarity | None = None
        self._places: dict[int, Similarity] = {}
        self._strips: dict[int, dict[int, Floats]] = {}
        self._points: dict[int, tuple[Floats, list[int]]] = {}
        self._autopilot: dict[int, Floats] = {}

    def _take(self, item: Item) -> None:
        with self._lock:
            if isinstance(item, FlightItem):
                if item.flight_id != self._flight_id:
                    self._clear(item.flight_id)
            elif isinstance(item, PictureItem):
                self._picture = item
                self._n_pictures += 1
            elif isinstance(item, PoseItem):
                self._pose = item
            elif isinstance(item, PlacesItem):
                self._world = item.world_from_map or self._world
                for keyframe_id, place in item.places.items():
                    if place is None:
                        self._places.pop(keyframe_id, None)
                    else:
                        self._places[keyframe_id] = place
            elif isinstance(item, PathItem):
                self._strips.setdefault(item.keyframe_id, {})[item.piece] = item.strip
            elif isinstance(item, AutopilotPathItem):
                self._autopilot[item.piece] = item.strip
            elif isinstance(item, PointsItem) and item.level != FINE:
                self._keep_points(item)

    def _keep_points(self, item: PointsItem) -> None:
        step = max(1, len(item.points_camera) // POINTS_OF_KEYFRAME)
        rgb = item.rgb[::step].astype(int)
        packed = (rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]).tolist()
        self._points.pop(item.keyframe_id, None)
        self._points[item.keyframe_id] = item.points_camera[::step], packed
        if len(self._points) > MOST_KEYFRAMES:
            del self._points[next(iter(self._points))]


class _Until(threading.Event):
    """An event that is also set once a link is not wanted any more."""

    def __init__(self, stop: threading.Event, is_wanted: Callable[[], bool]) -> None:
        super().__init__()
        self._stop, self._is_wanted = stop, is_wanted

    def is_set(self) -> bool:
        """True at the end of the page, or where the link is not wanted."""
        return self._stop.is_set() or not self._is_wanted()


def _picture_document(picture: PictureItem, number: int) -> bytes:
    found = picture.found_px
    step = max(1, -(-len(found) // MOST_FOUND))
    document = {
        "number": number,
        "n_found": len(found),
        "found": np.rint(found[::step]).astype(int).ravel().tolist(),
        "jpeg": base64.b64encode(picture.jpeg).decode(),
    }
    return json.dumps(document, separators=(",", ":")).encode()


def _thinned_lines(lines: list[Array]) -> list[list[int]]:
    """Lines as flat lists of north and east, cm, thinned to about MOST_PATH positions in all."""
    step = max(1, -(-sum(map(len, lines)) // MOST_PATH))
    out = []
    for line in lines:
        kept = line[::step, :2]
        if len(kept) and step > 1:
            kept = np.concatenate([kept, line[-1:, :2]])
        out.append(np.rint(kept * CM).astype(int).ravel().tolist())
    return out


def _seen(
    world: Similarity, places: dict[int, Similarity], points: dict[int, tuple[Floats, list[int]]]
) -> list[int]:
    """Points as a flat list of north, east (cm) and colour (24 bits)."""
    placed = {key: place for key in points if (place := places.get(key)) is not None}
    n = sum(len(points[key][1]) for key in placed)
    step = max(1, -(-n // MOST_POINTS))
    out: list[int] = []
    for key, place in placed.items():
        in_camera, colours = points[key]
        there = (world @ place).apply(in_camera[::step].astype(np.float64))
        if not np.isfinite(there).all():
            continue
        flat = np.rint(there[:, :2] * CM).astype(int)
        for (north, east), colour in zip(flat.tolist(), colours[::step], strict=True):
            out += (north, east, colour)
    return out
