"""Global adjustment during a flight: nothing waits, and the map stays consistent."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import nullcontext

import numpy as np
import pytest

from companion.config import Config
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, Similarity, rotation_from_vector
from companion.messages import Frame, LoopClosed, Track
from companion.slam.map.sparse_map import Keyframe, SlamMap
from companion.slam.mapping import map_adjustment
from companion.slam.mapping.atlas import Atlas
from companion.slam.mapping.culling import retire
from companion.slam.mapping.map_adjustment import (
    AdjustmentProblem,
    apply_result,
    apply_result_later,
    build_problem,
    partition,
)
from companion.slam.mapping.mapper import Mapper
from companion.slam.mapping.mapping_worker import BackgroundMapping, Done, MapLock
from companion.slam.optimisation.bundle_adjustment import AdjustmentResult, adjust
from companion.slam.tracking.prior import Prior
from companion.slam.tracking.tracker import Tracker
from tests.support.flights.scene import DOWN_LOOKING, PlaneWorld, aligned_error
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

N = 14
SMALL = Camera(320, 240, 260.0, 258.0, 161.0, 118.0)


def path(k: int) -> Pose:
    """Eastward at 12 m with some roll, pitch and yaw."""
    wobble = rotation_from_vector(np.array([0.03 * np.sin(k / 5), 0.04 * np.cos(k / 7), 0.01 * k]))
    return Pose(wobble @ DOWN_LOOKING, np.array([0.1 * k - 3, 0.25 * k - 5, -12.0]))


def disturbed() -> SlamMap:
    ground = Ground(np.random.default_rng(3), n=2500)
    path = [flown(p) for p in np.linspace((-6, 0), (6, 0), N)]
    slam_map = mapped(ground, path, Similarity.identity())
    rng = np.random.default_rng(4)
    for k in list(slam_map.keyframes.values())[2:]:
        pose = k.camera_from_map
        k.camera_from_map = Pose(pose.rotation, pose.translation + rng.normal(scale=0.04, size=3))
    return slam_map


def error_px(slam_map: SlamMap, keyframe: Keyframe) -> float:
    features, points = slam_map.observations_of(keyframe)
    seen = CAMERA.project(keyframe.camera_from_map.apply(slam_map.positions[points]))
    return float(np.median(np.linalg.norm(seen - keyframe.features.pixels[features], axis=1)))


def test_result_applied_later_to_an_unchanged_map_is_the_same() -> None:
    at_once, later = disturbed(), disturbed()
    points = np.zeros(0, np.int64)
    for slam_map, put in ((at_once, apply_result), (later, apply_result_later)):
        (part,) = partition(slam_map)
        problem = build_problem(slam_map, *part)
        assert problem is not None
        put(slam_map, problem, adjust(problem.bundle, 5))
        points = problem.points
    for key, keyframe in at_once.keyframes.items():
        same = later.keyframes[key].camera_from_map
        assert np.abs(same.matrix() - keyframe.camera_from_map.matrix()).max() < 1e-9
    assert len(points) > 100
    assert np.array_equal(later.alive, at_once.alive)
    assert np.abs(later.positions[points] - at_once.positions[points]).max() < 1e-9


def test_additions_during_adjustment_move_with_their_references() -> None:
    slam_map = disturbed()
    newest, before = slam_map.keyframes[N - 1], slam_map.keyframes[N - 2]
    del slam_map.keyframes[N - 1]
    own = slam_map.first_seen[: slam_map.n_points] == N - 1
    slam_map.alive[: slam_map.n_points][own] = False
    (part,) = partition(slam_map)
    problem = build_problem(slam_map, *part)
    assert problem is not None
    result = adjust(problem.bundle, 5)

    slam_map.keyframes[N - 1] = newest
    slam_map.alive[: slam_map.n_points][own] = True
    retire(slam_map, slam_map.keyframes[5], slam_map.keyframes[6])
    gone = slam_map.pose_of(5)
    anchor = slam_map.keyframes[6].camera_from_map
    relative = newest.camera_from_map @ before.camera_from_map.inverse()
    fresh = np.flatnonzero(own)
    assert len(fresh) > 5
    inside = newest.camera_from_map.apply(slam_map.positions[fresh])
    given_again = problem.points[3]
    slam_map.born[given_again] = slam_map.first_seen[given_again] = N - 1
    again = newest.camera_from_map.apply(slam_map.positions[given_again])

    apply_result_later(slam_map, problem, result)
    assert before.camera_from_map.matrix() == pytest.approx(result.poses[N - 3].matrix(), abs=1e-9)
    now = newest.camera_from_map @ before.camera_from_map.inverse()
    assert now.matrix() == pytest.approx(relative.matrix(), abs=1e-9)
    seen = newest.camera_from_map.apply(slam_map.positions[fresh])
    assert seen == pytest.approx(inside, abs=1e-9)
    seen = newest.camera_from_map.apply(slam_map.positions[given_again])
    assert seen == pytest.approx(again, abs=1e-9)
    assert gone is not None
    now_gone = slam_map.pose_of(5)
    assert now_gone is not None
    kept = now_gone @ slam_map.keyframes[6].camera_from_map.inverse()
    assert kept.matrix() == pytest.approx((gone @ anchor.inverse()).matrix(), abs=1e-9)
    assert max(error_px(slam_map, slam_map.keyframes[k]) for k in range(2, N - 2) if k != 5) < 0.6


def test_adjustment_is_dropped_after_another_loop() -> None:
    slam_map = disturbed()
    before = [k.camera_from_map for k in slam_map.keyframes.values()]
    mapper = Mapper(CAMERA, slam_map, MapLock())
    mapper.adjust_all_in_background(2, lambda: None, lambda: False)
    assert all(
        k.camera_from_map is pose
        for k, pose in zip(slam_map.keyframes.values(), before, strict=True)
    )
    mapper.adjust_all_in_background(5, lambda: None, lambda: True)
    assert max(error_px(slam_map, k) for k in slam_map.keyframes.values()) < 0.6


def test_keyframes_and_frames_precede_idle_work() -> None:
    turn = MapLock()
    order: list[str] = []
    begun, enough = threading.Event(), threading.Event()

    def job(name: str) -> Done:
        order.append(name)
        return []

    def idle_work(yield_point: Callable[[], None]) -> None:
        order.append("begun")
        begun.set()
        while not enough.wait(0.001):
            yield_point()
        order.append("ended")

    worker = BackgroundMapping(turn, idle_work)
    worker.submit(lambda: job("first"))
    assert begun.wait(60)
    for k in range(3):
        with turn.tracking():
            order.append(f"frame {k}")
        done = threading.Event()

        def second(k: int = k, done: threading.Event = done) -> Done:
            job(f"keyframe {k}")
            done.set()
            return []

        worker.submit(second)
        assert done.wait(60)
    enough.set()
    worker.close()
    assert order[:2] == ["first", "begun"]
    assert order[2:8] == [f"{what} {k}" for k in range(3) for what in ("frame", "keyframe")]
    assert order[8] == "ended"


def test_close_does_not_wait_for_idle_work() -> None:
    begun = threading.Event()

    def forever(yield_point: Callable[[], None]) -> None:
        begun.set()
        while True:
            yield_point()

    worker = BackgroundMapping(MapLock(), forever)
    worker.submit(list)
    assert begun.wait(60)
    worker.close()
    assert worker.done() == []


def test_live_flight_is_tracked_during_global_adjustment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As if a loop were closed at each keyframe; the result then meets the next frames."""
    extend, put = Atlas.insert_keyframe, map_adjustment.apply_result_later
    n_adjusted = 0

    def extended(self: Atlas, segment: SlamMap, keyframe: Keyframe) -> LoopClosed | None:
        self._pending = segment
        return extend(self, segment, keyframe)

    def counted(slam_map: SlamMap, problem: AdjustmentProblem, result: AdjustmentResult) -> None:
        nonlocal n_adjusted
        n_adjusted += 1
        put(slam_map, problem, result)

    monkeypatch.setattr(Atlas, "insert_keyframe", extended)
    monkeypatch.setattr("companion.slam.mapping.mapper.apply_result_later", counted)
    world = PlaneWorld(np.random.default_rng(7))
    tracker = Tracker(Config(), SMALL, lambda _: nullcontext(), background=True)
    worker = tracker._worker
    assert isinstance(worker, BackgroundMapping)
    tracks: dict[int, Track] = {}
    pose: Pose | None = None
    for k in range(40):
        grey, _ = world.render(SMALL, path(k))
        frame = Frame(k, k * 100_000_000, grey, np.zeros((1, 1, 3), np.uint8))
        with tracker.map_lock.tracking():
            out = tracker.step(frame, Prior(pose, path(k).rotation))
        for message in out:
            if isinstance(message, Track) and message.map_from_camera is not None:
                tracks[message.seq] = message
                pose = message.map_from_camera
        _wait_until(lambda: worker._finished.qsize() == worker._waiting)
    _wait_until(lambda: n_adjusted > 0)
    tracker.close()
    assert sorted(tracks) == list(range(40))
    assert n_adjusted > 0
    estimated = []
    for _, track in sorted(tracks.items()):
        assert track.keyframe_id is not None
        assert track.keyframe_from_camera is not None
        camera_from_map = tracker.map.pose_of(track.keyframe_id)
        assert camera_from_map is not None
        place = camera_from_map.inverse() @ track.keyframe_from_camera
        estimated.append(place.translation)
    truth = np.array([path(k).translation for k in range(40)])
    error, _ = aligned_error(np.array(estimated), truth)
    assert error < 0.25  # metres; a pixel is 0.046 m


def _wait_until(done: Callable[[], bool]) -> None:
    for _ in range(4000):
        if done():
            return
        time.sleep(0.005)
    raise AssertionError("not in time")
