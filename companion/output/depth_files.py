"""What `companion depth` writes: a depth map per reference, the cloud, and a log of the times."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.geometry import Pose, Similarity
from companion.messages import DepthMap, PixelState, PointChunk
from companion.output.atomic_file import write_atomically
from companion.output.cloud import joined, placed
from companion.output.cloud_ply import ply_parts


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
    """Write cloud.ply, in the frame and unit of the poses."""
    poses = [places[chunk.keyframe_id] for chunk in chunks]
    at = [Similarity(1.0, pose.rotation, pose.translation) for pose in poses]
    cloud = joined([placed(c, place) for c, place in zip(chunks, at, strict=True)])
    write_atomically(out / "cloud.ply", ply_parts(cloud, "unknown", None))


def write_log(
    out: Path, *, device: str, layout: str, maps: Sequence[DepthMap],
    frames: Sequence[Mapping[str, Any]], stages: Mapping[str, Any],
) -> None:  # fmt: skip
    """Write depth.json."""
    references = [
        {
            **log,
            "kernel_ms": {name: round(ms, 3) for name, ms in depth_map.kernel_ms.items()},
            "pixels": {
                state.name.lower(): int((depth_map.state == state.value).sum())
                for state in PixelState
            },
            "pixels_with_depth": int((depth_map.depth > 0).sum()),
        }
        for log, depth_map in zip(frames, maps, strict=True)
    ]
    content = {"device": device, "layout": layout, "host_ms": stages, "references": references}
    write_atomically(out / "depth.json", json.dumps(content, indent=1, allow_nan=False).encode())
