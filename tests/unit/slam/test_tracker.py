"""Tracking and mapping on rendered scenes whose answer is known."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from companion.config import Config
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Array, Pose, angle_between, rotation_from_vector
from companion.messages import Frame, KeyframeAdded, Track, TrackState
from companion.slam.loop.relocalizer import Relocalised
from companion.slam.map.sparse_map import SlamMap
from companion.slam.tracking.prior import Prior
from companion.slam.tracking.tracker import Tracker
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld, aligned_error

CAMERA = Camera(
    320, 240, 260.0, 258.0, 161.0, 118.0, Distortion.RADTAN, (-0.1, 0.02, 1e-3, -5e-4, 0.0)
)


def nothing(_: str) -> nullcontext[None]:
    return nullcontext()


def path(k: int) -> Pose:
    """Eastward at 12 m with some roll, pitch and yaw."""
    wobble = rotation_from_vector(np.array([0.03 * np.sin(k / 5), 0.04 * np.cos(k / 7), 0.01 * k]))
    return Pose(
        wobble @ DOWN_LOOKING, np.array([0.1 * k - 3, 0.25 * k - 5, -12.0 - 0.3 * np.sin(k / 6)])
    )


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    world = PlaneWorld(np.random.default_rng(7))
    return [world.render(CAMERA, path(k))[0] for k in range(40)]


def run(
    images: list[np.ndarray], attitude: bool, dropout: range = range(0)
) -> tuple[Tracker, dict[int, Track], list[Track]]:
    tracker = Tracker(Config(), CAMERA, nothing)
    tracks: dict[int, Track] = {}
    every: list[Track] = []
    last: list[tuple[int, Pose]] = []
    for k, image in enumerate(images):
        grey = np.full_like(image, 255) if k in dropout else image
        prior = None
        if len(last) == 2 and last[1][0] == k - 1:
            a, b = last[0][1], last[1][1]
            prior = Pose(b.rotation, 2 * b.translation - a.translation)
        ned: Array | None = path(k).rotation if attitude else None
        frame = Frame(k, k * 100_000_000, grey, np.repeat(grey[..., None], 3, 2))
        for message in tracker.step(frame, Prior(prior, ned)):
            if isinstance(message, Track):
                every.append(message)
                if message.map_from_camera is not None:
                    tracks[message.seq] = message
                    if message.seq == k:
                        last = [*last[-1:], (k, message.map_from_camera)]
    return tracker, tracks, every


def positions(tracker: Tracker, tracks: dict[int, Track]) -> tuple[Array, Array]:
    """Estimated positions with the map as it is now, and the true ones."""
    estimated, truth = [], []
    for seq, track in sorted(tracks.items()):
        assert track.keyframe_id is not None
        camera_from_map = tracker.map.pose_of(track.keyframe_id)
        assert camera_from_map is not None
        assert track.keyframe_from_camera is not None
        estimated.append((camera_from_map.inverse() @ track.keyframe_from_camera).translation)
        truth.append(path(seq).translation)
    return np.array(estimated), np.array(truth)


@pytest.mark.parametrize("is_live", [False, True], ids=["replay", "flight"])
def test_frames_before_the_map_are_tracked_and_in_flight_no_more_than_there_is_time_for(
    images: list[np.ndarray], is_live: bool
) -> None:
    """A hundred frames over one spot before it moves: the next pose waits for all of these."""
    n_still = 100
    tracker = Tracker(Config(), CAMERA, nothing, background=is_live)
    earlier: list[Track] = []
    for k in range(n_still + 20):
        grey = images[max(0, k - n_still)]
        frame = Frame(k, k * 100_000_000, grey, np.repeat(grey[..., None], 3, 2))
        with tracker.map_lock.tracking():
            found = tracker.step(frame, Prior(None, path(max(0, k - n_still)).rotation))
        earlier = [m for m in found if isinstance(m, Track) and m.backfilled]
        if earlier:
            break
    tracker.close()
    seqs = np.array([track.seq for track in earlier])
    assert seqs[0] < 5 and seqs[-1] > k - 10, "from the first to the last"
    if is_live:
        assert 15 <= len(seqs) <= 25 and np.diff(seqs).max() < 10
    else:
        assert len(seqs) >= k - 2


@pytest.mark.parametrize("attitude", [False, True], ids=["vision alone", "with attitude"])
def test_every_frame_of_an_easy_flight_is_tracked_to_centimetres(
    images: list[np.ndarray], attitude: bool
) -> None:
    tracker, tracks, _ = run(images, attitude)
    assert sorted(tracks) == list(range(len(images))), "frames before the map are filled in"
    error, _ = aligned_error(*positions(tracker, tracks))
    assert error < 0.12  # metres, at 12 m above ground, where a pixel is 0.046 m


def test_attitude_levels_the_map_and_aligns_it_north(images: list[np.ndarray]) -> None:
    _tracker, tracks, _ = run(images, attitude=True)
    track = tracks[max(tracks)]
    assert track.map_from_camera is not None
    off = track.map_from_camera.rotation.T @ path(track.seq).rotation
    assert np.degrees(np.arccos((np.trace(off) - 1) / 2)) < 1.0


def test_two_runs_give_the_same_poses_to_the_last_bit(images: list[np.ndarray]) -> None:
    _, first, _ = run(images[:25], attitude=True)
    _, second, _ = run(images[:25], attitude=True)
    assert sorted(first) == sorted(second)
    for seq, track in first.items():
        other = second[seq]
        assert track.map_from_camera is not None
        assert other.map_from_camera is not None
        assert np.array_equal(track.map_from_camera.matrix(), other.map_from_camera.matrix())


def test_image_dropout_is_reported_lost_and_relocalised_in_the_same_map(
    images: list[np.ndarray],
) -> None:
    dropout = range(22, 26)
    tracker, tracks, every = run(images, attitude=True, dropout=dropout)
    assert {t.seq for t in every if t.state is TrackState.LOST} >= set(dropout)
    assert not set(tracks) & set(dropout)
    assert set(tracks) >= set(range(28, 40)), "found again within two frames of sight"
    assert len(tracker.segments) == 1
    error, _ = aligned_error(*positions(tracker, tracks))
    assert error < 0.12


def test_a_pose_in_another_map_that_is_not_verified_leaves_the_active_one(
    images: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Descriptors alike find a place in another map, whose points then do not match there."""
    tracker, _, _ = run(images[:25], attitude=True)
    active, (other, tracks, _) = tracker.map, run(images[:25], attitude=True)
    tracker.atlas.segments.insert(0, other.map)
    keyframe = next(iter(other.map.keyframes.values()))
    features, points = other.map.observations_of(keyframe)
    pose = tracks[24].map_from_camera
    assert pose is not None

    def found(off_m: float) -> Callable[..., tuple[SlamMap, Relocalised]]:
        place = Pose(pose.rotation, pose.translation + [off_m, 0.0, 0.0]).inverse()
        return lambda *_: (other.map, Relocalised(place, points, features, keyframe))

    def step(seq: int, off_m: float) -> TrackState:
        monkeypatch.setattr(tracker.atlas, "relocalise", found(off_m))
        grey = images[24]
        frame = Frame(seq, seq * 100_000_000, grey, np.repeat(grey[..., None], 3, 2))
        tracker.step(frame, Prior(None, None))
        return tracker.state

    assert step(25, 3.0) is TrackState.LOST
    assert tracker.map is active
    assert step(26, 0.0) is TrackState.TRACKING
    assert tracker.map is other.map


def test_pure_rotation_initialises_no_map() -> None:
    world = PlaneWorld(np.random.default_rng(3))
    tracker = Tracker(Config(), CAMERA, nothing)
    for k in range(12):
        pose = Pose(
            rotation_from_vector(np.array([0, 0, 0.03 * k])) @ DOWN_LOOKING, np.array([0, 0, -12.0])
        )
        image, _ = world.render(CAMERA, pose)
        frame = Frame(k, k * 100_000_000, image, np.repeat(image[..., None], 3, 2))
        for message in tracker.step(frame, Prior(None, pose.rotation)):
            assert not isinstance(message, KeyframeAdded)
            assert isinstance(message, Track)
            assert message.state is TrackState.INITIALISING


@pytest.mark.parametrize("level", [0, 128, 255])
def test_blank_image_yields_no_pose(level: int) -> None:
    tracker = Tracker(Config(), CAMERA, nothing)
    grey = np.full((240, 320), level, np.uint8)
    for k in range(4):
        (track,) = tracker.step(
            Frame(k, k, grey, np.repeat(grey[..., None], 3, 2)), Prior(None, None)
        )
        assert isinstance(track, Track)
        assert track.map_from_camera is None


def test_pose_inconsistent_with_attitude_is_rejected(images: list[np.ndarray]) -> None:
    tracker, tracks, _ = run(images[:20], attitude=True)
    last = tracks[19].map_from_camera
    assert last is not None
    turned = Pose(last.rotation @ rotation_from_vector(np.array([0, 0, 0.5])), last.translation)
    grey = images[20]
    frame = Frame(20, 2_000_000_000, grey, np.repeat(grey[..., None], 3, 2))
    (track,) = tracker.step(frame, Prior(turned, path(20).rotation))
    assert isinstance(track, Track)
    assert track.state is TrackState.LOST


def test_map_is_continued_by_two_views_after_loss(images: list[np.ndarray]) -> None:
    """Without attitude, and with too few points left to be tracked by, but enough for the scale."""
    config = Config()
    few = replace(config, tracking=replace(config.tracking, min_inliers=100))
    tracker = Tracker(few, CAMERA, nothing)
    tracks: dict[int, Track] = {}
    states, keyframes_after = [], set()
    for k, image in enumerate(images):
        if k == 20:
            slam_map = tracker.map
            known = np.flatnonzero(slam_map.alive)
            slam_map.alive[np.delete(known, np.s_[:: len(known) // 100])] = False
        frame = Frame(k, k * 100_000_000, image, np.repeat(image[..., None], 3, 2))
        for message in tracker.step(frame, Prior(None, None)):
            if isinstance(message, KeyframeAdded) and k >= 20:
                keyframes_after.add(message.seq)
            elif isinstance(message, Track):
                states.append((message.seq, message.state))
                if message.map_from_camera is not None:
                    tracks[message.seq] = message
    assert (20, TrackState.LOST) in states
    assert tracker.map is slam_map, "no map was begun anew"
    assert 19 in keyframes_after, "the last view before became a keyframe"
    assert set(range(20, 40)) <= set(tracks)
    error, _ = aligned_error(*positions(tracker, tracks))
    assert error < 0.2


def test_map_is_level_where_attitude_arrives_after_the_first_frames(
    images: list[np.ndarray],
) -> None:
    tracker = Tracker(Config(), CAMERA, nothing)
    off_deg = []
    for k, image in enumerate(images):
        ned = path(k).rotation if k >= 3 else None
        frame = Frame(k, k * 100_000_000, image, np.repeat(image[..., None], 3, 2))
        for message in tracker.step(frame, Prior(None, ned)):
            if isinstance(message, Track) and message.map_from_camera is not None:
                true = path(message.seq).rotation
                off_deg.append(np.degrees(angle_between(message.map_from_camera.rotation, true)))
        if len(off_deg) > 10:
            break
    assert tracker.map.level
    assert max(off_deg) < 3.0
