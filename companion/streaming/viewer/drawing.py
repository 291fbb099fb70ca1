"""Items to Rerun entities. To be called from one thread.

world                       local NED in metres (z down)
  obstacles, free           edges across the line of sight, where the autopilot is told of them
  autopilot/<n>             the autopilot's own path, in pieces
  camera                    the camera now, with its image and the points found in it; not below
                            the map, whose scale no pinhole may have above it
  map                       the map, placed by the georeference
    keyframes/<id>          a keyframe: its points and its piece of the path lie in its own frame,
                            and move with it
    sparse                  the tracker's points (hidden at first)
depth                       depth of the newest keyframe, near is red
earth                       the path and the camera by latitude and longitude
status                      in words
plots/…, log
"""

from __future__ import annotations

from datetime import datetime, timezone

import numpy as np
import rerun as rr

from companion.geometry.geodesy import geodetic_from_ned
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Bytes, Floats
from companion.streaming.frame_jpeg import as_wide
from companion.streaming.items import (
    FINE,
    WHOLE,
    AutopilotPathItem,
    DepthItem,
    FlightItem,
    Item,
    LogItem,
    ObstaclesItem,
    PathItem,
    PictureItem,
    PlacesItem,
    PointsItem,
    PoseItem,
    Shown,
    SparseItem,
    StatusItem,
)
from companion.streaming.status_facts import CURVES
from companion.streaming.viewer.colours import Colours
from companion.streaming.viewer.layout import TIMELINE
from companion.streaming.viewer.status_panel import status_text

IMAGE_PLANE_UNITS = 0.15
WIDTH = 640
"""Width of pictures; smaller ones, of a thin link, are enlarged."""
STATE_LEVEL = {
    Shown.WAITING: 0.0, Shown.LOST: 0.0, Shown.INITIALISING: 1.0, Shown.DEAD_RECKONING: 2.0,
    Shown.TRACKING: 3.0, Shown.STANDING: 3.0,
}  # fmt: skip
PLOTTED = {
    "rate_hz": ("rate", 1.0), "latency_ms": ("latency", 1.0), "link_kbit_s": ("link", 1.0),
    "cpu_share": ("cpu", 100.0), "scale_m": ("scale", 1.0),
    **{name: (name, 1.0) for name in CURVES.values()},
}  # fmt: skip
"""Values that are plotted: name of the plot, and factor."""
SERIES = {
    "height": "m above home", "speed": "m/s", "quality": "% sure", "rate": "poses a second",
    "latency": "ms late", "link": "kbit/s", "cpu": "% busy", "scale": "m per unit of the map",
    "points": "points found",
    "state": "3 tracking or standing, 2 dead reckoning, 1 initialising, 0 lost",
    **{name: kind.schema.curve for kind, name in CURVES.items()},
}  # fmt: skip
COLOUR_PATH = [255, 176, 32]
COLOUR_AUTOPILOT = [120, 150, 255]
COLOUR_FOUND = [80, 230, 120]
COLOUR_FREE = [60, 150, 90]
COLOURS_NEAR = (3.0, [255, 60, 50]), (6.0, [255, 130, 40]), (np.inf, [250, 210, 70])
"""Distances of obstacles, metres, up to which they have a colour: three metres are about what a
multicopter needs to stop from 4 m/s."""
EARTH_EVERY_NS = 500_000_000
EARTH_MOVED_M = 0.2
"""A piece of the path on the earth is drawn again where its keyframe has moved by more: most
keyframes move by millimetres with each adjustment, and a satellite picture is no better."""
NOWHERE = Similarity(1e-6, np.eye(3), np.zeros(3))


class Drawing:
    """Draws items in one recording.

    Live, map entities are static, so that a viewer never holds more than one version; in a file all
    have their time.
    """

    def __init__(self, recording: rr.RecordingStream, *, live: bool, colours: Colours) -> None:
        self._live = live
        self._colours = colours
        self._flight: FlightItem | None = None
        self._places: dict[int, Similarity] = {}
        self._world: Similarity | None = None
        self._strips: dict[int, dict[int, Floats]] = {}
        self._coarse: dict[int, PointsItem] = {}
        self._width = 0
        """Width of the pictures drawn; 0 before the first."""
        self._earth_ns = -(2**63)
        self._earth_m: dict[int, Array] = {}
        """Places (3,) of keyframes in the world whose paths are drawn on the earth."""
        self.go_on_in(recording)

    def go_on_in(self, recording: rr.RecordingStream) -> None:
        """Draw in another recording from now on; repeats the places that later entities need."""
        self._rec = recording
        self._earth_m.clear()
        recording.log("world", rr.ViewCoordinates.FRD, static=True)
        for plot, name in SERIES.items():
            recording.log(f"plots/{plot}", rr.SeriesLines(names=name), static=True)
        if self._world is not None:
            recording.log("world/map", _transform(self._world), static=self._live)
        for keyframe_id, place in self._places.items():
            entity = f"world/map/keyframes/{keyframe_id}"
            recording.log(entity, _transform(place), static=self._live)
        if self._width:
            self._pinhole(self._width)

    def draw(self, item: Item) -> None:
        """Draw one item at its own time."""
        if isinstance(item, FlightItem):
            self._flight = item
            if self._live:
                self._pinhole(min(item.camera.width, WIDTH))
            return
        self._rec.set_time(TIMELINE, timestamp=np.datetime64(item.t_ns, "ns"))
        if isinstance(item, PoseItem):
            self._pose(item)
        elif isinstance(item, PictureItem):
            self._picture(item)
        elif isinstance(item, PlacesItem):
            self._placed(item)
        elif isinstance(item, PointsItem):
            self._points(item)
        elif isinstance(item, PathItem):
            self._path(item)
        elif isinstance(item, AutopilotPathItem):
            self._rec.log(
                f"world/autopilot/{item.piece}", _strips([item.strip], COLOUR_AUTOPILOT),
                static=self._live,
            )  # fmt: skip
        elif isinstance(item, StatusItem):
            self._status(item)
        elif isinstance(item, LogItem):
            level = rr.TextLogLevel.WARN if item.is_warning else rr.TextLogLevel.INFO
            # in the text, since a column of time leaves no room for it
            when = datetime.fromtimestamp(item.t_ns * 1e-9, tz=timezone.utc)
            self._rec.log("log", rr.TextLog(f"{when:%H:%M:%S} {item.text}", level=level))
        elif isinstance(item, DepthItem):
            for kernel, ms in item.kernel_ms.items():
                self._plot(f"kernels/{kernel.replace(' ', '-')}", ms)
            image = rr.EncodedImage(contents=item.image, media_type=item.media_type)
            self._rec.log("depth", image)
        elif isinstance(item, ObstaclesItem):
            self._obstacles(item)
        elif isinstance(item, SparseItem):
            sparse = rr.Points3D(item.points_map, radii=rr.Radius.ui_points(1.0))
            self._rec.log("world/map/sparse", sparse)

    # -- the camera ------------------------------------------------------------------------------

    def _pose(self, item: PoseItem) -> None:
        self._plot("state", STATE_LEVEL[item.shown])
        self._plot("points", item.n_found)
        for name, value in (
            ("quality", item.quality if item.quality >= 0 else None),
            ("height", item.height_m), ("speed", item.speed_m_s),
        ):  # fmt: skip
            if value is not None:
                self._plot(name, value)
        pose = item.world_from_camera
        if pose is not None:
            self._rec.log("world/camera", _transform(Similarity(1.0, *_parts(pose))))
            self._on_earth(item.t_ns, pose)

    def _obstacles(self, item: ObstaclesItem) -> None:
        away_m = np.linalg.norm(item.edges_world.mean(1) - item.eye_world, axis=1)
        colours = [next(c for most_m, c in COLOURS_NEAR if each <= most_m) for each in away_m]
        for name, edges, colour in (
            ("obstacles", item.edges_world, colours), ("free", item.free_world, COLOUR_FREE),
        ):  # fmt: skip
            width = rr.Radius.ui_points(3.0 if name == "obstacles" else 1.5)
            self._rec.log(
                f"world/{name}", rr.LineStrips3D(list(edges), colors=colour or None, radii=width)
            )

    def _picture(self, item: PictureItem) -> None:
        if self._live and self._width and item.width != self._width:
            item = as_wide(item, self._width)
        if item.width != self._width and self._flight is not None:
            self._pinhole(item.width)
        image = rr.EncodedImage(contents=item.jpeg, media_type="image/jpeg")
        self._rec.log("world/camera/image", image)
        found = rr.Points2D(item.found_px, colors=COLOUR_FOUND, radii=rr.Radius.ui_points(2.0))
        self._rec.log("world/camera/image/found", found)

    def _pinhole(self, width: int) -> None:
        """Pinhole of pictures of this width."""
        self._width = width
        assert self._flight is not None
        camera = self._flight.camera
        shrink = width / camera.width
        matrix = camera.matrix()
        matrix[:2, 2] += 0.5  # Rerun has pixel centres at halves
        matrix[:2] *= shrink
        scale = self._world.scale if self._world is not None else 1.0
        pinhole = rr.Pinhole(
            image_from_camera=matrix, resolution=[width, round(camera.height * shrink)],
            camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=IMAGE_PLANE_UNITS * scale,
        )  # fmt: skip
        self._rec.log("world/camera/image", pinhole, static=self._live)

    def _on_earth(self, t_ns: int, pose: Pose) -> None:
        origin = self._flight.origin if self._flight is not None else None
        if origin is None or self._world is None or t_ns - self._earth_ns < EARTH_EVERY_NS:
            return
        self._earth_ns = t_ns
        here = geodetic_from_ned(pose.translation[None], origin)[:, :2]
        self._rec.log(
            "earth/camera", rr.GeoPoints(lat_lon=here, radii=rr.Radius.ui_points(6.0),
                                         colors=COLOUR_FOUND),
        )  # fmt: skip

    # -- the map ---------------------------------------------------------------------------------

    def _placed(self, item: PlacesItem) -> None:
        if item.world_from_map is not None:
            self._world = item.world_from_map
            self._rec.log("world/map", _transform(self._world), static=self._live)
            if self._width:  # the size of the picture in the map follows the scale
                self._pinhole(self._width)
        for keyframe_id, place in item.places.items():
            if place is None:
                self._places.pop(keyframe_id, None)
            else:
                self._places[keyframe_id] = place
            entity = f"world/map/keyframes/{keyframe_id}"
            self._rec.log(entity, _transform(place or NOWHERE), static=self._live)
            if keyframe_id in self._strips and self._moved_on_earth(keyframe_id):
                self._path_on_earth(keyframe_id)

    def _points(self, item: PointsItem) -> None:
        """Points of one level; both levels are merged into one entity, which is cheaper to show."""
        points, rgb, confidence = item.points_camera, item.rgb, item.confidence
        if item.level == FINE:
            coarse = self._coarse.pop(item.keyframe_id, None)
            if coarse is not None:
                points = np.concatenate([coarse.points_camera, points])
                rgb = np.concatenate([coarse.rgb, rgb])
                confidence = np.concatenate([coarse.confidence, confidence])
        elif item.level != WHOLE:
            self._coarse[item.keyframe_id] = item
        place = self._places.get(item.keyframe_id)
        if place is not None and self._world is not None:
            place = self._world @ place
        colours: Bytes = self._colours.of(points, rgb, confidence, place)
        radius = 1.5 if item.level != "coarse" else 2.5
        self._rec.log(
            f"world/map/keyframes/{item.keyframe_id}",
            rr.Points3D(points, colors=colours, radii=rr.Radius.ui_points(radius)),
            static=self._live,
        )

    def _path(self, item: PathItem) -> None:
        strips = self._strips.setdefault(item.keyframe_id, {})
        strips[item.piece] = item.strip
        # mostly there is one; a keyframe that lasts has more, of which only the last grows
        entity = f"world/map/keyframes/{item.keyframe_id}"
        if item.piece != min(strips):
            entity += f"/path/{item.piece}"
        self._rec.log(entity, _strips([item.strip], COLOUR_PATH), static=self._live)
        self._path_on_earth(item.keyframe_id)

    def _moved_on_earth(self, keyframe_id: int) -> bool:
        """True if a keyframe's path is not where it is drawn on the earth."""
        drawn_m, place = self._earth_m.get(keyframe_id), self._places.get(keyframe_id)
        if drawn_m is None or place is None or self._world is None:
            return True
        moved_m = self._world.apply(place.translation) - drawn_m
        return float(np.linalg.norm(moved_m)) > EARTH_MOVED_M

    def _path_on_earth(self, keyframe_id: int) -> None:
        origin = self._flight.origin if self._flight is not None else None
        place = self._places.get(keyframe_id)
        if origin is None or place is None or self._world is None:
            return
        world = self._world @ place
        self._earth_m[keyframe_id] = world.translation
        lines = [
            geodetic_from_ned(world.apply(strip.astype(np.float64)), origin)[:, :2]
            for strip in self._strips[keyframe_id].values()
        ]
        self._rec.log(
            f"earth/path/{keyframe_id}",
            rr.GeoLineStrings(lat_lon=lines, colors=COLOUR_PATH, radii=rr.Radius.ui_points(2.0)),
            static=self._live,
        )

    # -- words and numbers -----------------------------------------------------------------------

    def _status(self, item: StatusItem) -> None:
        name = self._flight.name if self._flight is not None else ""
        text = status_text(item.facts, name)
        self._rec.log("status", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
        for fact, (plot, units) in PLOTTED.items():
            value = item.facts.get(fact)
            if isinstance(value, (int, float)):
                self._plot(plot, value * units)

    def _plot(self, name: str, value: float) -> None:
        self._rec.log(f"plots/{name}", rr.Scalars(float(value)))


def _parts(pose: Pose) -> tuple[Array, Array]:
    return pose.rotation, pose.translation


def _strips(strips: list[Floats], colour: list[int]) -> rr.LineStrips3D:
    return rr.LineStrips3D(strips, colors=colour, radii=rr.Radius.ui_points(1.5))


def _transform(place: Similarity) -> rr.Transform3D:
    """A Rerun transform parent_from_child; a matrix, so that no quaternion order comes in."""
    return rr.Transform3D(translation=place.translation, mat3x3=place.rotation * place.scale)
