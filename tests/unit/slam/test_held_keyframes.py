"""Maps of an earlier flight: found again, taken over, held where they are, never mistaken."""

from __future__ import annotations

import numpy as np
import pytest

from companion.config import FeaturesConfig
from companion.geometry.transforms import Pose, Similarity, yaw_rotation
from companion.messages import LoopClosed
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.map.seen import Seen
from companion.slam.map.site_map import SiteGeoreference, SitePart, site_map_of, slam_map_of
from companion.slam.map.sparse_map import SlamMap
from companion.slam.mapping.atlas import Atlas
from companion.slam.mapping.culling import cull_keyframes
from companion.slam.mapping.map_adjustment import partition
from companion.slam.mapping.mapping_worker import MapLock
from tests.support.reference.synthetic_map import CAMERA, GREY, Ground, flown, mapped

ELSEWHERE = Similarity(0.4, yaw_rotation(1.1), np.array([3.0, -7.0, 2.0]))
N_OLD = 9


def on_another_day(ground: Ground, share: float) -> None:
    """Let only a share of the points look as they did."""
    rng = np.random.default_rng(77)
    changed = rng.random(len(ground.points)) > share
    ground.descriptors[changed] = rng.integers(0, 256, (int(changed.sum()), 32)).astype(np.uint8)


def kept(slam_map: SlamMap) -> SlamMap:
    part = SitePart("before", 0, CAMERA, 1)
    georeference = SiteGeoreference(None, 1.0, 0.01, 0.01, "gps")
    site = site_map_of(slam_map, Similarity.identity(), (part,), {}, georeference, 1)
    return slam_map_of(site, CAMERA)


def line(start: tuple[float, float], end: tuple[float, float], yaw: float) -> list[Pose]:
    return [flown(p, yaw) for p in np.linspace(start, end, N_OLD)]


def flying(site: SlamMap, here: SlamMap) -> Atlas:
    atlas = Atlas(FeaturesConfig(), CAMERA, MapLock())
    atlas.segments = [here]
    atlas.use_site(site)
    return atlas


def flown_on(atlas: Atlas, ground: Ground, pose: Pose, here_from_world: Similarity) -> LoopClosed:
    """Insert one more keyframe at a place, tracked by its neighbours' points."""
    here = atlas.map
    newest = here.keyframes[max(here.keyframes)]
    features, _ = ground.seen_from(pose)
    keyframe = type(newest)(
        newest.keyframe_id + 1, newest.seq + 1, newest.t_ns + 500_000_000,
        here_from_world.apply_to_pose(pose).inverse(),
        Seen(features, features.normalised.copy(), features.whitening.copy()),
        np.full(len(features), -1), np.full(len(features), -1), GREY,
    )  # fmt: skip
    seen = atlas.mapper.fusion._projector.visible(
        here, keyframe.camera_from_map, np.flatnonzero(here.alive[: here.n_points])
    )
    points, found = atlas.mapper.fusion._projector.search(here, seen, features, 5.0)
    here.add_observations(keyframe, found, points)
    closed = atlas.insert_keyframe(here, keyframe)
    assert closed is not None
    return closed


def found_in(atlas: Atlas) -> LoopClosure | None:
    here = atlas.map
    assert atlas.site is not None
    newest = here.keyframes[max(here.keyframes)]
    return atlas._site_finder.find(newest, here, [atlas.site], lambda found, same: True)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_a_site_is_found_again_on_another_day(share: float) -> None:
    ground = Ground(np.random.default_rng(5))
    site = kept(mapped(ground, line((-6, 0), (6, 0), 0.0), Similarity.identity()))
    on_another_day(ground, share)
    here = mapped(ground, line((6, 3), (2, 0.5), 2.6), ELSEWHERE, first_id=20)
    found = found_in(flying(site, here))
    assert found is not None
    assert found.here_from_there.scale == pytest.approx(ELSEWHERE.scale, rel=0.03)


def test_another_site_is_never_found() -> None:
    site = kept(
        mapped(Ground(np.random.default_rng(5)), line((-6, 0), (6, 0), 0.0), Similarity.identity())
    )
    for seed in range(3):
        other = mapped(
            Ground(np.random.default_rng(50 + seed)), line((-3, 0), (6, 1), 0.3), ELSEWHERE,
            first_id=20,
        )  # fmt: skip
        assert found_in(flying(site, other)) is None


def test_a_site_is_taken_over_and_stays_where_it_is() -> None:
    ground = Ground(np.random.default_rng(5))
    site = kept(mapped(ground, line((-6, 0), (6, 0), 0.0), Similarity.identity()))
    before = {key: k.centre for key, k in site.keyframes.items()}
    on_another_day(ground, 0.5)
    here = mapped(ground, line((6, 3), (2, 0.5), 2.6), ELSEWHERE, first_id=20)
    atlas = flying(site, here)
    merges: list[Similarity] = []
    atlas.on_merge = lambda into, old, by: merges.append(by)
    closed = flown_on(atlas, ground, flown(np.array([1.5, 0.4]), 2.6), ELSEWHERE)
    assert not closed.same_map and atlas.site is None and len(merges) == 1
    assert here.held == frozenset(before)
    atlas.mapper.adjust_all(5)
    for key, centre in before.items():
        assert here.keyframes[key].centre == pytest.approx(merges[0].apply(centre), abs=1e-9)
    # keyframes of now are bound to the points of then
    of_site = np.unique(np.concatenate([here.keyframes[key].point_ids for key in before]))
    shared = [
        int(np.isin(k.point_ids[k.point_ids >= 0], of_site).sum())
        for key, k in here.keyframes.items()
        if key not in before
    ]
    assert min(shared) > 20
    placed = {
        key: merges[0].inverse().apply(k.centre)
        for key, k in here.keyframes.items()
        if key not in before
    }
    for key, pose in zip(range(20, 20 + N_OLD), line((6, 3), (2, 0.5), 2.6), strict=True):
        assert placed[key] == pytest.approx(pose.translation, abs=0.1)


def test_held_keyframes_are_neither_adjusted_nor_culled() -> None:
    ground = Ground(np.random.default_rng(8))
    slam_map = mapped(ground, [flown(np.array([0.02 * n, 0.0])) for n in range(16)],
                      Similarity.identity())  # fmt: skip
    culled_without = set(
        cull_keyframes(
            mapped(ground, [flown(np.array([0.02 * n, 0.0])) for n in range(16)],
                   Similarity.identity()),
            slam_map.keyframes[15], 1.0,
        )
    )  # fmt: skip
    assert culled_without
    slam_map.held = frozenset(range(12))
    assert not set(cull_keyframes(slam_map, slam_map.keyframes[15], 1.0)) & slam_map.held
    ((variable, fixed, _),) = partition(slam_map)
    assert {k.keyframe_id for k in variable} == {12, 13, 14, 15}
    assert {k.keyframe_id for k in fixed} == slam_map.held
