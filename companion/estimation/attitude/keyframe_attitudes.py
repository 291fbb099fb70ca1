"""Attitudes that keyframes have had of the autopilot: corrected or cleared afterwards."""

from __future__ import annotations

from collections.abc import Iterable

from companion.geometry.transforms import Array
from companion.slam.map.sparse_map import SlamMap


def clear_since(segments: Iterable[SlamMap], since_ns: int) -> None:
    """Clear attitudes since a time, which were not those of the camera."""
    for segment in segments:
        for keyframe in segment.keyframes.values():
            if keyframe.t_ns >= since_ns:
                keyframe.ned_from_camera = None


def correct_mount(segments: Iterable[SlamMap], now_from_before: Array) -> None:
    """Rotate attitudes by a correction (3, 3) of the mount."""
    for segment in segments:
        for keyframe in segment.keyframes.values():
            if keyframe.ned_from_camera is not None:
                keyframe.ned_from_camera = keyframe.ned_from_camera @ now_from_before.T
