"""Checkpoint of localisation, to resume after loss of its process: a value and its bytes.

A file holds a magic number with the format version, the CRC-32 of the rest, and numpy's .npz of
plain arrays (no pickles), of which `head` is JSON.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.config import Config
from companion.errors import CompanionError
from companion.estimation.odometry.odometry_frame import OdometryState
from companion.geometry.camera import Camera
from companion.geometry.transforms import Array, Pose, Similarity
from companion.messages import Georeference
from companion.slam.features.orb_features import features_of
from companion.slam.map.map_part import MapPart
from companion.slam.map.map_points import PointArrays
from companion.slam.map.seen import Seen
from companion.slam.map.sparse_map import Keyframe

MAGIC = b"COMPMAP\x01"
"""The last byte is the format version."""
CHECK_BYTES = 4
MAX_BYTES = 4_000_000
"""Largest size of keyframes and points: some 20 keyframes around, and 4 ms to copy."""
_FEATURES: dict[str, Any] = {
    "pixels": np.float32, "octaves": np.uint8, "angles_deg": np.float32, "descriptors": np.uint8,
}  # fmt: skip
_OF_KEYFRAMES: dict[str, Any] = {
    "point_ids": np.int32, "refined_for": np.int32, "normalised": np.float32,
    "whitening": np.float32,
}  # fmt: skip
_POINTS: dict[str, Any] = {
    "positions": np.float64, "descriptors": np.uint8, "normals": np.float32,
    "base_distance": np.float64, "n_visible": np.int32, "n_found": np.int32, "born": np.int64,
    "first_seen": np.int64, "first_unproject": np.float32, "patch_centre": np.float32,
    "patch_level": np.int8, "patch_grey": np.uint8,
}  # fmt: skip
"""Types in a file; wider in the map."""


class CheckpointError(CompanionError):
    """A checkpoint cannot be used; the reason in words."""


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """State of localisation around a position in the map.

    `t_ns` is the time of the last tracked frame; `ned_from_map` (3, 3) the rotation of the map
    against the attitude in it, None without. `body_from_camera` (3, 3) and `delay_ns` are mount and
    stamp delay as estimated in flight.
    """

    t_ns: int
    part: MapPart
    next_keyframe_id: int
    ned_from_map: Array | None
    georeference: Georeference | None
    odometry: OdometryState | None
    body_from_camera: Array
    delay_ns: int


def fingerprint(config: Config, camera: Camera) -> str:
    """Hash of what must be equal for a map to be resumed: camera, features, source of scale."""
    mount = camera.body_from_camera
    features = config.features
    identity = (
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
        camera.distortion.value, camera.coefficients, features.n_levels, features.scale_factor,
        None if mount is None else mount.matrix().tolist(), config.feedback.gives_position,
        sorted(config.telemetry.use),
    )  # fmt: skip
    return hashlib.sha256(repr(identity).encode()).hexdigest()


def encode(checkpoint: Checkpoint, remarks: dict[str, Any]) -> tuple[bytes, bytes]:
    """Bytes of a file, in two parts; `remarks` are from its writer, as JSON."""
    part, found, odometry = checkpoint.part, checkpoint.georeference, checkpoint.odometry
    head: dict[str, Any] = {
        "remarks": remarks, "t_ns": checkpoint.t_ns, "late_ns": checkpoint.delay_ns,
        "next_keyframe_id": checkpoint.next_keyframe_id,
        "first_keyframe_id": part.first_keyframe_id, "level": part.level,
    }  # fmt: skip
    arrays: dict[str, Any] = {"body_from_camera": checkpoint.body_from_camera}
    if checkpoint.ned_from_map is not None:
        arrays["ned_from_map"] = checkpoint.ned_from_map
    if found is not None:
        to_world = found.world_from_map
        head["georeference"] = [
            to_world.scale, found.sigma_scale, found.sigma_yaw_rad, found.method,
            found.n_positions, found.residual_m, found.has_origin,
        ]  # fmt: skip
        arrays["world_from_map"] = Pose(to_world.rotation, to_world.translation).matrix()
    if odometry is not None:
        head["anchored"] = odometry.anchored
        arrays["odometry_from_world"] = odometry.odometry_from_world.matrix()
        arrays["motion"] = np.stack([odometry.position_m, odometry.velocity_m_s])
    arrays |= _keyframe_arrays(part.keyframes)
    for name, values in part.points._asdict().items():
        arrays[f"point_{name}"] = values.astype(_POINTS[name])
    arrays["head"] = np.frombuffer(json.dumps(head).encode(), np.uint8)
    file = io.BytesIO()
    np.savez(file, **arrays)
    payload = file.getvalue()
    return MAGIC + zlib.crc32(payload).to_bytes(CHECK_BYTES, "little"), payload


def _keyframe_arrays(keyframes: tuple[Keyframe, ...]) -> dict[str, Any]:
    missing = np.full((3, 3), np.nan)
    attitudes = [missing if k.ned_from_camera is None else k.ned_from_camera for k in keyframes]
    arrays: dict[str, Any] = {
        "keyframes": np.array(
            [[k.keyframe_id, k.seq, k.t_ns, len(k.features)] for k in keyframes], np.int64
        ),
        "camera_from_map": np.stack([k.camera_from_map.matrix() for k in keyframes]),
        "ned_from_camera": np.stack(attitudes),
    }
    for name, kind in _FEATURES.items():
        arrays[name] = np.concatenate([getattr(k.features, name).astype(kind) for k in keyframes])
    for name, kind in _OF_KEYFRAMES.items():
        arrays[name] = np.concatenate([getattr(k, name).astype(kind) for k in keyframes])
    return arrays


def read_arrays(data: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """The writer's remarks and the arrays of a file; CheckpointError where damaged."""
    start = len(MAGIC) + CHECK_BYTES
    if data[: len(MAGIC)] != MAGIC:
        raise CheckpointError("it is of another version, or no checkpoint")
    if zlib.crc32(memoryview(data)[start:]) != int.from_bytes(data[len(MAGIC) : start], "little"):
        raise CheckpointError("it is damaged")
    try:
        with np.load(io.BytesIO(data[start:]), allow_pickle=False) as file:
            arrays = dict(file)
        remarks: dict[str, Any] = json.loads(bytes(arrays["head"]))["remarks"]
    except (ValueError, KeyError, TypeError, OSError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"it cannot be read ({error})") from error
    return remarks, arrays


def decode(arrays: dict[str, Any], camera: Camera, scale_factor: float) -> Checkpoint:
    """Checkpoint from the arrays of a file, for this camera; CheckpointError where invalid.

    `scale_factor` is that between feature octaves.
    """
    try:
        return _decoded(arrays, camera, scale_factor)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CheckpointError(f"it cannot be read ({error!r})") from error


def _decoded(arrays: dict[str, Any], camera: Camera, scale_factor: float) -> Checkpoint:
    head = json.loads(bytes(arrays["head"]))
    georeference, odometry = None, None
    if "georeference" in head:
        scale, *identity = head["georeference"]
        to_world = arrays["world_from_map"]
        georeference = Georeference(Similarity(scale, to_world[:3, :3], to_world[:3, 3]), *identity)
    if "motion" in arrays:
        place_m, velocity_m_s = arrays["motion"]
        odometry_from_world = Pose.from_matrix(arrays["odometry_from_world"])
        odometry = OdometryState(odometry_from_world, head["anchored"], place_m, velocity_m_s)
    points = PointArrays(*(arrays[f"point_{name}"] for name in PointArrays._fields))
    keyframes = _keyframes(arrays, camera, scale_factor, len(points.positions))
    return Checkpoint(
        head["t_ns"],
        MapPart(head["first_keyframe_id"], head["level"], keyframes, points),
        head["next_keyframe_id"], arrays.get("ned_from_map"), georeference, odometry,
        arrays["body_from_camera"], head["late_ns"],
    )  # fmt: skip


def _keyframes(
    arrays: dict[str, Any], camera: Camera, scale_factor: float, n_points: int
) -> tuple[Keyframe, ...]:
    rows = arrays["keyframes"]
    pixels, octaves = arrays["pixels"], arrays["octaves"].astype(np.int64)
    point_ids, refined_for = (arrays[k].astype(np.int64) for k in ("point_ids", "refined_for"))
    if rows[:, 3].sum() != len(pixels) or max(point_ids.max(), refined_for.max()) >= n_points:
        raise ValueError("features, keyframes and points do not fit together")
    normalised = camera.normalise(pixels)
    out, start = [], 0
    for n, (keyframe_id, seq, t_ns, size) in enumerate(rows.tolist()):
        own = slice(start, start + size)
        start += size
        attitude = arrays["ned_from_camera"][n]
        features = features_of(
            camera, scale_factor, pixels[own], normalised[own], octaves[own],
            arrays["angles_deg"][own], arrays["descriptors"][own],
        )  # fmt: skip
        out.append(Keyframe(
            keyframe_id, seq, t_ns, Pose.from_matrix(arrays["camera_from_map"][n]),
            Seen(
                features, arrays["normalised"][own].astype(np.float64),
                arrays["whitening"][own].astype(np.float64),
            ),
            point_ids[own], refined_for[own],
            ned_from_camera=None if np.isnan(attitude).any() else attitude,
        ))  # fmt: skip
    return tuple(out)
