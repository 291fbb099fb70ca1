"""Stage `topics`: publishes the flight over Zenoh to other nodes and programs.

The flight's other stages neither wait for this one nor need it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

import numpy as np

from companion.errors import StageError, StreamError
from companion.messages import (
    DepthMap,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    ObstaclesSeen,
    Odometry,
    PointChunk,
    Track,
    TrackRefined,
    Warned,
)
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_work import Work
from companion.timing.clock import monotonic_s, wait_s
from companion.topics.backlog import Backlog
from companion.topics.camera_fields import camera_fields
from companion.topics.envelope import Envelope, unpack
from companion.topics.gatherer import Gatherer
from companion.topics.keyframe_bundle import Bundle
from companion.topics.message_codec import (
    cloud_envelope,
    depth_envelope,
    keyframe_envelope,
    map_envelope,
    obstacles_envelope,
    pose_envelope,
    world_place,
)
from drivers.system.ros_messages import image_cdr, odometry_cdr, points_cdr
from drivers.system.ros_topics import RosTopics
from drivers.system.zenoh_bus import LAST, URGENT, USUAL, ZenohBus

TOPICS = {
    "pose": URGENT, "obstacles": URGENT, "keyframe": USUAL, "map": USUAL, "depth": LAST,
    "cloud": LAST,
}  # fmt: skip
BYTES_S_PER_KBIT_S = 125.0
NEW_SHARE = 0.75
"""Share of the budget for new bundles; the rest is for catching up."""
GONE_S = 5.0
LINGER_S = 10.0
"""Time after a flight for nodes that still fetch it."""
STEP_S = 0.1
MALFORMED = "questions came over the network that cannot be read"
TAKEN, NOT_TAKEN = "a node elsewhere makes the depth", "no node elsewhere makes depth any more"


class Topics(Work):
    """Builds bundles for depth nodes, and publishes topics; InputError where Zenoh is unusable."""

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        if setup.folder is None:
            raise StageError("topics need the name of the flight")
        config = setup.config.distributed
        bytes_s = BYTES_S_PER_KBIT_S * config.budget_kbit_s
        self._flight, self._run = setup.folder.name, os.urandom(8).hex()
        self._gatherer = Gatherer(self._run, NEW_SHARE * bytes_s, config.jpeg_quality)
        self._backlog = Backlog(self._run, config.backlog_mb << 20, bytes_s)
        self._update: MapUpdate | None = None
        self._is_fetched = False
        self._n_malformed, self._warn_malformed_at = 0, 1
        self.about = Envelope(
            "flight",
            {"flight": self._flight, "run": self._run, "camera": camera_fields(setup.camera)},
            {},
        ).pack()
        self.bus = ZenohBus(config)
        for topic, priority in TOPICS.items():
            self.bus.declare_publisher(topic, priority)
        self._ros: RosTopics | None = None
        if config.ros_domain >= 0:
            self._ros = RosTopics(self.bus, config.ros_domain, config.vehicle)
        self.bus.serve("flight", lambda asked: self.about)
        self.bus.serve("map", lambda asked: self._map())
        self.bus.serve("depth_input", self._depth_input)
        self.device = "nobody fetches"

    @property
    def n_rejected(self) -> int:
        """Frames beyond the budget, and bundles that nobody fetched in time."""
        return self._gatherer.n_dropped + self._backlog.n_evicted

    def step(self, message: Any) -> Iterable[Message]:
        """Take one message; warns when a node begins or ceases to fetch."""
        if isinstance(message, (Frame, Track, TrackRefined, KeyframeAdded, MapUpdate)):
            if isinstance(message, MapUpdate):
                self._update = message
            with self.times("topics"):
                bundle = self._gatherer.take(message)
                if bundle is not None:
                    self._take_bundle(bundle)
        if isinstance(message, Odometry):
            self._publish("pose", partial(pose_envelope, self._flight, message))
        elif isinstance(message, ObstaclesSeen):
            self._publish("obstacles", partial(obstacles_envelope, self._flight, message))
        elif isinstance(message, DepthMap):
            self._publish("depth", partial(depth_envelope, self._flight, message, self._update))
        elif isinstance(message, PointChunk):
            self._publish("cloud", partial(cloud_envelope, self._flight, message, self._update))
        if self._ros is not None:
            self._tell_ros(self._ros, message)
        return self._changes(message.t_ns) if isinstance(message, Frame) else []

    def _tell_ros(self, ros: RosTopics, message: Any) -> None:
        if isinstance(message, Odometry):
            ros.publish("odometry", message.t_ns, partial(odometry_cdr, message))
        elif isinstance(message, PointChunk):
            ros.publish("points", message.t_ns, partial(self._points, message))

    def _points(self, chunk: PointChunk) -> bytes | None:
        """Points for ROS in the world, which are not moved later; None without a scale."""
        world = world_place(chunk.keyframe_id, self._update)
        if world is None:
            return None
        return points_cdr(
            chunk.t_ns, world.apply(chunk.points_camera.astype(np.float64)), chunk.rgb
        )

    def finish(self, finish: Finish) -> Iterable[Message]:
        """Disconnect; if not in a hurry after the last bundle has been fetched."""
        self._take_bundle(self._gatherer.last())
        until_s = monotonic_s() + (0.0 if finish.hurry else LINGER_S)
        while self._fetches() and self._backlog.fetched < self._backlog.newest:
            if monotonic_s() > until_s:
                break
            wait_s(threading.Event(), STEP_S)
        self.bus.close()
        return []

    def _take_bundle(self, bundle: Bundle) -> None:
        self._backlog.put(bundle, self._update)
        update = self._update
        for keyframe in bundle.keyframes:
            jpeg = self._gatherer.keyframe_jpegs.get(keyframe.keyframe_id)
            if jpeg is not None:
                made = partial(keyframe_envelope, self._flight, keyframe, update, jpeg)
                self._publish("keyframe", made)
                if self._ros is not None:
                    image = partial(image_cdr, keyframe.t_ns, jpeg)
                    self._ros.publish("image/compressed", keyframe.t_ns, image)
        if bundle.change is not None and update is not None:
            self._publish("map", partial(map_envelope, self._flight, update))

    def _publish(self, topic: str, envelope: Callable[[], Envelope]) -> None:
        """Publish if there are subscribers; else the message is not even encoded."""
        if self.bus.has_subscribers(topic):
            self.bus.publish(topic, envelope().pack())

    def _map(self) -> bytes | None:
        update = self._update
        return map_envelope(self._flight, update).pack() if update is not None else None

    def _depth_input(self, asked: bytes) -> bytes | None:
        """Answer a query, in a thread of the bus; malformed queries get no answer."""
        try:
            request = unpack(asked)
            run, after = request.text("run"), request.integer("after", -1)
            whole = request.flag("whole")
        except StreamError:
            self._n_malformed += 1
            return None
        return self._backlog.after(run, after, monotonic_s(), whole)

    def _fetches(self) -> bool:
        return monotonic_s() - self._backlog.fetched_s < GONE_S

    def _changes(self, t_ns: int) -> Iterator[Message]:
        fetches = self._fetches()
        if fetches != self._is_fetched:
            self._is_fetched = fetches
            self.device = "fetched" if fetches else "nobody fetches"
            yield Warned(t_ns, TAKEN if fetches else NOT_TAKEN, good=fetches)
        if self._n_malformed >= self._warn_malformed_at:
            self._warn_malformed_at = 2 * self._n_malformed
            yield Warned(t_ns, MALFORMED, f"{self._n_malformed} so far")


work = Topics
"""The stage for a setup."""
