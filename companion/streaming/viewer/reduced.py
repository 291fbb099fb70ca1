"""Messages reduced to the data that viewers need, before they go to the exporter."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from companion.geometry.geodesy import GeoOrigin
from companion.health import Health
from companion.messages import (
    DepthMap,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Odometry,
    PointChunk,
    PositionSample,
    Track,
    Warned,
)
from companion.streaming.scene_encoder import Watched
from companion.streaming.status_facts import CURVES

SHOWN = (
    Frame, Track, Odometry, MapUpdate, PointChunk, DepthMap, KeyframeAdded, PositionSample, Warned,
    Health, GeoOrigin, *CURVES,
)  # fmt: skip
NO_FLOATS = np.zeros((0, 0), np.float32)
NO_BYTES = np.zeros((0, 0), np.uint8)


def reduced(message: Watched, width: int) -> Watched:
    """A message without data that is not shown; frames no wider than `width`."""
    if isinstance(message, Frame):
        rgb, height = message.rgb, message.rgb.shape[0]
        if width < rgb.shape[1]:
            size = (width, round(height * width / rgb.shape[1]))
            rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        return replace(message, grey=NO_BYTES, rgb=rgb)
    if isinstance(message, DepthMap):
        return replace(
            message, sigma=NO_FLOATS, state=NO_BYTES, inlier_ratio=NO_FLOATS,
            rgb=np.zeros((0, 0, 3), np.uint8),
        )  # fmt: skip
    if isinstance(message, MapUpdate):
        return replace(message, points_map=np.zeros((0, 3)))
    if isinstance(message, KeyframeAdded):
        return replace(message, points_camera=np.zeros((0, 3)))
    return message
