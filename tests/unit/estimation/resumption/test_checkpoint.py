"""Checkpoint files: restored unchanged, or rejected with a reason."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config, FeedbackConfig, TelemetryConfig
from companion.daemon.flights import kept_map_place
from companion.daemon.flights.kept_map_place import kept_map_path
from companion.estimation.localisation import LocalisationStage
from companion.estimation.odometry.odometry_frame import OdometryState
from companion.estimation.resumption.checkpoint import (
    MAX_BYTES,
    Checkpoint,
    CheckpointError,
    decode,
    encode,
    read_arrays,
)
from companion.estimation.resumption.map_verification import (
    MAX_ABSENT_NS,
    MIN_FRAMES,
    TIMEOUT_NS,
    Resumption,
    Verdict,
)
from companion.geometry.transforms import Pose, Similarity
from companion.messages import Frame, Georeference, Odometry, Track, TrackState, Warned
from companion.runtime.stage_protocol import Finish, KeepMap, Setup
from companion.slam.map.map_part import map_of, part_around
from companion.slam.map.sparse_map import SlamMap
from companion.stages import localisation_work, map_keeper
from companion.stages.map_keeper import MapKeeper
from companion.timing.clock import since_boot_ns
from tests.support.reference.synthetic_map import (
    CAMERA,
    N_LEVELS,
    SCALE_FACTOR,
    Ground,
    flown,
    mapped,
)

SETUP = Setup(Config(), CAMERA)
SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def slam_map() -> SlamMap:
    path = [flown(p) for p in np.linspace((-15, 0), (15, 0), 25)]
    made = mapped(Ground(np.random.default_rng(9)), path, Similarity.identity(), first_id=7)
    made.keyframes[20].ned_from_camera = flown(np.zeros(2)).rotation
    return made


@pytest.fixture(scope="module")
def checkpoint(slam_map: SlamMap) -> Checkpoint:
    to_world = Similarity(2.5, np.eye(3), np.array([1.0, 2.0, 3.0]))
    return Checkpoint(
        123_456_789_012_345_678, part_around(slam_map, slam_map.keyframes[20], MAX_BYTES), 40,
        np.eye(3), Georeference(to_world, 0.02, 0.1, "rangefinder", 12, 0.0, has_origin=False),
        OdometryState(Pose.identity(), False, np.array([1.0, 2, -3]), np.array([0.5, 0, 0])),
        np.eye(3), 31_000_000,
    )  # fmt: skip


def written(keeper: MapKeeper, checkpoint: Checkpoint) -> None:
    """Write it, and wait for that."""
    keeper.put(checkpoint)
    done = threading.Event()
    while keeper.busy:
        done.wait(0.001)


def keep(path: Path, checkpoint: Checkpoint, setup: Setup = SETUP) -> None:
    keeper = MapKeeper(path, setup)
    written(keeper, checkpoint)
    keeper.close(forget=False)


def refusal(path: Path, setup: Setup = SETUP) -> str:
    """Why a stored checkpoint is rejected; it is deleted then."""
    keeper = MapKeeper(path, setup)
    with pytest.raises(CheckpointError, match=path.name) as refused:
        keeper.take()
    assert keeper.take() is None
    keeper.close(forget=False)
    return str(refused.value)


def test_refinement_for_points_of_another_map_is_not_stored() -> None:
    path = [flown(p) for p in np.linspace((-6, 0), (6, 0), 8)]
    made = mapped(Ground(np.random.default_rng(4)), path, Similarity.identity())
    first, second = list(made.keyframes.values())[:2]
    first.refined_for[:] = made.n_points + 2000
    second.refined_for[:] = second.point_ids
    part = part_around(made, second, MAX_BYTES)
    kept = {k.keyframe_id: k for k in part.keyframes}
    assert (kept[first.keyframe_id].refined_for == -1).all()
    of_second = kept[second.keyframe_id]
    assert (of_second.refined_for == of_second.point_ids).all() and of_second.refined_for.max() > 0


def test_checkpoint_failure_does_not_stop_localisation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(stage: LocalisationStage) -> None:
        raise IndexError("index 2080 is out of bounds")

    monkeypatch.setattr(LocalisationStage, "checkpoint", fails)
    path = tmp_path / "map.checkpoint"
    localisation = localisation_work.work(SETUP)
    list(localisation.step(KeepMap(path, take_up=False)))
    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    messages = [
        message
        for k in range(1, 4)
        for message in localisation.step(Frame(k, k * SECOND_NS, grey, np.dstack([grey] * 3)))
    ]
    assert len([m for m in messages if isinstance(m, Odometry)]) == 3
    (warned,) = (m for m in messages if isinstance(m, Warned))
    assert (warned.what, warned.detail) == (
        localisation_work.NOT_KEPT, "IndexError: index 2080 is out of bounds"
    )  # fmt: skip
    list(localisation.finish(Finish(hurry=True)))
    assert not path.exists()


def test_checkpoint_is_restored_once(tmp_path: Path, checkpoint: Checkpoint) -> None:
    path = tmp_path / "run" / "map.checkpoint"
    keep(path, checkpoint)
    keeper = MapKeeper(path, SETUP)
    kept = keeper.take()
    assert kept is not None
    assert keeper.take() is None
    found, made = kept.checkpoint, checkpoint
    for name in ("t_ns", "next_keyframe_id", "delay_ns"):
        assert getattr(found, name) == getattr(made, name)
    assert found.georeference is not None and made.georeference is not None
    assert found.georeference.world_from_map.scale == 2.5
    assert (found.georeference.world_from_map.translation == [1.0, 2.0, 3.0]).all()
    assert replace(found.georeference, world_from_map=Similarity.identity()).method == "rangefinder"
    assert not found.georeference.has_origin
    assert found.odometry is not None and (found.odometry.position_m == [1.0, 2, -3]).all()
    ours = map_of(made.part, SCALE_FACTOR, N_LEVELS)
    theirs = map_of(found.part, SCALE_FACTOR, N_LEVELS, shift_ns=5)
    assert (theirs.level, theirs.first_keyframe_id) == (True, 7)
    n = ours.n_points
    assert theirs.n_points == n
    for name in ("positions", "descriptors", "observers", "n_observers", "born", "alive"):
        assert np.array_equal(getattr(theirs, name)[:n], getattr(ours, name)[:n]), name
    for name in ("normals", "first_unproject", "patch_centre"):
        assert np.allclose(getattr(theirs, name)[:n], getattr(ours, name)[:n], rtol=1e-6), name
    every = np.arange(n)
    assert np.array_equal(theirs.patches_of(every).grey, ours.patches_of(every).grey)
    assert list(theirs.keyframes) == list(ours.keyframes)
    for key, there in theirs.keyframes.items():
        here = ours.keyframes[key]
        assert there.t_ns == here.t_ns + 5
        assert np.array_equal(there.camera_from_map.matrix(), here.camera_from_map.matrix())
        assert np.array_equal(there.features.normalised, here.features.normalised)
        assert np.array_equal(there.features.descriptors, here.features.descriptors)
        assert np.array_equal(there.point_ids, here.point_ids)
        assert np.allclose(there.normalised, here.normalised, atol=1e-6)  # a thousandth of a pixel
        assert np.allclose(there.whitening, here.whitening, rtol=1e-6)
        assert (there.ned_from_camera is None) == (here.ned_from_camera is None)
    keeper.close(forget=True)


def test_part_is_local_and_bounded_in_size(slam_map: SlamMap) -> None:
    whole = part_around(slam_map, slam_map.keyframes[20], 1 << 40)
    assert len(whole.keyframes) == len(slam_map.keyframes)
    assert len(whole.points.positions) == slam_map.alive.sum()
    some = part_around(slam_map, slam_map.keyframes[20], 300_000)
    ids = [k.keyframe_id for k in some.keyframes]
    assert 3 < len(ids) < 12
    assert set(ids) <= set(range(10, 31)) and 20 in ids
    empty = np.zeros((3, 3))
    data = b"".join(encode(Checkpoint(0, some, 40, None, None, None, empty, 0), {}))
    assert 0.2e6 < len(data) < 0.32e6


def test_part_is_a_copy(slam_map: SlamMap) -> None:
    part = part_around(slam_map, slam_map.keyframes[20], 1_000_000)
    before = part.points.positions.copy(), [k.point_ids.copy() for k in part.keyframes]
    positions, ids = slam_map.positions.copy(), slam_map.keyframes[20].point_ids.copy()
    slam_map.positions += 1.0
    slam_map.keyframes[20].point_ids[:] = -1
    assert np.array_equal(part.points.positions, before[0])
    for keyframe, were in zip(part.keyframes, before[1], strict=True):
        assert np.array_equal(keyframe.point_ids, were)
    slam_map.positions, slam_map.keyframes[20].point_ids = positions, ids


def test_corruption_is_detected_anywhere(tmp_path: Path, checkpoint: Checkpoint) -> None:
    path = tmp_path / "map.checkpoint"
    keep(path, checkpoint)
    whole = path.read_bytes()
    rng = np.random.default_rng(3)
    places = [*range(60), *rng.integers(0, len(whole), 60), len(whole) - 1]
    for place in places:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        with pytest.raises(CheckpointError):
            read_arrays(bytes(damaged))
    for length in [0, 5, 12, 40, *rng.integers(0, len(whole), 20)]:
        with pytest.raises(CheckpointError):
            read_arrays(whole[:length])
    path.write_bytes(whole[: len(whole) // 2])
    assert "damaged" in refusal(path)


def test_inconsistent_arrays_are_rejected(checkpoint: Checkpoint) -> None:
    """As another program could write them, with a valid checksum."""
    wrong: list[Callable[[dict[str, object]], object]] = [
        lambda arrays: arrays.pop("pixels"),
        lambda arrays: arrays.update(pixels=np.zeros((3, 2))),
        lambda arrays: arrays.update(point_ids=np.full_like(arrays["point_ids"], 10**8)),
        lambda arrays: arrays.update(head=np.frombuffer(b"{}", np.uint8)),
        lambda arrays: arrays.update(world_from_map=np.zeros(2)),
    ]
    for spoil in wrong:
        _, arrays = read_arrays(b"".join(encode(checkpoint, {})))
        decode(arrays, CAMERA, SCALE_FACTOR)
        spoil(arrays)
        with pytest.raises(CheckpointError):
            decode(arrays, CAMERA, SCALE_FACTOR)


def test_other_camera_or_scale_source_is_rejected(tmp_path: Path, checkpoint: Checkpoint) -> None:
    path = tmp_path / "map.checkpoint"
    others = [
        Setup(Config(), replace(CAMERA, fx=501.0)),
        Setup(Config(), replace(CAMERA, body_from_camera=Pose.identity())),
        # then the scale may be the autopilot's own idea, on which it must not fly
        Setup(Config(feedback=FeedbackConfig(mode="odometry")), CAMERA),
        # or come of what is believed no more
        Setup(Config(telemetry=TelemetryConfig(use=("attitude", "imu"))), CAMERA),
    ]
    for other in others:
        keep(path, checkpoint)
        assert "are others now" in refusal(path, other)


def test_outdated_checkpoint_or_other_boot_is_rejected(
    tmp_path: Path, checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "map.checkpoint"
    now_ns = since_boot_ns()
    for age_ns, refused in (
        (MAX_ABSENT_NS - SECOND_NS, False), (MAX_ABSENT_NS + SECOND_NS, True),
        (-SECOND_NS, True),
    ):  # fmt: skip
        monkeypatch.setattr(map_keeper, "since_boot_ns", lambda: now_ns)
        keep(path, checkpoint)
        monkeypatch.setattr(map_keeper, "since_boot_ns", lambda age=age_ns: now_ns + age)
        if refused:
            assert "s old" in refusal(path)
        else:
            keeper = MapKeeper(path, SETUP)
            kept = keeper.take()
            assert kept is not None and kept.tracked_ns == now_ns
            keeper.close(forget=False)
    keep(path, checkpoint)
    monkeypatch.setattr(map_keeper, "computer_boot", lambda: "another")
    assert "started anew" in refusal(path)


def test_unwritable_path_is_reported(tmp_path: Path, checkpoint: Checkpoint) -> None:
    (tmp_path / "file").write_text("")
    keeper = MapKeeper(tmp_path / "file" / "map.checkpoint", SETUP)
    written(keeper, checkpoint)
    assert "file/map.checkpoint: Not a directory" in keeper.fault or "exists" in keeper.fault
    keeper.close(forget=True)


def test_world_writable_folder_is_not_trusted(tmp_path: Path, checkpoint: Checkpoint) -> None:
    folder = tmp_path / "open"
    keep(folder / "map.checkpoint", checkpoint)
    folder.chmod(0o777)
    keeper = MapKeeper(folder / "map.checkpoint", SETUP)
    with pytest.raises(CheckpointError, match="not ours alone"):
        keeper.take()
    written(keeper, checkpoint)
    assert "not ours alone" in keeper.fault
    keeper.close(forget=False)


def test_checkpoint_is_stored_in_memory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without a runtime folder the socket may be on an SD card."""
    monkeypatch.setattr(kept_map_place, "SHARED_MEMORY", tmp_path)
    in_memory = tmp_path / f"companion-{os.getuid()}" / "map.checkpoint"
    assert kept_map_path("auto", {}) == in_memory
    run = {"RUNTIME_DIRECTORY": "/run/companion"}
    assert kept_map_path("auto", run) == Path("/run/companion/map.checkpoint")
    assert kept_map_path("/x/status.sock", {}) == Path("/x/map.checkpoint")
    monkeypatch.setattr(kept_map_place, "SHARED_MEMORY", tmp_path / "none")
    assert kept_map_path("auto", {}).parent.name == f"companion-{os.getuid()}"


def test_finished_flight_leaves_no_checkpoint(tmp_path: Path, checkpoint: Checkpoint) -> None:
    keeper = MapKeeper(tmp_path / "map.checkpoint", SETUP)
    written(keeper, checkpoint)
    assert (tmp_path / "map.checkpoint").exists()
    keeper.close(forget=True)
    assert list(tmp_path.iterdir()) == []


def test_unreachable_position_is_rejected(checkpoint: Checkpoint) -> None:
    """At 0.5 m/s 40 m are out of reach after 2 s, but not after 20 s."""
    far = Pose(np.eye(3), np.array([16.0, 0.0, 0.0]))  # times 2.5 metres
    for absent_s, verdict in ((2.0, Verdict.TRYING), (20.0, Verdict.PROVEN)):
        resumption = Resumption(checkpoint, 0, round(absent_s * 1e9))
        for k in range(MIN_FRAMES):
            t_ns = k * 100_000_000
            track = Track(k, t_ns, TrackState.TRACKING, far, 1, far, 100, 100)
            found = resumption.check(t_ns, track, np.eye(3), Pose.identity())
        assert found is verdict
    assert "beyond its reach" not in resumption.why_not


@pytest.mark.parametrize(
    ("why_not", "n_inliers", "gap", "refused_ns"),
    [("too little", 20, False, TIMEOUT_NS), ("", 100, True, MAX_ABSENT_NS - SECOND_NS)],
)
def test_map_is_proven_by_successive_frames(
    checkpoint: Checkpoint, why_not: str, n_inliers: int, gap: bool, refused_ns: int
) -> None:
    resumption = Resumption(checkpoint, 0, SECOND_NS)
    for k in range(700):
        t_ns = k * 100_000_000
        pose = Pose.identity()
        track = Track(k, t_ns, TrackState.TRACKING, pose, 1, pose, n_inliers, n_inliers)
        seen = None if gap and k % MIN_FRAMES == MIN_FRAMES - 1 else track
        found = resumption.check(t_ns, seen, np.eye(3), Pose.identity())
        assert found is not Verdict.PROVEN
        if found is Verdict.REFUSED:
            break
    assert refused_ns <= t_ns <= refused_ns + SECOND_NS
    assert why_not in resumption.why_not


def test_missing_attitude_is_waited_for(checkpoint: Checkpoint) -> None:
    """The link opens later than the camera; its first attitudes decide."""
    turned = flown(np.zeros(2), yaw_rad=0.5).rotation
    for attitude, verdict in ((np.eye(3), Verdict.PROVEN), (turned, Verdict.REFUSED)):
        resumption, found = Resumption(checkpoint, 0, SECOND_NS), []
        for k in range(100 + MIN_FRAMES):
            pose, t_ns = Pose.identity(), k * 100_000_000
            track = Track(k, t_ns, TrackState.TRACKING, pose, 1, pose, 100, 100)
            measured = attitude if k >= 100 else None
            found.append(resumption.check(t_ns, track, measured, Pose.identity()))
        assert set(found[:100]) == {Verdict.TRYING}
        assert found[-1] is verdict
