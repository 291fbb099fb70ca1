"""The stages of a flight: one table, run by `in_order` (replay) and by `processes` (in flight).

A message goes to every stage that listens to it, in the order of this table, in which a stage
listens to stages above it only. The work of a stage is in `companion.stages.<name>_work`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from companion.flight_notes import GateStep, HealthNote, LinkReads, ObstaclePoints
from companion.geometry.geodesy import GeoOrigin
from companion.health import Health
from companion.messages import (
    DepthMap,
    Frame,
    FrameOverdue,
    FrameTracked,
    KeyframeAdded,
    LandingTarget,
    LoopClosed,
    MapTakenUp,
    MapUpdate,
    ObstaclesSeen,
    Odometry,
    OpticalFlow,
    PointChunk,
    SiteMapUsed,
    Track,
    TrackRefined,
    Warned,
)
from companion.runtime.mailbox import DropPolicy
from companion.telemetry import TELEMETRY, PositionSample

PLOTTED = tuple(kind for kind in TELEMETRY if kind.schema.curve)
"""Telemetry of which viewers plot a curve."""


class Frames(Enum):
    """Frames that a stage wants, of those that wait for it."""

    NEWEST = "newest"
    """Only the newest: a pose of an older one would come too late."""
    RECENT = "recent"
    """As many as there is room for; a waiting one is replaced before it leaves the daemon."""
    EVERY = "every"
    """All that there is room for."""


class Death(Enum):
    """Consequence of a stage that ends by itself, or is ended for not answering."""

    ENDS_FLIGHT = "the flight ends, and another begins"
    RESTARTED = "it is started again within the flight"


@dataclass(frozen=True, slots=True)
class Stage:
    """A row of the table. Times in seconds."""

    name: str
    listens: tuple[type, ...]
    nice: int
    """Above 19: runs only where nothing else wants the processor (SCHED_IDLE)."""
    frames: Frames = Frames.RECENT
    answer_s: float = math.inf
    """Longest step before it counts as hanging: room for a slow disk or network, and for depth a
    driver that compiles. Localisation is judged by its poses, and sooner."""
    finish_s: float = 60.0
    """Time for its last results, seconds."""
    hurried_s: float = 0.2
    """The same where the daemon is to end, which has three seconds for all stages."""
    death: Death = Death.RESTARTED
    with_flight: bool = False
    """It begins with the flight, whose name or folder it needs; else it stands by."""
    in_folder: bool = False
    """It writes into the flight's folder; each restart into one of its own."""
    is_source: bool = False
    """Other stages wait for its last results."""
    frame_every_ns: int = 0
    """Least interval of its frames; between them they are left out."""


STAGES = (
    Stage(
        "localisation", (Frame, FrameOverdue, GeoOrigin, *TELEMETRY), nice=0, frames=Frames.NEWEST,
        finish_s=300.0, hurried_s=0.7, death=Death.ENDS_FLIGHT, is_source=True,
    ),
    Stage(
        "depth", (Frame, Track, KeyframeAdded, MapUpdate), nice=20, answer_s=120.0, is_source=True,
    ),
    Stage(
        "landing", (Frame,), nice=2, frames=Frames.NEWEST, answer_s=30.0, is_source=True,
    ),
    Stage(
        "recorder",
        (
            Frame, *TELEMETRY, LinkReads, HealthNote, Warned, FrameTracked, GateStep,
            ObstaclePoints, SiteMapUsed, MapTakenUp, Odometry, OpticalFlow, LandingTarget,
            MapUpdate, PointChunk,
        ),
        nice=5, frames=Frames.EVERY, answer_s=60.0, hurried_s=0.3, with_flight=True, in_folder=True,
    ),
    Stage(
        "topics",
        (
            Frame, Odometry, Track, TrackRefined, KeyframeAdded, MapUpdate, DepthMap, PointChunk,
            ObstaclesSeen,
        ),
        nice=10, answer_s=30.0, finish_s=15.0, with_flight=True,
    ),
    Stage(
        "viewers",
        (
            Frame, PositionSample, *PLOTTED, Warned, Health, GeoOrigin, Odometry, Track,
            KeyframeAdded, MapUpdate, DepthMap, PointChunk, ObstaclesSeen,
        ),
        # not class idle, as the dense map: on a full core poses would come half a minute late,
        # and be taken for those of now
        nice=10, frames=Frames.EVERY, answer_s=30.0, finish_s=6.0, with_flight=True,
        frame_every_ns=60_000_000,
    ),
    Stage(
        "video", (Frame, Track, Odometry, DepthMap), nice=10, answer_s=30.0, finish_s=3.0,
        with_flight=True, frame_every_ns=30_000_000,
    ),
    Stage(
        "results",
        (
            Frame, *TELEMETRY, Warned, Health, GeoOrigin, Track, TrackRefined, Odometry,
            KeyframeAdded, LoopClosed, MapUpdate, DepthMap, PointChunk,
        ),
        nice=10, answer_s=180.0, finish_s=180.0, hurried_s=1.6, with_flight=True, in_folder=True,
    ),
)  # fmt: skip
NICE_WITHOUT_LOSS = 10
"""Lowest priority where nothing may be lost: beside nice 0 a tenth of a core that both want, and
all that is left."""
START_S = 300.0
"""Longest start of a stage. On an overloaded computer the imports alone take a minute and more, and
the first start of all compiles loops or kernels."""

QUEUE_BYTES = 32 << 20
"""Queue before a stage: six depth maps, or twenty-five frames, of 640x480."""
UNREAD_BYTES = 8 << 20
"""Shared memory on its way to a stage that it has not taken yet: one that is stopped would else
leave hundreds of descriptors in its socket."""
DROPPED = {
    Frame.__name__: DropPolicy.PICTURE, DepthMap.__name__: DropPolicy.PICTURE,
    PointChunk.__name__: DropPolicy.MAP, MapUpdate.__name__: DropPolicy.MAP,
    "Setup": DropPolicy.ALWAYS, "Finish": DropPolicy.ALWAYS, "SetLoadLevel": DropPolicy.ALWAYS,
    "TakeSnapshot": DropPolicy.ALWAYS, "SetBudget": DropPolicy.ALWAYS, "KeepMap": DropPolicy.ALWAYS,
    "WriteResults": DropPolicy.ALWAYS,
}  # fmt: skip
"""Policy of messages where a queue is full, by kind; all others are LOSSLESS."""


def drop_policy(stage: Stage, kind: str, in_daemon: bool) -> DropPolicy:
    """Policy of a message in the queue of a stage, in the daemon or in the stage's process."""
    replaced = stage.frames is Frames.NEWEST or (in_daemon and stage.frames is Frames.RECENT)
    if kind == Frame.__name__ and replaced:
        return DropPolicy.LATEST_WINS
    return DROPPED.get(kind, DropPolicy.LOSSLESS)


def lossless(stage: Stage) -> Stage:
    """The same row where nobody is too slow: it wants every frame."""
    return replace(stage, frames=Frames.EVERY)


def stage_named(name: str) -> Stage:
    """Row of a stage."""
    return next(stage for stage in STAGES if stage.name == name)
