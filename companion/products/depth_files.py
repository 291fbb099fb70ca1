"""Files of `companion depth`: a depth map per reference, and the cloud."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from companion.geometry.transforms import Pose, Similarity
from companion.messages import DepthMap, PointChunk
from companion.products.atomic_file import write_atomically
from companion.products.cloud import joined, placed
from companion.products.cloud_ply import ply_parts


def write_depth(out: Path, depth_map: DepthMap) -> None:
    """Write depth_NNNNNN.npz, numbered like the reference frame."""
    fx, fy, cx, cy = depth_map.intrinsics
    v, u = np.indices(depth_map.depth.shape, np.float32)
    along = np.sqrt(((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2 + 1)
    file = io.BytesIO()
    np.savez_compressed(
        file,
        depth_m=depth_map.depth,
        distance_m=(depth_map.depth * along).astype(np.float32),
        sigma_m=depth_map.sigma,
        state=depth_map.state,
        inlier_ratio=depth_map.inlier_ratio,
        intrinsics=np.array(depth_map.intrinsics),
    )
    write_atomically(out / f"depth_{depth_map.keyframe_id:06d}.npz", file.getvalue())


def write_cloud(out: Path, chunks: Sequence[PointChunk], places: Mapping[int, Pose]) -> None:
    """Write cloud.ply, in the frame and units of the poses."""
    poses = [places[chunk.keyframe_id] for chunk in chunks]
    at = [Similarity(1.0, pose.rotation, pose.translation) for pose in poses]
    cloud = joined([placed(c, place) for c, place in zip(chunks, at, strict=True)])
    write_atomically(out / "cloud.ply", ply_parts(cloud, "unknown", None))
