"""Parts of items on the wire: bytes, their kind, and the key by which they are replaced."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.streaming.item_codec import WORLD, Kind, encode, encode_place
from companion.streaming.items import (
    COARSE,
    FINE,
    AutopilotPathItem,
    DepthItem,
    FlightItem,
    Item,
    LogItem,
    ObstaclesItem,
    PathItem,
    PlacesItem,
    PointsItem,
    PoseItem,
)
from companion.streaming.point_codec import coarse_of

COARSE_CELLS = 60
"""Voxel size of the coarse level over the median distance."""
COARSE_MOST = 1500
NEWEST = 0
"""Key of items of which there is only one."""
SINGLE: dict[type[Item], Kind] = {
    PoseItem: Kind.POSE, FlightItem: Kind.FLIGHT, DepthItem: Kind.DEPTH, LogItem: Kind.LOG,
    ObstaclesItem: Kind.OBSTACLES,
}  # fmt: skip


class Part(NamedTuple):
    """Bytes for the wire."""

    kind: Kind
    key: Hashable
    payload: bytes


def parts_of(item: Item) -> list[Part]:
    """Parts of an item. Pictures and status have none: they are encoded for each viewer."""
    if isinstance(item, PointsItem):
        return _points(item)
    if isinstance(item, PlacesItem):
        parts = [Part(Kind.PLACES, k, encode_place(k, p)) for k, p in item.places.items()]
        if item.world_from_map is not None:
            parts.append(Part(Kind.PLACES, WORLD, encode_place(WORLD, item.world_from_map)))
        return parts
    if isinstance(item, PathItem | AutopilotPathItem):
        kind = Kind.PATH if isinstance(item, PathItem) else Kind.AUTOPILOT
        return [Part(kind, item.piece, encode(item))]
    if type(item) in SINGLE:
        return [Part(SINGLE[type(item)], NEWEST, encode(item))]
    return []


def _points(item: PointsItem) -> list[Part]:
    """Points in two levels of detail; the second holds what the first lacks."""
    n = len(item.points_camera)
    if n == 0:
        return []
    side = max(float(np.median(item.points_camera[:, 2])) / COARSE_CELLS, 1e-9)
    chosen = np.zeros(n, bool)
    chosen[coarse_of(item.points_camera, side, COARSE_MOST)] = True
    out = []
    for kind, level, those in ((Kind.COARSE, COARSE, chosen), (Kind.FINE, FINE, ~chosen)):
        part = replace(
            item, level=level, points_camera=item.points_camera[those], rgb=item.rgb[those],
            confidence=item.confidence[those],
        )  # fmt: skip
        out.append(Part(kind, item.keyframe_id, encode(part)))
    return out
