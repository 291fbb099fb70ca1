"""The map of an earlier flight, as localisation uses it: found, taken over, compared, left."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.georeference.segment_georeference import SegmentGeoreferences
from companion.estimation.site.site_of_flight import site_of_flight
from companion.estimation.site.site_use import SiteUse
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Warned
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.map.site_map import SiteMap
from companion.slam.map.sparse_map import SlamMap
from companion.slam.tracking.tracker import Tracker

COMPARE_EVERY_NS = 1_000_000_000
"""Longer than positions come late."""


class SiteInFlight:
    """A site map between tracker and georeferences; before the first frame, with the map lock."""

    def __init__(
        self, use: SiteUse | None, tracker: Tracker, georeferencer: Georeferencer,
        georeferences: SegmentGeoreferences,
    ) -> None:  # fmt: skip
        self._use, self._tracker = use, tracker
        self._georeferencer, self._georeferences = georeferencer, georeferences
        self._place: tuple[int, Array] | None = None
        """Place of the camera, NED metres, that is to be compared."""
        if use is not None:
            tracker.use_site(use.slam_map, use.places)
            tracker.atlas.on_merge = self._merged
            georeferences.hold(use.slam_map, use.georeference)

    @property
    def in_use(self) -> bool:
        """True with a site map."""
        return self._use is not None

    def take_origin(self, origin: GeoOrigin) -> None:
        """Place the map about the origin of local NED."""
        if self._use is None:
            return
        moved = self._use.set_origin(origin)
        if moved is not None:
            self._georeferences.move_held(moved)

    def allowed(self, found: LoopClosure) -> bool | None:
        """True if measurements do not contradict the map; None of a loop that is not with it."""
        if self._use is None or found.there is not self._use.slam_map:
            return None
        return self._use.allowed(
            found, self._georeferences.of(self._tracker.map),
            self._georeferencer.path.place_at(found.keyframe.t_ns),
        )  # fmt: skip

    def frame(self, t_ns: int, map_from_camera: Pose | None) -> Iterator[Warned]:
        """Warnings after a frame, with its pose in the newest map, None while lost."""
        if self._use is None:
            return
        if self._use.located:
            self._compare(self._use, t_ns, map_from_camera)
        yield from self._use.warnings(t_ns)

    def site_map(
        self, segments: Sequence[SlamMap], camera: Camera, flight: str, origin: GeoOrigin | None
    ) -> SiteMap | None:
        """The site map that the flight leaves; see `site_of_flight`."""
        placed = ((segment, self._georeferences.of(segment)) for segment in segments)
        metric = [(segment, found) for segment, found in placed if found is not None]
        used = None if self._use is None else self._use.left
        return site_of_flight(metric, camera, flight, origin, used)

    def _compare(self, use: SiteUse, t_ns: int, map_from_camera: Pose | None) -> None:
        """Compare a place with what the autopilot measured then, which is known somewhat later.

        Not of keyframes: a flight in a known map makes none.
        """
        if self._place is not None and t_ns - self._place[0] >= COMPARE_EVERY_NS:
            at_ns, place_m = self._place
            self._place = None
            if use.compare(place_m, self._georeferencer.path.place_at(at_ns)):
                self._georeferences.give_up_place()
        placed = self._georeferences.of(self._tracker.map)
        measured = self._georeferences.scale_of_held
        if placed is not None and measured is not None and use.compare_scale(placed, measured):
            self._georeferences.release()
            return
        if self._place is None and placed is not None and map_from_camera is not None:
            self._place = t_ns, placed.world_from_map.apply(map_from_camera.translation)

    def _merged(self, here: SlamMap, there: SlamMap, here_from_there: Similarity) -> None:
        self._georeferences.merged(here, there, here_from_there)
        if self._use is not None and there is self._use.slam_map:
            self._use.locate()
