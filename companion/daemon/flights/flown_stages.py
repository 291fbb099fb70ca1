"""Stages of a live flight, by the configuration."""

from __future__ import annotations

from dataclasses import replace

from companion.config import Config
from companion.daemon.flights.viewing import NOWHERE, VIEWERS
from companion.messages import MapUpdate, PointChunk
from companion.runtime.stages import STAGES, Stage

VIDEO = "video"


def stages_of(config: Config) -> list[Stage]:
    """Stages of a live flight."""
    left_out = set()
    if config.daemon.viewer == NOWHERE and not (config.stream.listen or config.page.listen):
        left_out.add(VIEWERS)
    if not config.recorder.enabled:
        left_out.add("recorder")
    if not makes_depth(config):
        left_out.add("depth")
    if config.landing.marker == "off":
        left_out.add("landing")
    if not config.video.listen:
        left_out.add(VIDEO)
    if not config.distributed.enabled:
        left_out.add("topics")
    rows = [stage for stage in STAGES if stage.name not in left_out]
    if config.recorder.point_cloud:
        return rows
    unwanted = (MapUpdate, PointChunk)
    return [
        replace(row, listens=tuple(kind for kind in row.listens if kind not in unwanted))
        if row.name == "recorder"
        else row
        for row in rows
    ]


def depth_elsewhere(config: Config) -> bool:
    """True if another machine makes the dense map."""
    return config.distributed.enabled and "depth" not in config.distributed.stages


def makes_depth(config: Config) -> bool:
    """True if the dense map is made on this machine."""
    return config.depth.enabled and not depth_elsewhere(config)
