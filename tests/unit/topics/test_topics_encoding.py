from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.errors import StreamError
from companion.geometry.camera import Camera, Distortion
from companion.geometry.transforms import Pose
from companion.messages import ObstaclesSeen, Odometry, PointChunk, TrackRefined, TrackState
from companion.topics.camera_fields import camera_fields, camera_of
from companion.topics.envelope import Envelope, unpack
from companion.topics.image_jpeg import image_of, jpeg_of, size_of
from companion.topics.keyframe_bundle import MapChange, MapChanges, MapMirror, bundle_of, frame_of
from companion.topics.message_codec import (
    cloud_envelope,
    cloud_of_envelope,
    depth_envelope,
    map_envelope,
    obstacles_envelope,
    pose_envelope,
)
from companion.topics.pose_rows import place_of, pose_of
from tests.support.flights import flown, topic_flight


def test_an_envelope_is_as_it_was() -> None:
    arrays: dict[str, NDArray[Any]] = {
        "a": np.arange(6, dtype=np.float64).reshape(2, 3), "none": np.zeros((0, 3), np.uint8),
    }  # fmt: skip
    back = unpack(Envelope("kind", {"t_ns": 1_700_000_000_123_456_789, "x": None}, arrays).pack())
    assert back.kind == "kind" and back.fields["t_ns"] == 1_700_000_000_123_456_789
    assert np.array_equal(back.arrays["a"], arrays["a"]) and back.arrays["none"].shape == (0, 3)


def test_what_is_no_envelope_is_refused() -> None:
    good = Envelope("kind", {}, {"a": np.zeros(4, np.float32)}).pack()
    for bad in (b"", b"\xff\xff\xff\xff", good[:-1], good + b"x", good.replace(b"<f4", b"<O8")):
        with pytest.raises(StreamError):
            unpack(bad)
    with pytest.raises(StreamError):
        unpack(good.replace(b"[4]", b"[9]"))


def test_a_pose_is_as_documented() -> None:
    where = Pose(flown.WORLD_FROM_MAP.rotation, np.array([1.0, 2.0, -3.5]))
    sent = Odometry(
        5, 123, TrackState.TRACKING, 2, 80, where, np.array([0.1, 0.2, 0.3]), 0.05, 0.02, 0.01, 0.04
    )
    head = unpack(pose_envelope("f", sent).pack()).fields
    back = pose_of(head["world_from_body"])
    assert back is not None and np.allclose(back.matrix(), where.matrix(), atol=1e-12)
    assert head["velocity_world_m_s"] == [0.1, 0.2, 0.3]
    assert (head["seq"], head["t_ns"], head["state"]) == (5, 123, "tracking")
    assert (head["reset_counter"], head["quality"]) == (2, 80)
    sigmas = [
        head[f"sigma_{name}"] for name in ("position_m", "velocity_m_s", "attitude_rad", "yaw_rad")
    ]
    assert sigmas == [0.05, 0.02, 0.01, 0.04]
    lost = unpack(pose_envelope("f", Odometry(6, 124, TrackState.LOST, 2)).pack()).fields
    assert lost["world_from_body"] is None and lost["sigma_position_m"] is None


def test_obstacles_are_as_documented() -> None:
    edges = np.arange(12, dtype=np.float32).reshape(2, 2, 3)
    seen = ObstaclesSeen(7, np.array([1, 2, -3], np.float32), edges, edges[:1] + 5)
    envelope = unpack(obstacles_envelope("f", seen).pack())
    assert (envelope.kind, envelope.fields["t_ns"]) == ("obstacles", 7)
    for name in ("eye_world", "edges_world", "free_world"):
        assert np.array_equal(envelope.arrays[name], getattr(seen, name))


def test_a_cloud_says_where_it_lies_in_the_world() -> None:
    chunk = flown.chunk(3, 50)
    chunk = replace(chunk, spans={1: 0.75, 4: 2.5})
    envelope = unpack(cloud_envelope("f", chunk, flown.update()).pack())
    back = cloud_of_envelope(envelope)
    assert back.spans == chunk.spans
    for name in ("points_camera", "rgb", "confidence", "normals_camera", "sigma"):
        assert np.array_equal(getattr(back, name), getattr(chunk, name))
    scale, *place = envelope.fields["world_from_camera"]
    assert scale == pytest.approx(flown.METRES_PER_UNIT)
    true = flown.world_from_camera(3 * flown.PER_KEYFRAME)
    assert np.allclose(place[:3], true.translation)
    before = unpack(cloud_envelope("f", chunk, None).pack())
    assert before.fields["world_from_camera"] is None


def test_map_and_depth_are_as_documented() -> None:
    update = replace(flown.update(), scale_of={2: 1.5}, n_retired=1)
    of_map = unpack(map_envelope("f", update).pack())
    assert of_map.fields["n_retired"] == 1
    assert of_map.fields["georeference"]["method"] == "GPS positions"
    ids = of_map.arrays["ids"].tolist()
    assert ids == list(update.map_from_camera)
    place, true = place_of(of_map.arrays["map_from_camera"][ids.index(2)]), update.place_of(2)
    assert true is not None and place.scale == 1.5
    assert np.allclose(place.rotation, true.rotation, atol=1e-12)
    depth = flown.depth_map(4)
    of_depth = unpack(depth_envelope("f", depth, update).pack())
    assert of_depth.fields["kernel_ms"] == dict(depth.kernel_ms)
    assert tuple(of_depth.fields["intrinsics"]) == tuple(depth.intrinsics)
    for name in ("depth", "sigma", "state", "inlier_ratio"):
        assert np.array_equal(of_depth.arrays[name], getattr(depth, name))
    height, width = depth.depth.shape
    rgb = image_of(of_depth.arrays["jpeg"].tobytes(), width, height, colour=True)
    assert np.abs(rgb.astype(int) - depth.rgb).mean() < 8


def test_cameras_are_as_they_were() -> None:
    lens = Camera(
        640, 480, 500.0, 501.0, 320.5, 239.5, Distortion.RADTAN, (0.1, -0.05, 0.0, 0.001, 0.0),
        Pose(flown.WORLD_FROM_MAP.rotation, np.array([0.1, 0.0, 0.05])), readout_ms=18.0,
    )  # fmt: skip
    about = unpack(Envelope("flight", {"camera": camera_fields(lens)}, {}).pack())
    back = camera_of(about.part("camera"))
    assert [getattr(back, n) for n in ("width", "fy", "cx")] == [640, 501.0, 320.5]
    assert back.readout_ms == 18.0
    assert back.coefficients == lens.coefficients and back.distortion is lens.distortion
    assert back.body_from_camera is not None and lens.body_from_camera is not None
    assert np.allclose(back.body_from_camera.matrix(), lens.body_from_camera.matrix(), atol=1e-12)
    for wrong in ({"width": 10**6}, {"fx": 0}, {"coefficients": [1]}, {"distortion": "fish"},
                  {"readout_ms": -1}):  # fmt: skip
        with pytest.raises(StreamError):
            camera_of(Envelope("flight.camera", {**camera_fields(lens), **wrong}, {}))


def test_bundles_are_as_they_were() -> None:
    for sent in topic_flight.bundles(20):
        back = bundle_of(unpack(sent.pack()))
        assert back.pictures == list(sent.pictures) and back.number == sent.number
        assert [t.seq for t in back.tracks] == [t.seq for t in sent.tracks]
        for mine, true in zip(back.tracks, sent.tracks, strict=True):
            assert mine.keyframe_from_camera is not None and true.keyframe_from_camera is not None
            there = true.keyframe_from_camera.translation
            assert np.array_equal(mine.keyframe_from_camera.translation, there)
        assert [k.keyframe_id for k in back.keyframes] == [k.keyframe_id for k in sent.keyframes]
        for picture in back.pictures:
            image = frame_of(picture, topic_flight.CAMERA)
            true_frame = topic_flight.frame(picture.seq, topic_flight.wall())
            assert np.abs(image.grey.astype(int) - true_frame.grey).mean() < 3


def test_motions_of_a_rolling_shutter_come_along_and_impossible_ones_do_not() -> None:
    (sent, *_) = topic_flight.bundles(20)
    motions = [None, np.arange(9.0).reshape(3, 3), np.full((3, 3), 1e200)]
    tracks = [replace(sent.tracks[0], shutter_motion=motion) for motion in motions]
    back = bundle_of(unpack(replace(sent, tracks=tracks).pack())).tracks
    assert back[0].shutter_motion is None and back[2].shutter_motion is None
    assert back[1].shutter_motion is not None
    assert back[1].shutter_motion.ravel().tolist() == list(range(9))
    assert "track_shutter" not in unpack(sent.pack()).arrays


def test_refined_poses_come_along_and_such_without_a_keyframe_do_not() -> None:
    (sent, *_) = topic_flight.bundles(20)
    pose = sent.tracks[0].keyframe_from_camera
    assert pose is not None
    packed = replace(sent, refined=[TrackRefined(3, 5, 1, pose), TrackRefined(4, 6, 2, pose)])
    back = bundle_of(unpack(packed.pack())).refined
    assert [(each.seq, each.t_ns, each.keyframe_id) for each in back] == [(3, 5, 1), (4, 6, 2)]
    assert np.array_equal(back[1].keyframe_from_camera.translation, pose.translation)
    with pytest.raises(StreamError):
        bundle_of(unpack(replace(sent, refined=[TrackRefined(3, 5, -1, pose)]).pack()))


def test_a_map_is_rebuilt_from_its_changes() -> None:
    changes, mirror = MapChanges(), MapMirror()
    first = mirror.take(changes.since_last(flown.update()))
    assert len(first.map_from_camera) == len(flown.update().map_from_camera)
    moved = {**flown.update(without=(3,)).map_from_camera, 5: flown.map_from_camera(1)}
    change = changes.since_last(replace(flown.update(), map_from_camera=moved))
    assert set(change.update.map_from_camera) == {5} and change.removed == [3] and not change.whole
    second = mirror.take(change)
    assert 3 not in second.map_from_camera
    assert np.array_equal(second.map_from_camera[5].translation, moved[5].translation)
    whole = mirror.take(MapChange(flown.update(without=(7,)), (), True))
    assert 7 not in whole.map_from_camera and 3 in whole.map_from_camera


def test_a_small_file_cannot_be_a_large_picture() -> None:
    jpeg = jpeg_of(np.zeros((48, 64), np.uint8), 90)
    assert size_of(jpeg) == (64, 48) and image_of(jpeg, 64, 48, False).shape == (48, 64)
    at = jpeg.index(b"\xff\xc0") + 5
    huge = jpeg[:at] + b"\xff\xff\xff\xff" + jpeg[at + 4 :]
    for bad in (huge, jpeg[:40], b"", b"\xff\xd8\xff"):
        with pytest.raises(StreamError):
            image_of(bad, 64, 48, False)


def test_points_of_a_chunk_must_belong_together() -> None:
    chunk = flown.chunk(1, 20)
    short = PointChunk(
        1, 2, chunk.points_camera, chunk.rgb[:-1], chunk.confidence, chunk.normals_camera,
        chunk.sigma,
    )  # fmt: skip
    with pytest.raises(StreamError, match="rgb"):
        cloud_of_envelope(unpack(cloud_envelope("f", short, None).pack()))
