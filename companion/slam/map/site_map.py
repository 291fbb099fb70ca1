"""The map of a site that outlives its flight: metric, level, with all that finds it again.

Keyframes, points and their covariances are in the site's world: local NED, metres, about the
origin of the georeference where there is one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Floats
from companion.slam.features.orb_features import Ints
from companion.slam.map.map_part import MapPart, map_of, part_of
from companion.slam.map.map_points import PointArrays
from companion.slam.map.seen import Seen, SeenLater
from companion.slam.map.sparse_map import Keyframe, SlamMap

EARLIER_NS = 4_000_000_000_000_000_000
"""Subtracted from times of keyframes that are not of this flight: no telemetry of now is of them,
also where both flights' clocks begin at nought."""
BORN_EARLIER = -1000
"""Keyframe at which a saved point counts as created: one long before any of now."""
NO_KEYFRAME = -1
BESIDE_PX = 100.0
MIN_KEYFRAMES_ALONE = 3
"""Keyframes of a flight's own in which a camera can be found: neighbours confirm it."""


@dataclass(frozen=True, slots=True, eq=False)
class SitePart:
    """The keyframes that one flight gave: its name, begin, camera, and the map's revision then."""

    flight: str
    began_ns: int
    camera: Camera
    revision: int


@dataclass(frozen=True, slots=True)
class SiteGeoreference:
    """Origin of the site's NED, None where only scale and level are known; standard deviations.

    `sigma_m` is of the place of the whole map, `sigma_scale` relative.
    """

    origin: GeoOrigin | None
    sigma_m: float
    sigma_yaw_rad: float
    sigma_scale: float
    method: str


@dataclass(frozen=True, slots=True, eq=False)
class SiteAccount:
    """A site map but for its keyframes and points: `part_of_id` is the part of each keyframe."""

    revision: int
    parts: tuple[SitePart, ...]
    part_of_id: Mapping[int, int]
    georeference: SiteGeoreference


@dataclass(frozen=True, slots=True, eq=False)
class SiteMap:
    """Keyframes in order of id, which is their index; `point_ids` index `points`.

    `part_of` (K,) is the index in `parts` of each keyframe, `covariances` (P, 3, 3) are of the
    points with all poses known, m2, nan where fewer than two keyframes observe one. Times are of
    each flight's own clock. Of one in a file, features and patches may lie there, and are not
    changed.
    """

    revision: int
    parts: tuple[SitePart, ...]
    keyframes: tuple[Keyframe, ...]
    part_of: Ints
    points: PointArrays
    covariances: Array
    georeference: SiteGeoreference
    scale_factor: float
    n_levels: int
    is_in_file: bool = False

    @property
    def account(self) -> SiteAccount:
        """The site map but for its keyframes and points, which lie in a map once it is in use."""
        ids = (k.keyframe_id for k in self.keyframes)
        part_of_id = dict(zip(ids, self.part_of.tolist(), strict=True))
        return SiteAccount(self.revision, self.parts, part_of_id, self.georeference)


def site_map_of(
    slam_map: SlamMap, world_from_map: Similarity, parts: tuple[SitePart, ...],
    part_of_id: Mapping[int, int], georeference: SiteGeoreference, revision: int,
) -> SiteMap:  # fmt: skip
    """The site map of a whole map with a scale; a copy.

    `part_of_id` is the part of keyframes of earlier flights, by id; all others are of the last.
    """
    part = part_of(slam_map, slam_map.keyframes)
    index = {k.keyframe_id: n for n, k in enumerate(part.keyframes)}
    ids = np.array(list(index), np.int64)
    newest = len(parts) - 1
    keyframes = tuple(
        replace(
            k, keyframe_id=n, camera_from_map=_pose_in_world(k.camera_from_map, world_from_map),
            t_ns=k.t_ns + EARLIER_NS if _is_earlier(k) else k.t_ns,
        )
        for n, k in enumerate(part.keyframes)
    )  # fmt: skip
    points = part.points
    firsts = points.first_seen
    at = np.clip(np.searchsorted(ids, firsts), 0, len(index) - 1)
    known = ids[at] == firsts
    points = points._replace(
        positions=world_from_map.apply(points.positions),
        normals=points.normals @ world_from_map.rotation.T,
        base_distance=points.base_distance * world_from_map.scale,
        first_seen=np.where(known, at, NO_KEYFRAME),
        born=np.full(len(firsts), BORN_EARLIER),
    )
    return SiteMap(
        revision, parts, keyframes,
        np.array([part_of_id.get(key, newest) for key in index], np.int64),
        points, covariances_of(keyframes, points.positions), georeference,
        slam_map.scale_factor, slam_map.n_levels,
    )  # fmt: skip


def slam_map_of(site: SiteMap, camera: Camera) -> SlamMap:
    """A map that holds its keyframes, as of an earlier flight; ids are those of the site map.

    All is as seen by a camera, by directions where another one saw it.
    """
    # a corner is seen at the pyramid level that fits its distance and the focal length
    longer = camera.focal_px / site.parts[-1].camera.focal_px
    points = site.points._replace(base_distance=site.points.base_distance * longer)
    is_same = [part.camera.sees_as(camera) for part in site.parts]
    # attitudes of another flight had another mount and heading: what is known now corrects none
    earlier = tuple(
        replace(
            k, ned_from_camera=None,
            refined_for=k.refined_for if k.is_far else k.refined_for.copy(),
            seen=k.seen_apart if k.is_far and is_same[part] else _seen_by(camera, k),
        )
        for k, part in zip(site.keyframes, site.part_of.tolist(), strict=True)
    )  # fmt: skip
    first = earlier[0].keyframe_id if earlier else NO_KEYFRAME
    whole = MapPart(first, True, earlier, points, site.is_in_file)
    slam_map = map_of(whole, site.scale_factor, site.n_levels, -EARLIER_NS)
    slam_map.held = frozenset(slam_map.keyframes)
    counted = slam_map.n_observers[: slam_map.n_points]
    slam_map.alive[: slam_map.n_points] = counted >= 2  # of a map that was read in part
    for keyframe in slam_map.keyframes.values():
        if keyframe.is_far:
            slam_map.leave_behind(keyframe)
    return slam_map


def _seen_by(camera: Camera, keyframe: Keyframe) -> Seen | SeenLater:
    """View of a keyframe, at the pixels where a camera sees it."""
    seen = keyframe.seen_apart

    def read() -> Seen:
        pixels = pixels_of(camera, seen.normalised)
        return Seen(replace(seen.features, pixels=pixels), seen.normalised, seen.whitening)

    return SeenLater(read) if keyframe.is_far else read()


def of_this_flight(part: MapPart) -> MapPart | None:
    """The part of a map without keyframes of an earlier flight; None where too little is left.

    What but one keyframe of this flight observes stays: it will be seen again.
    """
    own = tuple(k for k in part.keyframes if not _is_earlier(k))
    return replace(part, keyframes=own) if len(own) >= MIN_KEYFRAMES_ALONE else None


def _is_earlier(keyframe: Keyframe) -> bool:
    return keyframe.t_ns < -EARLIER_NS // 2


def pixels_of(camera: Camera, normalised: Array) -> Floats:
    """Pixels (N, 2) of directions; of those far out of the image some place beside it."""
    directions = np.ones((len(normalised), 3))
    directions[:, :2] = normalised
    seen = camera.project(directions)
    size = np.array([camera.width, camera.height])
    return np.asarray(np.clip(seen, -BESIDE_PX, size + BESIDE_PX), np.float32)


def covariances_of(keyframes: tuple[Keyframe, ...], positions: Array) -> Array:
    """Covariances (P, 3, 3) of points by their observations, with all poses known; nan if unknown.

    The information of an image point is J^T J, J its whitened derivative by the point.
    """
    information = np.zeros((len(positions), 3, 3))
    counts = np.zeros(len(positions), np.int64)
    for keyframe in keyframes:
        features = np.flatnonzero(keyframe.point_ids >= 0)
        ids = keyframe.point_ids[features]
        seen = keyframe.camera_from_map.apply(positions[ids])
        depth = np.where(seen[:, 2] > 0, seen[:, 2], np.inf)
        projection = np.zeros((len(ids), 2, 3))
        projection[:, 0, 0] = projection[:, 1, 1] = 1.0 / depth
        projection[:, :, 2] = -seen[:, :2] / depth[:, None] ** 2
        jacobian = keyframe.whitening[features] @ projection @ keyframe.camera_from_map.rotation
        np.add.at(information, ids, jacobian.transpose(0, 2, 1) @ jacobian)
        np.add.at(counts, ids, 1)
    out = np.full((len(positions), 3, 3), np.nan)
    determined = np.flatnonzero((counts >= 2) & (np.linalg.det(information) > 0))
    out[determined] = np.linalg.inv(information[determined])
    return out


def _pose_in_world(camera_from_map: Pose, world_from_map: Similarity) -> Pose:
    return world_from_map.apply_to_pose(camera_from_map.inverse()).inverse()
