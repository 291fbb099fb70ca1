"""Poses in arrays against poses one by one."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from companion.geometry.pose_table import PoseTable
from companion.geometry.transforms import Pose, Similarity, rotation_from_vector

SEED, N = 4, 5


@pytest.fixture
def poses() -> dict[int, Pose]:
    rng = np.random.default_rng(SEED)
    return {
        7 * k + 3: Pose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))
        for k in reversed(range(N))
    }


def assert_same(table: PoseTable, wanted: dict[int, Pose]) -> None:
    assert list(table) == list(wanted) and len(table) == len(wanted)
    for key, pose in wanted.items():
        assert table[key].matrix() == pytest.approx(pose.matrix(), abs=1e-12)


def test_it_is_a_mapping_in_order(poses: dict[int, Pose]) -> None:
    table = PoseTable.of(poses)
    assert_same(table, poses)
    assert 3 in table and 4 not in table
    with pytest.raises(KeyError):
        table[4]
    assert all(type(key) is int for key in table), "ids go into texts and JSON"


def test_it_is_inverted_placed_and_multiplied_as_each_is(poses: dict[int, Pose]) -> None:
    table = PoseTable.of(poses)
    by = Similarity(2.5, rotation_from_vector(np.array([0.1, -0.7, 0.4])), np.array([1.0, 2, -3]))
    assert_same(table.inverse(), {key: pose.inverse() for key, pose in poses.items()})
    assert_same(table.placed(by), {key: by.apply_to_pose(pose) for key, pose in poses.items()})
    others = {100 + key: pose.inverse() @ pose.inverse() for key, pose in poses.items()}
    of_others = [10, 3, 10, 31, 17]
    wanted = {key: poses[of] @ others[key] for key, of in zip(others, of_others, strict=True)}
    assert_same(table.followed_by(np.array(of_others), PoseTable.of(others)), wanted)


def test_tables_are_joined(poses: dict[int, Pose]) -> None:
    others = {key + 1: pose.inverse() for key, pose in poses.items()}
    assert_same(PoseTable.joined([PoseTable.of(poses), PoseTable.of(others)]), poses | others)
    assert_same(PoseTable.joined([]), {})


def test_its_bytes_are_those_of_its_arrays(poses: dict[int, Pose]) -> None:
    table = PoseTable.of(poses)
    assert list(table)
    packed = pickle.dumps(table, protocol=5)
    assert_same(pickle.loads(packed), poses)
    assert table.nbytes == N * 13 * 8 < len(packed) < table.nbytes + 500


def test_it_tells_what_has_changed(poses: dict[int, Pose]) -> None:
    before = PoseTable.of(poses)
    assert before.changed_since(PoseTable.of(poses)) == set()
    assert before.changed_since(PoseTable.of({})) == set(poses)
    turned, moved, left, *_ = poses
    after = {
        **{key: pose for key, pose in poses.items() if key != left},
        turned: Pose(poses[turned].rotation.T, poses[turned].translation),
        moved: Pose(poses[moved].rotation, poses[moved].translation + [0, 0, 1e-9]),
        1000: Pose.identity(),
    }
    assert PoseTable.of(dict(sorted(after.items()))).changed_since(before) == {turned, moved, 1000}
