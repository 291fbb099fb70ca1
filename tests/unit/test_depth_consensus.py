from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.depth.consensus import AROUND, Consensus, judged
from companion.geometry import Pose
from companion.messages import DepthMap, PixelState

SHAPE = (40, 60)
WALL_M = 4.0
CONVERGED, UPDATING = PixelState.CONVERGED.value, PixelState.UPDATING.value
HALF_RIGHT = Pose(np.eye(3), np.array([0.4, 0, 0]))
SIDE_PX = 5
"""By so much a wall of 4 m moves when the camera does by 0.4 m."""


def wall(keyframe_id: int = 0, sigma: float = 0.02) -> DepthMap:
    """A wall straight ahead, nothing of which has converged."""
    depth = np.full(SHAPE, WALL_M, np.float32)
    return DepthMap(
        keyframe_id, keyframe_id, (50.0, 50.0, 29.5, 19.5), depth, depth * np.float32(sigma),
        np.full(SHAPE, UPDATING, np.uint8), np.ones(SHAPE, np.float32),
        np.zeros((*SHAPE, 3), np.uint8), 6, {},
    )  # fmt: skip


def test_what_maps_agree_on_has_converged_where_both_see_it() -> None:
    out = judged(wall(), [(wall(1), HALF_RIGHT.inverse())], 0.02)
    assert (out.state[:, SIDE_PX + 1 :] == CONVERGED).all()
    assert (out.state[:, : SIDE_PX - 1] == UPDATING).all()
    assert (out.depth == np.float32(WALL_M)).all()
    assert (out.sigma[:, SIDE_PX + 1 :] <= 0.021 * WALL_M).all()


def test_maps_that_agree_and_know_little_are_not_enough() -> None:
    out = judged(wall(sigma=0.2), [(wall(1, sigma=0.2), Pose.identity())], 0.02)
    assert (out.state == UPDATING).all()


def test_one_that_errs_alone_is_put_right() -> None:
    depth = np.full(SHAPE, WALL_M, np.float32)
    depth[10:20, 10:20] = 5.5
    here = replace(wall(), depth=depth, state=np.full(SHAPE, CONVERGED, np.uint8))
    others = [(wall(1), Pose.identity()), (wall(2), Pose.identity())]
    out = judged(here, others, 0.02)
    np.testing.assert_allclose(out.depth, WALL_M, rtol=1e-6)
    assert (out.state == CONVERGED).all()


def test_what_is_contradicted_has_not_converged() -> None:
    here = replace(wall(), state=np.full(SHAPE, CONVERGED, np.uint8))
    other = replace(wall(1), depth=np.full(SHAPE, 1.5 * WALL_M, np.float32))
    out = judged(here, [(other, Pose.identity())], 0.02)
    assert (out.state == UPDATING).all()
    assert (out.depth == here.depth).all()


def test_what_no_other_sees_stays() -> None:
    here = replace(wall(), state=np.full(SHAPE, CONVERGED, np.uint8))
    nothing = replace(wall(1), depth=np.zeros(SHAPE, np.float32))
    behind = Pose(np.diag([-1.0, 1, -1]), np.zeros(3))
    for others in ([], [(nothing, Pose.identity())], [(wall(1), behind)]):
        out = judged(here, others, 0.02)
        assert (out.state == CONVERGED).all() and (out.depth == here.depth).all()


@pytest.mark.parametrize("n", [1, 3, 20])
def test_all_come_back_in_order_and_few_are_held(n: int) -> None:
    it, out = Consensus(0.02), []
    for k in range(n):
        out += it.add(wall(k), Pose.identity())
        assert len(out) == max(0, k + 1 - AROUND)
        assert len(it._held) <= 2 * AROUND
    out += it.flush()
    assert [m.keyframe_id for m in out] == list(range(n))
