"""Items as bytes, and back. Little-endian; unknown values are nan.

| kind | payload |
|---|---|
| FLIGHT | JSON |
| POSE | POSE_FORM |
| STATUS | t_ns, deflated JSON |
| LOG | t_ns, whether a warning, text |
| PLACES | t_ns, then PLACE for each; WORLD is the number of world_from_map |
| PATH | t_ns, piece, keyframe, (N, 3) f32 |
| AUTOPILOT | t_ns, piece, (N, 3) f32 |
| POINTS | t_ns, keyframe, level, points as in companion.streaming.point_codec |
| PICTURE | t_ns, width, number of found points, these as u16 pairs, JPEG |
| DEPTH | t_ns, length of media type, media type, image |
| OBSTACLES | t_ns, eye (3) f32, number of edges that are near, all (N, 2, 3) i16, cm from the eye |
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import asdict
from enum import IntEnum

import numpy as np

from companion.errors import StreamError
from companion.geometry.camera import LENS, Camera
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import (
    Pose,
    Similarity,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from companion.messages import Floats
from companion.streaming.items import (
    COARSE,
    FINE,
    WHOLE,
    AutopilotPathItem,
    DepthItem,
    FlightItem,
    Item,
    LogItem,
    ObstaclesItem,
    PathItem,
    PictureItem,
    PlacesItem,
    PointsItem,
    PoseItem,
    Shown,
    StatusItem,
)
from companion.streaming.point_codec import decode_points, encode_points


class Kind(IntEnum):
    """Kinds of item on the wire."""

    FLIGHT = 1
    POSE = 2
    STATUS = 3
    LOG = 4
    PLACES = 5
    PATH = 6
    AUTOPILOT = 7
    COARSE = 8
    FINE = 9
    PICTURE = 10
    DEPTH = 11
    OBSTACLES = 12


TIME = struct.Struct("<q")
POSE_FORM = struct.Struct("<qBbHff3f4h")
PLACE = struct.Struct("<if3f4h")
PIECE = struct.Struct("<qIi")
POINTS = struct.Struct("<qiB")
PICTURE = struct.Struct("<qHH")
OBSTACLES = struct.Struct("<q3fH")
SHOWN = list(Shown)
LEVELS = [WHOLE, COARSE, FINE]
MOST_JSON_BYTES = 65536
NOWHERE_UNITS = 1e-6
"""Scale that marks a keyframe without a known pose."""
WORLD = -1


def encode(item: Item) -> bytes:
    """Bytes of an item; a raw image has none, and of places each has its own, `encode_place`."""
    if isinstance(item, FlightItem):
        return _flight(item)
    if isinstance(item, PoseItem):
        return _pose(item)
    if isinstance(item, StatusItem):
        return TIME.pack(item.t_ns) + zlib.compress(json.dumps(dict(item.facts)).encode())
    if isinstance(item, LogItem):
        return TIME.pack(item.t_ns) + bytes([item.is_warning]) + item.text.encode()
    if isinstance(item, PathItem):
        return PIECE.pack(item.t_ns, item.piece, item.keyframe_id) + _floats(item.strip)
    if isinstance(item, AutopilotPathItem):
        return PIECE.pack(item.t_ns, item.piece, -1) + _floats(item.strip)
    if isinstance(item, PointsItem):
        head = POINTS.pack(item.t_ns, item.keyframe_id, LEVELS.index(item.level))
        return head + encode_points(item.points_camera, item.rgb, item.confidence)
    if isinstance(item, PictureItem):
        found = np.clip(np.rint(item.found_px * 8), 0, 65535).astype("<u2")
        return PICTURE.pack(item.t_ns, item.width, len(found)) + found.tobytes() + item.jpeg
    if isinstance(item, DepthItem):
        media = item.media_type.encode()
        return TIME.pack(item.t_ns) + bytes([len(media)]) + media + item.image
    if isinstance(item, ObstaclesItem):
        return _obstacles(item)
    raise TypeError(f"{type(item).__name__} does not go over a link")


def decode(kind: int, data: bytes) -> Item:
    """Item of these bytes; StreamError for malformed ones."""
    try:
        return _decode(Kind(kind), data)
    except (ValueError, KeyError, TypeError, IndexError, struct.error, zlib.error) as error:
        raise StreamError(f"an item of kind {kind} cannot be decoded: {error}") from error


def _decode(kind: Kind, data: bytes) -> Item:
    if kind is Kind.FLIGHT:
        return _flight_of(data)
    if kind is Kind.POSE:
        return _pose_of(data)
    (t_ns,) = TIME.unpack_from(data)
    rest = data[TIME.size :]
    if kind is Kind.STATUS:
        facts = json.loads(zlib.decompressobj().decompress(rest, MOST_JSON_BYTES))
        if not isinstance(facts, dict):
            raise ValueError("no facts")
        return StatusItem(t_ns, facts)
    if kind is Kind.LOG:
        return LogItem(t_ns, rest[1:].decode(errors="replace"), bool(rest[0]))
    if kind is Kind.PLACES:
        return _places(t_ns, rest)
    if kind in (Kind.PATH, Kind.AUTOPILOT):
        _, piece, keyframe_id = PIECE.unpack_from(data)
        strip = _points(data[PIECE.size :])
        if kind is Kind.PATH:
            return PathItem(t_ns, piece, keyframe_id, strip)
        return AutopilotPathItem(t_ns, piece, strip)
    if kind in (Kind.COARSE, Kind.FINE):
        _, keyframe_id, level = POINTS.unpack_from(data)
        return PointsItem(t_ns, keyframe_id, LEVELS[level], *decode_points(data[POINTS.size :]))
    if kind is Kind.PICTURE:
        _, width, n = PICTURE.unpack_from(data)
        found = np.frombuffer(data, "<u2", 2 * n, PICTURE.size).reshape(n, 2)
        jpeg = data[PICTURE.size + 4 * n :]
        return PictureItem(t_ns, jpeg, width, found.astype(np.float32) / np.float32(8))
    if kind is Kind.OBSTACLES:
        return _obstacles_of(data)
    media = rest[1 : 1 + rest[0]].decode()
    return DepthItem(t_ns, rest[1 + rest[0] :], media)


def encode_place(keyframe_id: int, place: Similarity | None) -> bytes:
    """Bytes of one place; WORLD is the number of world_from_map."""
    if place is None:
        return PLACE.pack(keyframe_id, NOWHERE_UNITS, 0.0, 0.0, 0.0, *_quaternion(np.eye(3)))
    return PLACE.pack(
        keyframe_id, place.scale, *map(float, place.translation), *_quaternion(place.rotation)
    )


def _places(t_ns: int, data: bytes) -> PlacesItem:
    places: dict[int, Similarity | None] = {}
    world = None
    for keyframe_id, scale, x, y, z, *quaternion in PLACE.iter_unpack(data):
        rotation = rotation_from_quaternion(np.array(quaternion, np.float64))
        place = Similarity(scale, rotation, np.array([x, y, z]))
        if not (math.isfinite(scale) and np.isfinite(place.translation).all()):
            raise ValueError("a place that is not finite")
        if keyframe_id == WORLD:
            world = place
        else:
            places[keyframe_id] = place if scale > NOWHERE_UNITS * 1.01 else None
    return PlacesItem(t_ns, places, world)


def _pose(item: PoseItem) -> bytes:
    pose = item.world_from_camera
    where = tuple(map(float, pose.translation)) if pose is not None else (math.nan,) * 3
    turned = _quaternion(pose.rotation if pose is not None else np.eye(3))
    return POSE_FORM.pack(
        item.t_ns, SHOWN.index(item.shown), item.quality, min(item.n_found, 65535),
        _number(item.height_m), _number(item.speed_m_s), *where, *turned,
    )  # fmt: skip


def _pose_of(data: bytes) -> PoseItem:
    t_ns, shown, quality, n_found, height, speed, *place = POSE_FORM.unpack(data)
    pose = None
    if not math.isnan(place[0]):
        rotation = rotation_from_quaternion(np.array(place[3:], np.float64))
        pose = Pose(rotation, np.array(place[:3]))
    known = [None if math.isnan(value) else value for value in (height, speed)]
    return PoseItem(t_ns, SHOWN[shown], pose, n_found, quality, *known)


def _flight(item: FlightItem) -> bytes:
    document = {
        "flight_id": item.flight_id,
        "name": item.name,
        "camera": item.camera.lens,
        "origin": asdict(item.origin) if item.origin is not None else None,
    }
    return json.dumps(document).encode()


def _flight_of(data: bytes) -> FlightItem:
    found = json.loads(data)
    size = [int(found["camera"][name]) for name in LENS[:2]]
    lens = [float(found["camera"][name]) for name in LENS[2:]]
    origin = GeoOrigin(**found["origin"]) if found["origin"] is not None else None
    camera = Camera(size[0], size[1], lens[0], lens[1], lens[2], lens[3])
    return FlightItem(str(found["flight_id"]), str(found["name"]), camera, origin)


def _obstacles(item: ObstaclesItem) -> bytes:
    ends = np.concatenate([item.edges_world, item.free_world]) - item.eye_world
    head = OBSTACLES.pack(item.t_ns, *map(float, item.eye_world), len(item.edges_world))
    return head + np.clip(np.rint(100 * ends), -32768, 32767).astype("<i2").tobytes()


def _obstacles_of(data: bytes) -> ObstaclesItem:
    t_ns, *eye, n = OBSTACLES.unpack_from(data)
    ends = np.frombuffer(data, "<i2", -1, OBSTACLES.size).reshape(-1, 2, 3)
    eye_world = np.array(eye, np.float32)
    if not np.isfinite(eye_world).all() or n > len(ends):
        raise ValueError("obstacles that are nowhere")
    edges = eye_world + ends.astype(np.float32) / np.float32(100)
    return ObstaclesItem(t_ns, eye_world, edges[:n], edges[n:])


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _quaternion(rotation: np.ndarray) -> tuple[int, ...]:
    return tuple(int(v) for v in np.rint(quaternion_from_rotation(rotation) * 32767))


def _floats(strip: Floats) -> bytes:
    return np.ascontiguousarray(strip, "<f4").tobytes()


def _points(data: bytes) -> Floats:
    strip: Floats = np.frombuffer(data, "<f4").reshape(-1, 3).astype(np.float32)
    if not np.isfinite(strip).all():
        raise ValueError("a position that is not finite")
    return strip
