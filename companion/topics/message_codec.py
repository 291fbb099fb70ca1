"""Messages of each topic as envelopes, those read here too back; schema in docs/topics.md.

Data that are not of our making are a StreamError. Frames, tracks and corrections of the map travel
in bundles (companion.topics.keyframe_bundle) to the depth node.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from companion.errors import StreamError
from companion.geometry.transforms import Pose, Similarity
from companion.messages import (
    DepthMap,
    Floats,
    Georeference,
    KeyframeAdded,
    MapUpdate,
    ObstaclesSeen,
    Odometry,
    PointChunk,
)
from companion.topics.envelope import Envelope, finite_or_none
from companion.topics.image_jpeg import jpeg_of
from companion.topics.pose_rows import PLACE_NUMBERS, place_of, place_row, pose_row

MOST_POINTS = 2_000_000
MOST_KEYFRAMES = 1_000_000
MOST_ID = 2**31 - 1
DEPTH_JPEG_QUALITY = 85
FAR_AWAY = 1e7
UNKNOWN = float("inf")


def pose_envelope(flight: str, odometry: Odometry) -> Envelope:
    """Topic `pose`: one for each frame, known or not."""
    pose, velocity = odometry.world_from_body, odometry.velocity_world_m_s
    return Envelope("pose", {
        "flight": flight, "seq": odometry.seq, "t_ns": odometry.t_ns,
        "state": odometry.state.value, "quality": odometry.quality,
        "reset_counter": odometry.reset_counter,
        "world_from_body": pose_row(pose) if pose is not None else None,
        "velocity_world_m_s": list(map(float, velocity)) if velocity is not None else None,
        "sigma_position_m": finite_or_none(odometry.sigma_position_m),
        "sigma_velocity_m_s": finite_or_none(odometry.sigma_velocity_m_s),
        "sigma_attitude_rad": finite_or_none(odometry.sigma_attitude_rad),
        "sigma_yaw_rad": finite_or_none(odometry.sigma_yaw_rad),
    }, {})  # fmt: skip


def keyframe_envelope(
    flight: str, keyframe: KeyframeAdded, update: MapUpdate | None, jpeg: bytes
) -> Envelope:
    """Topic `keyframe`: its picture, and its pose as far as known now."""
    return Envelope("keyframe", {
        "flight": flight, "keyframe_id": keyframe.keyframe_id, "seq": keyframe.seq,
        "t_ns": keyframe.t_ns, **_placed(keyframe.keyframe_id, update),
    }, {
        "jpeg": np.frombuffer(jpeg, np.uint8),
        "points_camera": keyframe.points_camera.astype(np.float32),
    })  # fmt: skip


def map_envelope(flight: str, update: MapUpdate) -> Envelope:
    """Topic `map`: poses of all keyframes. Sparse points are not sent."""
    return Envelope("map", {
        "flight": flight, "revision": update.revision, "t_ns": update.t_ns,
        "n_retired": update.n_retired, "georeference": georeference_fields(update.georeference),
    }, places_arrays(update, list(update.map_from_camera)))  # fmt: skip


def depth_envelope(flight: str, depth_map: DepthMap, update: MapUpdate | None) -> Envelope:
    """Topic `depth`: dense depth of a keyframe, in its undistorted image."""
    return Envelope("depth", {
        "flight": flight, "keyframe_id": depth_map.keyframe_id, "t_ns": depth_map.t_ns,
        "intrinsics": list(map(float, depth_map.intrinsics)), "n_updates": depth_map.n_updates,
        "kernel_ms": {name: float(ms) for name, ms in depth_map.kernel_ms.items()},
        **_placed(depth_map.keyframe_id, update),
    }, {
        "depth": depth_map.depth, "sigma": depth_map.sigma, "state": depth_map.state,
        "inlier_ratio": depth_map.inlier_ratio,
        "jpeg": np.frombuffer(jpeg_of(depth_map.rgb, DEPTH_JPEG_QUALITY), np.uint8),
    })  # fmt: skip


def cloud_envelope(flight: str, chunk: PointChunk, update: MapUpdate | None) -> Envelope:
    """Topic `cloud`: fused points of one keyframe, in its camera frame."""
    return Envelope("cloud", {
        "flight": flight, "keyframe_id": chunk.keyframe_id, "t_ns": chunk.t_ns,
        **_placed(chunk.keyframe_id, update),
    }, {
        "points_camera": chunk.points_camera, "rgb": chunk.rgb, "confidence": chunk.confidence,
        "normals_camera": chunk.normals_camera, "sigma": chunk.sigma,
        "span_ids": np.array([*chunk.spans], "<i8"),
        "span_lengths": np.array([*chunk.spans.values()], "<f8"),
    })  # fmt: skip


def obstacles_envelope(flight: str, seen: ObstaclesSeen) -> Envelope:
    """Topic `obstacles`: where the nearest things are, and how far it is free."""
    return Envelope("obstacles", {"flight": flight, "t_ns": seen.t_ns}, {
        "eye_world": seen.eye_world, "edges_world": seen.edges_world,
        "free_world": seen.free_world,
    })  # fmt: skip


def cloud_of_envelope(envelope: Envelope) -> PointChunk:
    """Back from `cloud`."""
    points = envelope.array("points_camera", "<f4", -1, 3)
    n = len(points)
    if n > MOST_POINTS:
        raise StreamError(f"cloud: {n} points")
    span_ids = envelope.array("span_ids", "<i8", -1)
    span_lengths = envelope.array("span_lengths", "<f8", len(span_ids))
    return PointChunk(
        envelope.integer("keyframe_id", 0, MOST_ID), envelope.integer("t_ns"), points,
        envelope.array("rgb", "|u1", n, 3), envelope.array("confidence", "<f4", n),
        envelope.array("normals_camera", "<f4", n, 3), envelope.array("sigma", "<f4", n),
        dict(zip(span_ids.tolist(), span_lengths.tolist(), strict=True)),
    )  # fmt: skip


def places_arrays(update: MapUpdate, keyframe_ids: list[int]) -> dict[str, Any]:
    """Poses of some keyframes of a map: `ids` (N,) and `map_from_camera` (N, 8)."""
    rows = [place_row(place) for k in keyframe_ids if (place := update.place_of(k)) is not None]
    return {
        "ids": np.array(keyframe_ids, np.int32),
        "map_from_camera": np.array(rows, np.float64).reshape(-1, PLACE_NUMBERS),
    }


def places_of(envelope: Envelope) -> dict[int, Similarity]:
    """Decoded from these arrays."""
    ids = envelope.array("ids", "<i4", -1)
    if len(ids) > MOST_KEYFRAMES or (len(ids) and ids.min() < 0):
        raise StreamError(f"{envelope.kind}: no numbers of keyframes")
    rows = envelope.array("map_from_camera", "<f8", len(ids), PLACE_NUMBERS)
    return {int(k): place_of(row) for k, row in zip(ids, rows, strict=True)}


def map_update(
    revision: int, t_ns: int, places: dict[int, Similarity], georeference: Georeference | None,
    n_retired: int,
) -> MapUpdate:  # fmt: skip
    """Map with keyframes at these poses."""
    poses = {k: Pose(place.rotation, place.translation) for k, place in places.items()}
    units = {k: place.scale for k, place in places.items() if place.scale != 1.0}
    return MapUpdate(revision, t_ns, poses, np.zeros((0, 3)), georeference, units, n_retired)


def georeference_fields(found: Georeference | None) -> dict[str, Any] | None:
    """Fields of the JSON object `georeference`."""
    if found is None:
        return None
    return {
        "world_from_map": place_row(found.world_from_map),
        "sigma_scale": finite_or_none(found.sigma_scale),
        "sigma_yaw_rad": finite_or_none(found.sigma_yaw_rad),
        "method": found.method, "n_positions": found.n_positions,
        "residual_m": finite_or_none(found.residual_m), "has_origin": found.has_origin,
    }  # fmt: skip


def georeference_of(envelope: Envelope) -> Georeference | None:
    """Decoded from the field `georeference`."""
    if not envelope.known("georeference"):
        return None
    part = envelope.part("georeference")
    numbers = [
        part.number(name, 0) if part.known(name) else UNKNOWN
        for name in ("sigma_scale", "sigma_yaw_rad", "residual_m")
    ]
    return Georeference(
        place_of(part.numbers("world_from_map", PLACE_NUMBERS, FAR_AWAY)), numbers[0], numbers[1],
        part.text("method"), part.integer("n_positions"), numbers[2], part.flag("has_origin"),
    )  # fmt: skip


def points_of(envelope: Envelope, name: str) -> Floats:
    """Points (N, 3) in front of the camera; those behind it are left out."""
    points = envelope.array(name, "<f4", -1, 3)
    if len(points) > MOST_POINTS or (len(points) and np.abs(points).max() > FAR_AWAY):
        raise StreamError(f"{envelope.kind}: {name} are no points")
    before: Floats = points[points[:, 2] > 0]
    return before


def world_place(keyframe_id: int, update: MapUpdate | None) -> Similarity | None:
    """Transform `world_from_camera` of a keyframe, scale included; None where unknown."""
    place = update.place_of(keyframe_id) if update is not None else None
    found = update.georeference if update is not None else None
    return found.world_from_map @ place if found is not None and place is not None else None


def _placed(keyframe_id: int, update: MapUpdate | None) -> dict[str, Any]:
    """`map_from_camera` and `world_from_camera` of a keyframe, null where unknown."""
    place = update.place_of(keyframe_id) if update is not None else None
    world = world_place(keyframe_id, update)
    return {
        "map_from_camera": place_row(place) if place is not None else None,
        "world_from_camera": place_row(world) if world is not None else None,
    }
