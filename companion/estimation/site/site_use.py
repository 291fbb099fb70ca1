"""The map of an earlier flight in use: where it lies in the world of now; contradictions to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from companion.estimation.georeference.trajectory_alignment import Scale
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned, ned_from_geodetic
from companion.geometry.transforms import Array, Similarity
from companion.messages import Georeference, Warned
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.loop.place_recognition import PlaceBlock
from companion.slam.map.site_map import SiteAccount, SiteMap, slam_map_of
from companion.slam.map.sparse_map import SlamMap

MAX_OFF_M = 20.0
"""Satellites and a right map differ by the errors of both, some metres each."""
MIN_SCALE_OFF, SIGMAS_OFF = 0.1, 4.0
"""Relative difference of scales that contradict, at least, and in standard deviations."""
MAX_FOCAL_OFF = 0.01
"""Relative difference of focal lengths of the same camera, calibrated twice."""
N_LOOKED_AT = 50
"""Keyframes of which the errors of features are looked at: tens of thousands of these."""
MAX_MEDIAN_CHI2 = 13.8
"""Of the squared errors of features at their points: what one in a thousand exceeds by chance, and
the median of a right map is 1.4."""
N_COMPARED = 10
"""Keyframes of which features are compared with their points: thousands of observations."""
TIMES_OFF = 3
"""Comparisons in a row that contradict the map before it counts: a filter may leap once."""
LOCATED = "located in the map of an earlier flight"
CONTRADICTED = "the map of an earlier flight is not used"
DOUBTED = "the map of an earlier flight is not where satellites are"
OTHER_CAMERA = "the map of an earlier flight was made with another camera"


class SiteUse:
    """A site map in use, for a flight whose local NED has an origin, None where unknown.

    Of a recorded flight without an origin the map's is its own. One in the air may be told of its
    origin later: until then the map gives it scale and heading only, and is not taken for a place.
    """

    def __init__(
        self, site: SiteMap, camera: Camera, origin: GeoOrigin | None, is_live: bool = False,
        places: Sequence[PlaceBlock] = (),
    ) -> None:  # fmt: skip
        self.site = site.account
        """Keyframes and points are in `slam_map`, and grow old in it."""
        self.slam_map: SlamMap = slam_map_of(site, camera)
        self.places = places
        """Index of its keyframes, none where it has to be made."""
        self.located = self.misplaced = False
        self._n_off = self._n_scale_off = 0
        self._measured: Scale | None = None
        """Scale that was compared last."""
        self._origin, self._is_live = origin, is_live
        self._world_from_site = world_from_site(site.georeference.origin, origin)
        self._to_say: list[tuple[str, str]] = []
        self._said: set[str] = set()
        others = [part for part in site.parts if _is_other(part.camera, camera)]
        if others:
            self._say(
                OTHER_CAMERA,
                f"of {others[-1].flight} it was {_in_words(others[-1].camera)}, and is "
                f"{_in_words(camera)}; directions are compared, not pixels",
            )

    @property
    def georeference(self) -> Georeference:
        """Georeference of the site map in the world of this flight."""
        found = self.site.georeference
        return Georeference(
            self._world_from_site, found.sigma_scale, found.sigma_yaw_rad,
            f"the map of {self.site.parts[0].flight} ({found.method})", len(self.site.part_of_id),
            found.sigma_m, has_origin=not self.misplaced and (
                self._has_both or (found.origin is not None and not self._is_live)
            ),
        )  # fmt: skip

    @property
    def left(self) -> SiteAccount:
        """The map, as the flight is to leave it: without a place that measurements contradict."""
        found = self.site.georeference
        return (
            replace(self.site, georeference=replace(found, origin=None))
            if self.misplaced
            else self.site
        )

    @property
    def _has_both(self) -> bool:
        """True where places of now and of the map can be compared."""
        return self._origin is not None and self.site.georeference.origin is not None

    def set_origin(self, origin: GeoOrigin) -> Similarity | None:
        """Take the origin of the flight's local NED, once; by what the map's world moves."""
        if self._origin is not None or self.site.georeference.origin is None:
            return None
        self._origin = origin
        self._world_from_site = world_from_site(self.site.georeference.origin, origin)
        return self._world_from_site

    def warnings(self, t_ns: int) -> list[Warned]:
        """Warnings since the last call."""
        out = [Warned(t_ns, what, detail, good=what == LOCATED) for what, detail in self._to_say]
        self._to_say.clear()
        return out

    def allowed(
        self, found: LoopClosure, placed: Georeference | None, measured_m: Array | None
    ) -> bool:
        """True if scale and place of now do not contradict a keyframe found in the site map.

        `placed` is the georeference of its map by measurements of this flight, `measured_m` (3,)
        the place of the camera by satellites, NED metres, None where unknown.
        """
        if placed is not None:
            units = self._world_from_site.scale / found.here_from_there.scale
            off = self._scale_off(units, placed.world_from_map.scale, placed.sigma_scale)
            if off is not None:
                self._say(
                    CONTRADICTED, f"its scale is off by {off:.0f} % from that by {placed.method}"
                )
                return False
        if measured_m is not None and self._is_live and self._origin is None:
            return False  # its place is compared as soon as the origin of what is measured is known
        if measured_m is not None and self._has_both:
            there = found.relocalised.camera_from_map.inverse().translation
            off_m = float(np.linalg.norm(self._world_from_site.apply(there) - measured_m))
            if off_m > MAX_OFF_M:
                self._say(CONTRADICTED, f"its place is {off_m:.0f} m from that by the autopilot")
                return False
        return True

    def compare(self, place_m: Array, measured_m: Array | None) -> bool:
        """True once satellites contradict the map after the flight was located in it; it is said.

        `place_m` (3,) is the place of the camera by the map, `measured_m` (3,) the autopilot's,
        None where unknown. Which of them is wrong is not known: the map still gives scale and
        heading, and no place any more.
        """
        if measured_m is None or not self._has_both or self.misplaced:
            return False
        off_m = float(np.linalg.norm(place_m - measured_m))
        self._n_off = self._n_off + 1 if off_m > MAX_OFF_M else 0
        self.misplaced = self._n_off >= TIMES_OFF
        if self.misplaced:
            self._say(DOUBTED, f"its place is {off_m:.0f} m from that by the autopilot")
        return self.misplaced

    def compare_scale(self, placed: Georeference, measured: Scale) -> bool:
        """True once accelerometers contradict the map's scale after the flight was located in it.

        It is said. `placed` is the georeference of the map by the site's, `measured` its scale; one
        counts once. The map is then as one of this flight, and has no place.
        """
        if measured is self._measured or self._n_scale_off == TIMES_OFF:
            return False
        self._measured = measured
        off = self._scale_off(placed.world_from_map.scale, measured.scale, measured.sigma)
        self._n_scale_off = 0 if off is None else self._n_scale_off + 1
        if off is None or self._n_scale_off < TIMES_OFF:  # a young scale may leap
            return False
        self.misplaced = True
        self._say(CONTRADICTED, f"its scale is off by {off:.0f} % from that by {measured.method}")
        return True

    def _scale_off(self, of_site: float, measured: float, sigma: float) -> float | None:
        """Percent by which the map's scale is too large; None where `measured` may be the same."""
        off = float(np.log(of_site / measured))
        sigma = float(np.hypot(sigma, self.site.georeference.sigma_scale))
        contradicts = abs(off) > max(MIN_SCALE_OFF, SIGMAS_OFF * sigma)
        return 100.0 * (float(np.exp(off)) - 1.0) if contradicts else None

    def locate(self) -> None:
        """Note that the flight was found in the map."""
        self.located = True
        parts = ", ".join(part.flight for part in self.site.parts)
        self._say(LOCATED, f"{parts}: {len(self.site.part_of_id)} keyframes")

    def _say(self, what: str, detail: str) -> None:
        if what not in self._said:
            self._said.add(what)
            self._to_say.append((what, detail))


def _is_other(theirs: Camera, ours: Camera) -> bool:
    """True of another camera, or of another lens or size of picture."""
    return (theirs.width, theirs.height, theirs.distortion) != (
        ours.width, ours.height, ours.distortion,
    ) or abs(float(np.log(theirs.focal_px / ours.focal_px))) > MAX_FOCAL_OFF  # fmt: skip


def wrong_metres(site: SiteMap, camera: Camera) -> str:
    """Reason why places in a map would be wrong by a focal length that is a guess; "" if none.

    A calibrated camera of any lens measures directions as the map has them. A guess that is off
    from the focal length of the map moves what it sees at a distance from the centre of the picture
    by that part of the distance, and its heights by as much: it is harmless as long as that is
    below the standard deviation of a feature of the map.
    """
    theirs = site.parts[-1].camera
    if not (theirs.assumed or camera.assumed):
        return ""
    off = abs(float(np.log(theirs.focal_px / camera.focal_px)))
    some = site.keyframes[:: 1 + len(site.keyframes) // N_LOOKED_AT]
    sigmas = np.concatenate([1.0 / k.whitening[:, 0, 0] for k in some])
    away = np.concatenate([np.linalg.norm(k.normalised, axis=1) for k in some])
    allowed = float(np.median(sigmas) / np.sqrt(np.mean(away**2)))
    if off <= allowed:
        return ""
    whose = "its camera's" if theirs.assumed else "the camera's"
    return (
        f"{whose} focal length is a guess, and {theirs.focal_px:.0f} pixels of the map differ from "
        f"{camera.focal_px:.0f} of now by {100 * off:.1f} %, where its features allow "
        f"{100 * allowed:.1f} %: calibrate"
    )


def contradiction(site: SiteMap) -> str:
    """Reason why what a map has seen is not what it says to be there; "" if none.

    Its points are projected into some of its keyframes, and compared with the features there. A map
    that was altered, or put together of two, is found by that.
    """
    chi2 = []
    for keyframe in site.keyframes[:: 1 + len(site.keyframes) // N_COMPARED]:
        seen = keyframe.point_ids >= 0
        points = site.points.positions[keyframe.point_ids[seen]]
        there = keyframe.camera_from_map.apply(points)
        off = keyframe.normalised[seen] - there[:, :2] / there[:, 2:]
        chi2.append((np.einsum("nij,nj->ni", keyframe.whitening[seen], off) ** 2).sum(1))
    found = np.concatenate(chi2)
    if len(found) == 0 or (median := float(np.median(found))) <= MAX_MEDIAN_CHI2:
        return ""
    return (
        f"half of its features are further than {np.sqrt(median):.0f} standard deviations from "
        "the points that they are said to see: it contradicts itself, make another"
    )


def _in_words(camera: Camera) -> str:
    return (
        f"{camera.width}x{camera.height} pixels with {camera.focal_px:.0f} of focal length, "
        f"distortion {camera.distortion.value}"
    )


def world_from_site(site: GeoOrigin | None, world: GeoOrigin | None) -> Similarity:
    """Transform between local NEDs of two origins; the identity where one is unknown.

    Their verticals differ by a second of arc in 30 m: in a site's size that is rounding.
    """
    if site is None or world is None or site == world:
        return Similarity.identity()
    zero = ned_from_geodetic(site.latitude_deg, site.longitude_deg, site.altitude_m, world)
    # the axes of the other tangent plane, by where one metre along each ends
    ends = [
        ned_from_geodetic(latitude_deg, longitude_deg, altitude_m, world) - zero
        for latitude_deg, longitude_deg, altitude_m in geodetic_from_ned(1000.0 * np.eye(3), site)
    ]
    u, _, vt = np.linalg.svd(np.stack(ends, 1) / 1000.0)
    return Similarity(1.0, u @ vt, zero)
