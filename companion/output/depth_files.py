"""What `companion depth` writes: a depth map per reference, the cloud, and a log of the times."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.geometry import Pose
from companion.messages import DepthMap, PixelState, PointChunk
from companion.output.atomic_file import write_atomically
from companion.output.cloud_ply import cloud_ply
from companion.output.flight_result import Cloud


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
    points = [places[c.keyframe_id].apply(c.points_camera.astype(np.float64)) for c in chunks]
    cloud = Cloud(
        np.concatenate([np.zeros((0, 3)), *points]).astype(np.float32),
        np.concatenate([np.zeros((0, 3), np.uint8), *(c.rgb for c in chunks)]),
        np.concatenate([np.zeros(0, np.float32), *(c.confidence for c in chunks)]),
    )
    write_atomically(out / "cloud.ply", cloud_ply(cloud, "unknown", None))


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
