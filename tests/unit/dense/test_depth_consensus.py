from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.config import DepthConfig
from companion.dense.consensus import N_NEIGHBOURS, Consensus, check_consistency
from companion.geometry.transforms import Pose
from companion.messages import DepthMap, Floats, PixelState

SHAPE = (40, 60)
WALL_M = 4.0
CONVERGED, UPDATING = PixelState.CONVERGED.value, PixelState.UPDATING.value
CONFIG = DepthConfig()
HALF_RIGHT = Pose(np.eye(3), np.array([0.4, 0, 0]))
SIDE_PX = 5
"""By so much a wall of 4 m moves when the camera does by 0.4 m."""


def wall(keyframe_id: int = 0, sigma: float = 0.005, depth_m: float = WALL_M) -> DepthMap:
    """A converged wall straight ahead."""
    depth = np.full(SHAPE, depth_m, np.float32)
    return DepthMap(
        keyframe_id, keyframe_id, (50.0, 50.0, 29.5, 19.5), depth, depth * np.float32(sigma),
        np.full(SHAPE, CONVERGED, np.uint8), np.ones(SHAPE, np.float32),
        np.zeros((*SHAPE, 3), np.uint8), 6, {},
    )  # fmt: skip


def unsure(depth_map: DepthMap, sigma: float = 0.03) -> DepthMap:
    """The same without converged pixels."""
    return replace(
        depth_map, state=np.full(SHAPE, UPDATING, np.uint8),
        sigma=depth_map.depth * np.float32(sigma),
    )  # fmt: skip


def test_agreeing_maps_converge_in_their_overlap() -> None:
    others = [(wall(k), HALF_RIGHT.inverse()) for k in (1, 2, 3)]
    out = check_consistency(unsure(wall()), others, CONFIG)
    assert (out.state[:, SIDE_PX + 1 :] == CONVERGED).all()
    assert (out.state[:, : SIDE_PX - 1] == UPDATING).all()
    np.testing.assert_allclose(out.depth, WALL_M, rtol=1e-6)
    assert (out.sigma[:, SIDE_PX + 1 :] <= 0.0101 * WALL_M).all()


@pytest.mark.parametrize("state", [CONVERGED, UPDATING])
def test_agreement_of_uncertain_maps_does_not_converge(state: int) -> None:
    others = [
        (replace(unsure(wall(k), 0.2), state=np.full(SHAPE, state, np.uint8)), Pose.identity())
        for k in (1, 2, 3)
    ]
    out = check_consistency(unsure(wall(), 0.2), others, CONFIG)
    assert (out.state == UPDATING).all()


def test_filled_in_pixels_are_no_support() -> None:
    filled = replace(unsure(wall(), 0.001), inlier_ratio=np.full(SHAPE, 0.1, np.float32))
    others = [(replace(filled, keyframe_id=k), Pose.identity()) for k in (1, 2, 3)]
    out = check_consistency(unsure(wall(), 0.001), others, CONFIG)
    assert (out.state == UPDATING).all()


def test_single_wrong_map_is_corrected() -> None:
    depth = np.full(SHAPE, WALL_M, np.float32)
    depth[10:20, 10:20] = 5.5
    out = check_consistency(
        replace(wall(), depth=depth), [(wall(k), Pose.identity()) for k in (1, 2, 3)], CONFIG
    )
    np.testing.assert_allclose(out.depth, WALL_M, rtol=1e-6)
    assert (out.state == CONVERGED).all()


def test_two_contradictions_without_agreement_revoke_convergence() -> None:
    others = [(wall(k, depth_m=d), Pose.identity()) for k, d in ((1, 6.0), (2, 9.0))]
    out = check_consistency(wall(), others, CONFIG)
    assert (out.state == UPDATING).all()
    assert (out.depth == wall().depth).all()


def test_pixels_unseen_by_others_are_unchanged() -> None:
    here = wall()
    nothing = replace(wall(1), depth=np.zeros(SHAPE, np.float32))
    behind = Pose(np.diag([-1.0, 1, -1]), np.zeros(3))
    for others in ([], [(nothing, Pose.identity())], [(wall(1), behind)]):
        out = check_consistency(here, others, CONFIG)
        assert (out.state == CONVERGED).all() and (out.depth == here.depth).all()


@pytest.mark.parametrize("n", [1, 3, 20])
def test_maps_are_returned_in_order_and_the_buffer_is_bounded(n: int) -> None:
    it, out = Consensus(CONFIG), []
    for k in range(n):
        out += it.add(wall(k), Pose.identity())
        assert len(out) == max(0, k + 1 - N_NEIGHBOURS)
        assert len(it._recent) <= 2 * N_NEIGHBOURS
    out += it.flush()
    assert [m.keyframe_id for m in out] == list(range(n))


# an object before a wall, seen from seven places in a row: most of them do not see the wall where
# one of them sees it beside the object
SIZE = (72, 96)
FOCAL_PX = 80.0
OBJECT_M, BACK_M = 3.0, 3.6
HALF_WIDTH_M = 0.45
STEP_M = 0.3
NOISE = 0.003
BY_CHANCE = 5e-4
"""Share of the pixels, three of them, that were right by chance while errors of 5 % are drawn."""


def places() -> list[Pose]:
    return [Pose(np.eye(3), np.array([STEP_M * (k - 3), 0.0, 0.0])) for k in range(7)]


def true_depth(world_from_camera: Pose) -> Floats:
    v, u = np.indices(SIZE)
    x = (u - 47.5) / FOCAL_PX * OBJECT_M + world_from_camera.translation[0]
    y = (v - 35.5) / FOCAL_PX * OBJECT_M
    on_object = (np.abs(x) < HALF_WIDTH_M) & (np.abs(y) < HALF_WIDTH_M)
    return np.where(on_object, OBJECT_M, BACK_M).astype(np.float32)


def measured(k: int, rng: np.random.Generator, *, wrong: bool = False) -> DepthMap:
    """Truth with noise; a tenth uncertain, with larger errors; if `wrong` all a tenth too far."""
    truth = true_depth(places()[k])
    weak = rng.random(SIZE) < 0.1
    sigma = np.where(weak, 0.05, NOISE)
    depth = truth * (1 + sigma * rng.normal(size=SIZE)) * (1.1 if wrong else 1.0)
    return DepthMap(
        k, k, (FOCAL_PX, FOCAL_PX, 47.5, 35.5), depth.astype(np.float32),
        (sigma * depth).astype(np.float32), np.where(weak, UPDATING, CONVERGED).astype(np.uint8),
        np.ones(SIZE, np.float32), np.zeros((*SIZE, 3), np.uint8), 6, {},
    )  # fmt: skip


def quality(depth_map: DepthMap, truth: Floats) -> dict[str, float]:
    """Ratio converged, and ratios within 1, 2 and 5 % of these and of all."""
    error = np.abs(depth_map.depth - truth) / truth
    converged = depth_map.state == CONVERGED
    out = {"converged": float(converged.mean())}
    for limit in (0.01, 0.02, 0.05):
        out[f"converged within {limit}"] = float((error[converged] < limit).mean())
        out[f"all within {limit}"] = float((error < limit).mean())
    return out


@pytest.mark.parametrize("wrong", [None, 0, 3, 5])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_consistency_check_degrades_no_reference(seed: int, wrong: int | None) -> None:
    rng = np.random.default_rng(seed)
    maps = [measured(k, rng, wrong=k == wrong) for k in range(7)]
    it, out = Consensus(CONFIG), []
    for depth_map, place in zip(maps, places(), strict=True):
        out += it.add(depth_map, place)
    out += it.flush()
    for k, (alone, together) in enumerate(zip(maps, out, strict=True)):
        truth = true_depth(places()[k])
        before, after = quality(alone, truth), quality(together, truth)
        for name in before:
            if k == wrong and name == "converged":
                continue  # what the others contradict is not to be called converged
            assert after[name] >= before[name] - BY_CHANCE, f"reference {k}: {name}"
        assert after["all within 0.01"] > before["all within 0.01"] + 0.02
        if k == wrong:
            assert after["all within 0.01"] > 0.6, "the others put it right"


def test_wall_occluded_in_most_views_is_unchanged() -> None:
    rng = np.random.default_rng(4)
    maps = [measured(k, rng) for k in range(7)]
    first, relative = places()[0], places()
    others = [(maps[k], relative[k].inverse() @ first) for k in range(1, 7)]
    out = check_consistency(maps[0], others, CONFIG)
    # of the wall that the first sees, what the object hides from at least four of the others
    truth = true_depth(first)
    v, u = np.indices(SIZE)
    at = np.stack([(u - 47.5) / FOCAL_PX, (v - 35.5) / FOCAL_PX, np.ones(SIZE)], -1) * BACK_M
    hidden = np.zeros(SIZE, int)
    for place in relative[1:]:
        seen = at + first.translation - place.translation
        x = seen[..., 0] / BACK_M * OBJECT_M + place.translation[0]
        y = seen[..., 1] / BACK_M * OBJECT_M
        hidden += (np.abs(x) < HALF_WIDTH_M - 0.05) & (np.abs(y) < HALF_WIDTH_M - 0.05)
    strip = (truth == np.float32(BACK_M)) & (hidden >= 4) & (maps[0].state == CONVERGED)
    assert strip.sum() > 20
    error = np.abs(out.depth[strip] - BACK_M) / BACK_M
    assert (error < 5 * NOISE).all()
    assert (out.state[strip] == CONVERGED).all()
