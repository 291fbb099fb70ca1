from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest

from companion.geometry.transforms import Pose, angle_between
from companion.messages import Track, TrackRefined, TrackState, Warned
from companion.products.flight_result import FlightResult
from companion.telemetry import PositionSample, PositionSource
from tests.support.flights import flown


def flight(known: bool = True) -> FlightResult:
    result = FlightResult()
    for message in flown.messages(known):
        result.take(message)
    return result


def test_poses_are_the_true_ones_in_metres() -> None:
    poses = flight().poses()
    assert len(poses) == flown.N_FRAMES - flown.N_INITIALISING - len(flown.LOST)
    for seq, t_ns, pose in poses:
        true = flown.world_from_camera(seq)
        assert t_ns == flown.time_ns(seq)
        assert np.allclose(pose.translation, true.translation, atol=1e-9)
        assert angle_between(pose.rotation, true.rotation) < 1e-7


def test_without_a_scale_poses_are_those_of_the_map() -> None:
    for seq, _, pose in flight(known=False).poses():
        assert np.allclose(pose.translation, flown.map_from_camera(seq).translation, atol=1e-9)


def test_a_corrected_keyframe_takes_its_frames_along() -> None:
    result = flight()
    update = flown.update()
    turned = {
        k: replace(p, translation=p.translation + 3) for k, p in update.map_from_camera.items()
    }
    result.take(replace(update, map_from_camera=turned, georeference=None))
    for seq, _, pose in result.poses():
        assert np.allclose(pose.translation, flown.map_from_camera(seq).translation + 3, atol=1e-9)


def test_a_keyframes_unit_scales_what_hangs_on_it() -> None:
    result = flight()
    update = flown.update(known=False)
    result.take(replace(update, scale_of={3: 2.0}))
    keyframe, seq = update.map_from_camera[3], 3 * flown.PER_KEYFRAME + 7
    step = flown.map_from_camera(seq).translation - keyframe.translation
    found = next(pose for pose in result.poses() if pose.seq == seq)
    assert np.allclose(found.world_from_camera.translation, keyframe.translation + 2 * step)


def test_frames_and_points_of_a_keyframe_without_a_place_are_left_out() -> None:
    result = flight()
    before = len(result.cloud(0.01))
    result.take(flown.update(without=(3, 4)))
    assert not {pose.seq // flown.PER_KEYFRAME for pose in result.poses()} & {3, 4}
    assert 0 < len(result.cloud(0.01)) < before


def test_a_frame_placed_afterwards_replaces_a_lost_one_and_not_the_reverse() -> None:
    result = flight()
    lost = flown.LOST[3]
    placed = replace(
        flown.track(flown.LOST[0] - 1), seq=lost, t_ns=flown.time_ns(lost), backfilled=True
    )
    result.take(placed)
    result.take(Track(lost, flown.time_ns(lost), TrackState.LOST))
    assert lost in [pose.seq for pose in result.poses()]
    assert [track.seq for track in result.tracks] == list(range(flown.N_FRAMES))


def test_a_refined_pose_replaces_that_of_its_frame_and_of_no_lost_one() -> None:
    result = flight()
    seq, lost = 3 * flown.PER_KEYFRAME + 7, flown.LOST[3]
    aside = Pose(np.eye(3), np.array([0.0, 0.0, 2.0]))
    for each in (seq, lost):
        result.take(TrackRefined(each, flown.time_ns(each), 2, aside))
    poses = {pose.seq: pose.world_from_camera for pose in result.poses()}
    assert lost not in poses
    place = flown.world_from_camera(2 * flown.PER_KEYFRAME)
    assert np.allclose(poses[seq].rotation, place.rotation)
    off_m = np.linalg.norm(poses[seq].translation - place.translation)
    assert off_m == pytest.approx(2.0 * flown.METRES_PER_UNIT)
    before = flight().tracks[seq]
    assert (result.tracks[seq].n_inliers, result.tracks[seq].t_ns) == (
        before.n_inliers, before.t_ns,
    )  # fmt: skip


def test_cloud_is_the_ground_in_its_colours() -> None:
    cloud = flight().cloud(0.5)
    height = 6 * np.exp(-((cloud.points[:, :2] - [12, 18]) ** 2).sum(1) / 60)
    assert np.abs(cloud.points[:, 2] + height).max() < 1e-3
    band = np.abs(np.sin(cloud.points[:, 0] * 0.8)) > 0.1
    bright = np.sin(cloud.points[:, 0] * 0.8) > 0
    assert (cloud.rgb[bright & band, 0] == 170).all()
    assert (cloud.rgb[~bright & band, 0] == 90).all()


def test_cloud_is_thinned_to_the_voxel_by_confidence() -> None:
    coarse, fine = flight().cloud(2.0), flight().cloud(0.2)
    assert len(coarse) < len(fine) / 10
    assert np.median(coarse.confidence) > np.median(fine.confidence) + 0.2


def test_cloud_does_not_depend_on_the_order_of_chunks() -> None:
    messages = flown.messages()
    random.Random(3).shuffle(messages)
    shuffled = FlightResult()
    for message in messages:
        shuffled.take(message)
    one, two = flight().cloud(0.5), shuffled.cloud(0.5)
    assert np.array_equal(one.points, two.points)
    assert np.array_equal(one.rgb, two.rgb)


def test_a_chunk_that_comes_again_replaces_the_first() -> None:
    result = flight()
    before = result.n_points
    result.take(flown.chunk(2, n=100))
    assert result.n_points == before - 4000 + 100
    assert len(result.cloud(0.001)) == result.n_points


def test_without_a_map_there_are_neither_poses_nor_points() -> None:
    result = FlightResult()
    result.take(flown.track(50))
    result.take(flown.chunk(1))
    assert result.poses() == []
    assert len(result.cloud(0.1)) == 0


def test_autopilot_path_is_the_best_source_at_ten_hertz() -> None:
    result = FlightResult()
    for k in range(400):
        for source, where in ((PositionSource.GPS, 1.0), (PositionSource.GLOBAL, 2.0)):
            result.take(PositionSample(flown.START_NS + k * 20_000_000, source, np.full(3, where)))
    result.take(PositionSample(flown.START_NS, PositionSource.LOCAL, np.zeros(3)))
    found = result.autopilot_path()
    assert found is not None
    source, t_ns, position = found
    assert source is PositionSource.GLOBAL  # a single local position is no path
    assert (position == 2).all()
    assert len(t_ns) == 80
    assert np.diff(t_ns).min() >= 100_000_000


def test_warnings_are_counted_and_the_first_is_kept() -> None:
    result = FlightResult()
    for k in range(1000):
        result.take(Warned(k, "gap", f"number {k}"))
    assert list(result.warnings) == ["gap"]
    assert result.warnings["gap"].count == 1000
    assert result.warnings["gap"].first_detail == "number 0"


@pytest.mark.parametrize("n", [1, 6, 12, 13, 100])
def test_pictures_of_depth_maps_are_few_and_spread(n: int) -> None:
    result = FlightResult()
    for k in range(n):
        result.take(flown.depth_map(k))
    times = [picture.keyframe_id for picture in result.depth_pictures(6)]
    assert result.n_depth_maps == n
    assert len(times) == min(n, 6)
    assert times == sorted(set(times))
    assert times[0] == 0
    assert times[-1] >= 0.7 * (n - 1)
