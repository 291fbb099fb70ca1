"""Merging of site maps: one is found in the other, and all keyframes are adjusted together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.errors import InputError
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, Similarity, nearest_rotation
from companion.slam.features.orb_features import Ints
from companion.slam.loop.loop_closure import MIN_SHARED, LoopClosure, LoopDetector
from companion.slam.loop.map_merge import merge_maps
from companion.slam.loop.place_recognition import KeyframeDatabase
from companion.slam.loop.relocalizer import Relocalizer
from companion.slam.map.site_flights import ROBUST
from companion.slam.map.site_map import (
    SiteGeoreference,
    SiteMap,
    site_map_of,
    slam_map_of,
)
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import MapLock
from companion.slam.mapping.site_fusion import fuse_sites

ENOUGH_FOUND = 8
"""Confirmed keyframes of which the one with most points places a map: more are no better."""
BINDING_ROUNDS, ITERATIONS = 3, 12
"""Rounds in which keyframes far from where the maps were joined come near enough to be bound."""


def merge_sites(first: SiteMap, other: SiteMap, other_in_first: Similarity) -> SiteMap | None:
    """One map of two, in the world of the first; None where no place of one is seen in the other.

    `other_in_first` takes the second's world to the first's, as their origins have it. Both maps
    are adjusted as one, which then is placed as the two were, each weighted by its variance. The
    first yields: points of both are moved to the corners of the other, and it is bent towards the
    other before all are adjusted. So the other should be the finer one (`pixel_m`).
    InputError where they are bound by one place alone, and that places the other's far end worse
    than the place of both is stated.
    """
    camera = first.parts[0].camera
    here, there = slam_map_of(first, camera), slam_map_of(_numbered(other, first), camera)
    here.held = frozenset()
    found = _found(here, there, camera)
    if found is None:
        return None
    before = [
        _before(first, 0, Similarity.identity()), _before(other, _n_ids(first), other_in_first)
    ]  # fmt: skip
    by_place_m = _sigma_by_place_m(here, found)
    merge_maps(here, there, found.here_from_there)
    mapper = Mapper(camera, here, MapLock())
    for _ in range(BINDING_ROUNDS):
        fuse_sites(here, camera)
        mapper.adjust_all(ITERATIONS)
    here.held = frozenset()
    mapper.adjust_all(ITERATIONS)
    georeference = _both(first.georeference, other.georeference)
    theirs = [k for key, k in here.keyframes.items() if key >= _n_ids(first)]
    ours = [k for key, k in here.keyframes.items() if key < _n_ids(first)]
    if len(shared_points(ours, theirs)) < MIN_SHARED and by_place_m > georeference.sigma_m:
        raise InputError(
            f"the maps meet at one place only, which places the farthest keyframe to "
            f"{by_place_m:.2f} m, and both as one would state {georeference.sigma_m:.2f} m"
        )
    n_first = len(first.parts)
    part_of_id = dict(zip(_ids(first), first.part_of.tolist(), strict=True)) | {
        key + _n_ids(first): n_first + part
        for key, part in zip(_ids(other), other.part_of.tolist(), strict=True)
    }
    revision = max(first.revision, other.revision) + 1
    newer = tuple(replace(part, revision=revision) for part in other.parts)
    return site_map_of(
        here, _placed(here, before), (*first.parts, *newer), part_of_id, georeference,
        revision,
    )  # fmt: skip


def shared_points(ours: Sequence[Keyframe], theirs: Sequence[Keyframe]) -> Ints:
    """Points that keyframes of both observe: below `MIN_SHARED` no patches bind the two."""
    seen, seen_there = (np.concatenate([k.point_ids for k in each]) for each in (ours, theirs))
    both = np.intersect1d(seen, seen_there)
    return np.asarray(both[both >= 0])


def _sigma_by_place_m(here: SlamMap, found: LoopClosure) -> float:
    """Standard deviation of the other map's farthest keyframe, of one axis, by one place alone.

    That of a similarity fitted to the points seen there from both maps: they disagree by some
    sigma, and the lever from them to the keyframe turns about the axis that they fix least.
    """
    own = found.keyframe.point_ids[found.relocalised.features]
    both = (own >= 0) & here.alive[np.maximum(own, 0)]
    ours_m = here.positions[own[both]]
    theirs_m = found.here_from_there.apply(found.there.positions[found.relocalised.points[both]])
    sigma_m = ROBUST * float(np.median(np.abs(ours_m - theirs_m)))
    centre = ours_m.mean(0)
    spread = np.linalg.eigvalsh(np.cov(ours_m.T, bias=True))
    there = found.there.keyframes.values()
    ends = found.here_from_there.apply(np.stack([k.centre for k in there]))
    lever_m = float(np.linalg.norm(ends - centre, axis=1).max())
    return sigma_m * float(np.sqrt((1.0 + lever_m**2 / (spread[0] + spread[1])) / len(ours_m)))


def _ids(site: SiteMap) -> list[int]:
    return [k.keyframe_id for k in site.keyframes]


def _n_ids(site: SiteMap) -> int:
    return max(_ids(site)) + 1


def _numbered(other: SiteMap, first: SiteMap) -> SiteMap:
    """A site map with ids behind those of another."""
    offset = _n_ids(first)
    points = other.points
    seen = np.where(points.first_seen >= 0, points.first_seen + offset, points.first_seen)
    keyframes = tuple(
        replace(k, keyframe_id=k.keyframe_id + offset, point_ids=k.point_ids.copy())
        for k in other.keyframes
    )
    return replace(other, keyframes=keyframes, points=points._replace(first_seen=seen))


def _found(here: SlamMap, there: SlamMap, camera: Camera) -> LoopClosure | None:
    """The keyframe of one map that is found best in the other."""
    database = KeyframeDatabase()
    database.add_all((key, k.features.descriptors) for key, k in there.keyframes.items())
    detector = LoopDetector(database, Relocalizer(camera))
    best: LoopClosure | None = None
    n_found = 0
    for keyframe in here.keyframes.values():
        found = detector.find(keyframe, here, [there], lambda _found, _same: True)
        if found is None:
            continue
        n_found += 1
        if best is None or len(found.relocalised.points) > len(best.relocalised.points):
            best = found
        if n_found == ENOUGH_FOUND:
            break
    return best


class _Before(NamedTuple):
    """A map before it was merged: `world_from_camera` by keyframe, and standard deviations."""

    places: dict[int, Pose]
    sigma_m: float
    sigma_yaw_rad: float
    sigma_scale: float


def _before(site: SiteMap, offset: int, in_world: Similarity) -> _Before:
    """A site map with an offset to its ids, in the world of another."""
    places = {
        k.keyframe_id + offset: in_world.apply_to_pose(k.camera_from_map.inverse())
        for k in site.keyframes
    }
    found = site.georeference
    return _Before(places, found.sigma_m, found.sigma_yaw_rad, found.sigma_scale)


def _placed(slam_map: SlamMap, before: list[_Before]) -> Similarity:
    """`world_from_map` for which the keyframes are where they were, by least squares.

    Its scale is by the distances within each of the maps before, its rotation by their attitudes,
    of which all are level, and its place by the mean of each, weighted by their variances.
    """
    log_scales, turns, shifts = [], [], []
    for each in before:
        now = [slam_map.keyframes[key].camera_from_map.inverse() for key in each.places]
        then = list(each.places.values())
        a, b = (np.stack([p.translation for p in poses]) for poses in (then, now))
        spread_a, spread_b = (float(((p - p.mean(0)) ** 2).sum()) for p in (a, b))
        log_scales.append(0.5 * np.log(spread_a / spread_b))
        turns.append(
            nearest_rotation(
                np.sum([p.rotation @ q.rotation.T for p, q in zip(then, now, strict=True)], axis=0)
            )
        )
        shifts.append((a.mean(0), b.mean(0)))
    scale = float(np.exp(np.average(log_scales, weights=[e.sigma_scale**-2 for e in before])))
    weighted = [turn * e.sigma_yaw_rad**-2 for turn, e in zip(turns, before, strict=True)]
    rotation = nearest_rotation(np.sum(weighted, axis=0))
    origins = [a - scale * rotation @ b for a, b in shifts]
    return Similarity(
        scale, rotation, np.average(origins, axis=0, weights=[e.sigma_m**-2 for e in before])
    )


def _both(a: SiteGeoreference, b: SiteGeoreference) -> SiteGeoreference:
    """Georeference by two independent ones, about the origin of the first."""
    return SiteGeoreference(
        a.origin, _less(a.sigma_m, b.sigma_m), _less(a.sigma_yaw_rad, b.sigma_yaw_rad),
        _less(a.sigma_scale, b.sigma_scale), f"{a.method}; {b.method}",
    )  # fmt: skip


def _less(sigma_a: float, sigma_b: float) -> float:
    return float((sigma_a**-2 + sigma_b**-2) ** -0.5)
