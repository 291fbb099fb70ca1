from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from companion.errors import StreamError
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose, Similarity
from companion.health import ComputerLoad, FeedbackHealth, Health, SourceHealth
from companion.messages import (
    Floats,
    MapUpdate,
    Message,
    ObstaclesSeen,
    PointChunk,
    Track,
    TrackState,
    Warned,
)
from companion.products.flight_result import FlightResult
from companion.streaming.item_codec import decode
from companion.streaming.items import (
    FlightItem,
    ImageItem,
    Item,
    LogItem,
    ObstaclesItem,
    PathItem,
    PlacesItem,
    PointsItem,
    PoseItem,
    Shown,
    StatusItem,
)
from companion.streaming.parts import parts_of
from companion.streaming.scene_encoder import SceneEncoder, Watched
from tests.support.flights import flown

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
ORIGIN = GeoOrigin(47.0, 8.0, 400.0)


def told(messages: list[Watched], encoder: SceneEncoder | None = None) -> list[Item]:
    encoder = encoder or SceneEncoder(FlightItem("a", "a", CAMERA))
    return [item for message in messages for item in encoder.take(message)]


def lost(seq: int) -> Track:
    return Track(seq, flown.time_ns(seq), TrackState.LOST)


def test_each_state_of_the_tracker_has_its_word() -> None:
    reckoned = replace(flown.track(21), state=TrackState.DEAD_RECKONING, n_inliers=0)
    items = told([flown.update(), flown.track(20), reckoned, lost(22), lost(23)])
    poses = [item for item in items if isinstance(item, PoseItem)]
    states = [Shown.TRACKING, Shown.DEAD_RECKONING, Shown.LOST, Shown.LOST]
    assert [p.shown for p in poses] == states
    assert [p.world_from_camera is not None for p in poses] == [True, True, False, False]
    assert {state.value for state in TrackState} <= {shown.value.lower() for shown in Shown}
    said = [(item.text, item.is_warning) for item in items if isinstance(item, LogItem)]
    assert said == [
        ("Tracker: tracking", False), ("Tracker: dead reckoning", True), ("Tracker: lost", True)
    ]  # fmt: skip


def test_obstacles_come_as_they_are_to_a_centimetre() -> None:
    rng = np.random.default_rng(3)
    eye = np.array([120.0, -3.5, -12.0], np.float32)
    near, free = (eye + rng.uniform(-20, 20, (n, 2, 3)).astype(np.float32) for n in (5, 2))
    (item,) = told([ObstaclesSeen(7, eye, near, free)])
    ((kind, _, payload),) = parts_of(item)
    back = decode(kind, payload)
    assert isinstance(back, ObstaclesItem) and back.t_ns == 7
    assert np.array_equal(back.eye_world, eye)
    assert back.edges_world == pytest.approx(near, abs=0.006)
    assert back.free_world == pytest.approx(free, abs=0.006)
    assert len(payload) < 120
    with pytest.raises(StreamError):
        decode(kind, payload[:-3])


def test_who_was_never_tracked_is_lost_at_once() -> None:
    (pose,) = [item for item in told([lost(5)]) if isinstance(item, PoseItem)]
    assert pose.shown is Shown.LOST and pose.world_from_camera is None


def test_a_keyframe_that_has_left_the_map_lies_nowhere_and_may_come_back() -> None:
    encoder = SceneEncoder(FlightItem("a", "a", CAMERA))
    told([flown.update()], encoder)
    gone = [i for i in told([flown.update(without=(3,))], encoder) if isinstance(i, PlacesItem)]
    assert [i.places for i in gone] == [{3: None}]
    again = told([flown.update(without=(3,))], encoder)
    assert not any(isinstance(item, PlacesItem) for item in again)
    (back,) = [i for i in told([flown.update()], encoder) if isinstance(i, PlacesItem)]
    assert list(back.places) == [3] and back.places[3] is not None


def test_the_origin_is_sent_once_the_map_is_georeferenced() -> None:
    encoder = SceneEncoder(FlightItem("a", "a", CAMERA))
    assert told([ORIGIN, flown.update(known=False)], encoder)[0].__class__ is PlacesItem
    scaled = flown.update()
    assert scaled.georeference is not None
    elsewhere = replace(scaled, georeference=replace(scaled.georeference, has_origin=False))
    assert not any(isinstance(item, FlightItem) for item in told([elsewhere], encoder))
    flights = [i for i in told([scaled, scaled], encoder) if isinstance(i, FlightItem)]
    assert [flight.origin for flight in flights] == [ORIGIN]


def test_frames_come_with_the_points_that_were_found_in_them() -> None:
    px = np.array([[10.0, 20.0]], np.float32)
    track = replace(flown.track(30), keypoints_px=px)
    half = replace(flown.frame(30), rgb=np.zeros((24, 32, 3), np.uint8))
    for frame, wanted in ((flown.frame(30), px), (half, (px + 0.5) / 2 - 0.5)):
        (image,) = [i for i in told([frame, track]) if isinstance(i, ImageItem)]
        assert image.t_ns == frame.t_ns and np.allclose(image.found_px, wanted)
    # those that nobody looks for points in are not kept for ever
    images = [i for i in told([flown.frame(seq) for seq in range(50)]) if isinstance(i, ImageItem)]
    assert [i.t_ns for i in images] == [flown.time_ns(seq) for seq in range(46)]


def test_a_thinned_path_is_thin_and_goes_through_the_same_places() -> None:
    encoder = SceneEncoder(FlightItem("a", "a", CAMERA), path_step_ns=4 * flown.STEP_NS)
    items = told([flown.track(seq) for seq in range(flown.N_FRAMES)], encoder) + encoder.close()
    last = {item.piece: item for item in items if isinstance(item, PathItem)}
    n_tracked = flown.N_FRAMES - flown.N_INITIALISING - len(flown.LOST)
    n = sum(len(item.strip) for item in last.values())
    assert n_tracked / 4 <= n <= n_tracked / 4 + 2 * len(last)
    for item in last.values():
        map_from_keyframe = flown.map_from_camera(item.keyframe_id * flown.PER_KEYFRAME)
        in_map = map_from_keyframe.apply(item.strip.astype(np.float64))
        true = np.array([flown.map_from_camera(s).translation for s in range(flown.N_FRAMES)])
        assert np.linalg.norm(in_map[:, None] - true, axis=2).min(axis=1).max() < 1e-4


def test_status_says_what_is_known_and_nothing_else() -> None:
    tracks: list[Watched] = [flown.track(seq) for seq in range(20, 100)]
    first = [i for i in told(tracks) if isinstance(i, StatusItem)]
    assert len(first) == 4  # once a second of the flight
    assert first[-1].facts["state"] == "Tracking"
    assert first[-1].facts["rate_hz"] == pytest.approx(20)
    assert "cpu_share" not in first[-1].facts and "height_m" not in first[-1].facts
    health = Health(
        flown.time_ns(100), pose_latency_p95_ms=41.234, degraded="viewer off",
        load=ComputerLoad(cpu_share=0.5, temperatures_c={"cpu": 61.0}),
        sources=(SourceHealth("camera", "silent"),),
        feedback=FeedbackHealth("odometry", False, "no scale"),
    )  # fmt: skip
    warned = Warned(flown.time_ns(99), "late telemetry", "by 2 s")
    items = told([flown.update(), warned, *tracks, health, flown.track(130)])
    facts = [i for i in items if isinstance(i, StatusItem)][-1].facts
    assert facts["latency_ms"] == 41.23 and facts["cpu_share"] == 0.5
    assert facts["temperature_c"] == 61 and facts["reduced"] == "viewer off"
    assert facts["gone"] == ["camera silent"] and facts["sending"] is False
    assert facts["why_not"] == "no scale" and facts["scale"] == "GPS positions"
    assert facts["warnings"] == ["late telemetry"]
    assert facts["height_m"] == pytest.approx(-flown.place_m(130)[2], rel=1e-3)


def stretched(by: float) -> MapUpdate:
    """The map when its later half was found to be so much longer."""
    update = flown.update()
    poses = dict(update.map_from_camera)
    half = len(poses) // 2
    hinge = poses[half].translation
    for keyframe_id in range(half + 1, len(poses)):
        pose = poses[keyframe_id]
        poses[keyframe_id] = Pose(pose.rotation, hinge + by * (pose.translation - hinge))
    return replace(update, revision=2, map_from_camera=poses, t_ns=update.t_ns + 1)


def spanned_chunk(keyframe_id: int) -> PointChunk:
    """Points as the depth stage gives them, which knows how far keyframes about it are."""
    spans = flown.update().spans_of(keyframe_id)
    return replace(flown.chunk(keyframe_id, 60), spans=spans)


def seen(items: list[Item]) -> Array:
    """All points in the world, as a viewer has them: by what came over the wire."""
    points: dict[int, list[Floats]] = {}
    places: dict[int, Similarity | None] = {}
    world: Similarity | None = None
    for item in items:
        for part in parts_of(item):
            payload = part.payload
            if isinstance(item, PlacesItem):  # a session puts several behind one time
                payload = bytes(8) + payload
            got = decode(part.kind, payload)
            if isinstance(got, PlacesItem):
                places.update(got.places)
                world = got.world_from_map or world
            elif isinstance(got, PointsItem):
                points.setdefault(got.keyframe_id, []).append(got.points_camera)
    assert world is not None
    out: list[Array] = []
    for keyframe_id, pieces in points.items():
        place = places[keyframe_id]
        assert place is not None
        out.append((world @ place).apply(np.concatenate(pieces).astype(np.float64)))
    return np.concatenate(out)


def test_the_cloud_that_viewers_have_is_the_one_that_is_written() -> None:
    ids = range(len(flown.update().map_from_camera))
    chunks = [spanned_chunk(k) for k in ids]
    messages: list[Message] = [flown.update(), *chunks, stretched(1.08)]
    result = FlightResult()
    for message in messages:
        result.take(message)
    written = result.cloud(1e-4).points
    there = seen(told([flown.update(), *chunks, stretched(1.08)]))
    assert len(there) == len(written)
    off = np.linalg.norm(there[:, None] - written, axis=2).min(axis=1)
    assert off.max() < 0.06  # what quantising takes
    flat = [replace(chunk, spans={}) for chunk in chunks]
    without = seen(told([flown.update(), *flat, stretched(1.08)]))
    assert np.linalg.norm(without[:, None] - written, axis=2).min(axis=1).max() > 0.5


def test_a_local_scale_correction_sends_transforms_only() -> None:
    encoder = SceneEncoder(FlightItem("a", "a", CAMERA))
    ids = range(len(flown.update().map_from_camera))
    told([flown.update(), *(spanned_chunk(k) for k in ids)], encoder)
    (moved,) = told([stretched(1.08)], encoder)
    assert isinstance(moved, PlacesItem)
    place = moved.places[max(ids)]
    assert place is not None and place.scale == pytest.approx(1.08)
    assert told([stretched(1.08)], encoder) == []


def test_late_points_get_the_local_scale_correction_at_once() -> None:
    encoder = SceneEncoder(FlightItem("a", "a", CAMERA))
    last = max(flown.update().map_from_camera)
    told([stretched(1.08)], encoder)
    places, _ = told([spanned_chunk(last)], encoder)
    assert isinstance(places, PlacesItem)
    place = places.places[last]
    assert place is not None and place.scale == pytest.approx(1.08)
