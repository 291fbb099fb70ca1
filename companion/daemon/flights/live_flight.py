"""One live flight: its stages, each in a process, from the first frame to the report.

    frames, telemetry -> localisation -> depth -> results, viewer
    all input, poses, warnings -> recorder
    frames, all stage output -> topics, if other nodes need it

Whoever calls `frame` or `telemetry` never waits. A stage that dies takes nothing with it but its
own state: every other stage begins again within the flight, localisation ends it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.config import Config
from companion.daemon.flights.viewing import Viewing
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.health import Health
from companion.messages import (
    DepthMap,
    Frame,
    KeyframeAdded,
    MapUpdate,
    Message,
    Odometry,
    PointChunk,
    Telemetry,
    Track,
    Warned,
)
from companion.products.flight_result import RunFacts
from companion.runtime.frame_ring import FrameRing
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import (
    Finish,
    KeepMap,
    SetLoadLevel,
    Setup,
    Snapshot,
    TakeSnapshot,
)
from companion.streaming.viewer import Watched
from companion.timing.clock import FlightClock, monotonic_s
from drivers.recording.recorded_content import HealthNote, LinkBytes

NICE = {"localisation": 0, "recorder": 5, "topics": 10, "results": 10, "depth": 20}
"""The pose has priority; the others get the remaining processor time."""
PATIENCE_S = {
    "localisation": 120.0, "depth": 60.0, "recorder": 60.0, "results": 180.0, "topics": 15.0,
}  # fmt: skip
HURRIED_S = {"localisation": 0.7, "depth": 0.2, "recorder": 0.3, "results": 1.6, "topics": 0.2}
START_S = 300.0
"""Longest start of a stage. On an overloaded computer the imports alone take a minute and more, and
the first start of all compiles loops or kernels."""
ANSWER_S = {"depth": 120.0, "recorder": 60.0, "results": 60.0, "topics": 30.0}
"""Longest step of a stage before it is restarted: depth may wait for a driver that compiles, and
has the lowest priority; the others for a slow disk or network."""
IN_FOLDER = ("recorder", "results")
"""Stages that write into the flight's folder."""
WITH_FLIGHT = (*IN_FOLDER, "topics")
"""Stages that start with the flight."""
PUBLISHED = (Odometry, Track, KeyframeAdded, MapUpdate, DepthMap, PointChunk)
"""Messages for the topics, beside frames."""
RESTARTED = "a stage has died and is started again"
STALLED = "it hung for {:.0f} s and was ended"
LOCALISATION_DIED = "localisation has died: the flight ends, and another begins"
LONGEST_WAIT_S = 30.0
"""Longest pause between two starts of a stage that dies repeatedly."""
HEALTH_EVERY_NS = 1_000_000_000
NOT_FINISHED = "a stage did not give its last results in time"


@dataclass(frozen=True, slots=True)
class Listener:
    """Callbacks for the output of a flight; called from its threads, must not block."""

    odometry: Callable[[Odometry], None]
    mapped: Callable[[Track | MapUpdate | PointChunk], None]
    warned: Callable[[Warned], None]
    localisation_died: Callable[[], None]
    unusable: Callable[[str], None]
    """A stage could never start because of the user's input."""
    snapshot: Callable[[Snapshot], None] = lambda _: None


class LiveFlight:
    """Processes of one flight: on standby before `begin`, then flying."""

    def __init__(
        self,
        config: Config,
        camera: Camera,
        clock: FlightClock,
        listener: Callable[[LiveFlight], Listener],
    ) -> None:
        self._config, self.camera, self._clock = config, camera, clock
        self._began_s = monotonic_s()
        self._listener = listener(self)
        self.folder: Path | None = None
        """Folder of the results; None before the begin."""
        self.n_restarted = {"depth": 0, "results": 0, "recorder": 0, "topics": 0}
        self._ring = FrameRing(camera.width, camera.height)
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._hurry_s: float | None = None
        self.keep_map = False
        """Whether the vehicle flies on without it, and the next process may continue its map."""
        self.n_frames = 0
        self._viewing: Viewing | None = None
        self._last_map: MapUpdate | None = None
        self._health_ns = 0
        self._origin: GeoOrigin | None = None
        self._dense = makes_depth(config)
        self._dense_share = 1.0
        self._failed_devices: dict[str, str] = {}
        """OpenCL devices that have ended the depth stage in this flight, by identity, and how."""
        self._interrupted_at: set[str] = set()
        """Devices that were at work when the stage was ended for not answering."""
        self._began_later: set[str] = set()
        """Stages started during the flight."""
        kinds = ["localisation", "results"]
        kinds += ["recorder"] * config.recorder.enabled + ["depth"] * self._dense
        kinds += ["topics"] * config.distributed.enabled
        self.stages = {kind: self._start(kind) for kind in kinds}
        for kind in kinds:
            self._set_up(kind)

    @property
    def ready(self) -> bool:
        """Whether frames are processed as they come."""
        return self.folder is not None and self.stages["localisation"].progress is not None

    @property
    def stages_up(self) -> bool:
        """Whether every stage that can run is up, or has failed to start and is retried."""
        return all(
            stage.progress is not None or self.n_restarted.get(kind, 0)
            for kind, stage in list(self.stages.items())
            if self.folder is not None or kind not in WITH_FLIGHT
        )

    def begin(self, folder: Path, keep: KeepMap | None = None) -> None:
        """Begin the flight, with its results in `folder`; `keep` says where its map is kept."""
        self.folder, self._began_s = folder, monotonic_s()
        if keep is not None:
            self.stages["localisation"].offer(keep)
        for kind in WITH_FLIGHT:
            if kind in self.stages:
                self._set_up(kind)
        if self._config.daemon.viewer != "none" or self._config.stream.listen:
            self._viewing = Viewing(self._config, self.camera, folder.name, self._warn)

    def frame(self, frame: Frame) -> None:
        """Take a frame of the camera's size; never waits."""
        if self.folder is None or self._over.is_set():
            return
        self.n_frames += 1
        place = self._ring.put(frame)
        for kind, stage in list(self.stages.items()):
            if kind != "depth" or self._dense:
                stage.offer(place)
        self._show(frame)

    def take(self, message: Telemetry | Warned) -> None:
        """Take telemetry, or a warning for the log; never waits."""
        if self.folder is None or self._over.is_set():
            return
        if not isinstance(message, Warned):
            self.stages["localisation"].offer(message)
        self.record(message)
        self._to_results(message)

    def record(self, message: Message | LinkBytes | HealthNote) -> None:
        """Send a message to the recorder only."""
        if "recorder" in self.stages and self.folder is not None and not self._over.is_set():
            self.stages["recorder"].offer(message)

    def publish_health(self, health: Health, origin: GeoOrigin | None) -> None:
        """Send health to viewers and results once a second, and a changed world's origin."""
        if self.folder is None or self._over.is_set():
            return
        if health.t_ns - self._health_ns < HEALTH_EVERY_NS:
            return
        self._health_ns = health.t_ns
        self._to_results(health)
        if origin is not None and origin != self._origin:
            self._origin = origin
            self._to_results(origin)

    @property
    def viewing(self) -> Viewing | None:
        """The viewers' exporter; None if nobody may view."""
        return self._viewing

    def set_load_levels(self, features: float, dense: float, viewer: bool) -> None:
        """Set the share of work of the stages; see companion.runtime.governor."""
        if self._viewing is not None:
            self._viewing.pictures = viewer
        self.stages["localisation"].offer(SetLoadLevel(features))
        self._dense_share = dense
        if "depth" in self.stages:
            self.stages["depth"].offer(SetLoadLevel(dense))

    @property
    def dense(self) -> bool:
        """Whether the dense map is made."""
        return self._dense

    def set_dense(self, dense: bool) -> None:
        """Start or stop dense mapping; the dense map so far stays."""
        with self._lock:
            if dense == self._dense or self._over.is_set():
                return
            if dense and "depth" not in self.stages:
                self._began_later.add("depth")
                self.stages["depth"] = self._start("depth")
                self._set_up("depth")
            self._dense = dense
        if not dense:
            return
        self._bring_up_to_date("depth")

    def set_budget(self, kbit_s: float) -> None:
        """Limit the rate of all viewers together; 0 for no limit."""
        if self._viewing is not None:
            self._viewing.set_budget(kbit_s)

    def take_snapshot(self, number: int, origin: GeoOrigin | None) -> None:
        """Write the cloud as it is now; progress goes to the listener."""
        self.stages["results"].offer(TakeSnapshot(number, origin))

    @property
    def has_origin(self) -> bool:
        """Whether the map is georeferenced to the autopilot's origin."""
        found = self._last_map.georeference if self._last_map is not None else None
        return found is not None and found.has_origin

    @property
    def duration_s(self) -> float:
        """Seconds since it began."""
        return monotonic_s() - self._began_s

    def kill_localisation(self) -> None:
        """End a localisation that hangs."""
        self.stages["localisation"].interrupt()

    def end_stalled(self) -> None:
        """End stages that hang, so that they are restarted; localisation only as it starts.

        A running localisation that hangs is detected by its poses, and sooner.
        """
        now_s = monotonic_s()
        for kind, stage in list(self.stages.items()):
            begun = stage.progress is not None
            allowed_s = ANSWER_S.get(kind, math.inf) if begun else START_S
            stalled_s = stage.stalled_s(now_s)
            if stalled_s > allowed_s and not self._over.is_set():
                stage.interrupt(STALLED.format(stalled_s))

    def hurry(self) -> None:
        """Have `finish` end within three seconds."""
        self._hurry_s = monotonic_s()

    def finish(self, facts: Callable[[LiveFlight], RunFacts]) -> None:
        """Write all results and end; within three seconds after `hurry`. Blocks."""
        with self._lock:
            self._over.set()
        if self.folder is not None:
            for kind in ("localisation", "depth"):
                self._finish(kind)
            self._ask("recorder")
            self._ask("topics")
            self._finish("results", facts(self))
            self._wait("recorder")
            self._wait("topics")
        for stage in self.stages.values():
            stage.kill()
        if self._viewing is not None:
            self._viewing.close(self._hurry_s is not None)
        self._ring.close()

    def _finish(self, kind: str, facts: RunFacts | None = None) -> None:
        self._ask(kind, facts)
        self._wait(kind)

    def _ask(self, kind: str, facts: RunFacts | None = None) -> None:
        if kind in self.stages and self.stages[kind].alive:
            hurry = self._hurry_s is not None
            self.stages[kind].ask_to_finish(Finish(hurry, facts, self.keep_map))

    def _wait(self, kind: str) -> None:
        """Wait for the last results of a stage that was asked to finish."""
        stage = self.stages.get(kind)
        if stage is None or not stage.asked_to_end:
            return
        began_s = monotonic_s()
        while not stage.wait(0.02):
            now_s = monotonic_s()
            if now_s > began_s + PATIENCE_S[kind] or (
                self._hurry_s is not None and now_s > max(began_s, self._hurry_s) + HURRIED_S[kind]
            ):
                break
        if stage.finished is None:
            why = f": {stage.failed.why}" if stage.failed is not None else ""
            self._warn(NOT_FINISHED, kind + why)

    def _start(self, kind: str) -> StageProcess:
        def ended(why: str) -> None:
            self._ended(kind, why)

        return StageProcess(
            kind, NICE[kind], self._ring, self._deliver, ended, every_frame=kind == "recorder"
        )

    def _set_up(self, kind: str) -> None:
        folder = self.folder
        if kind in WITH_FLIGHT:
            if folder is None:
                return  # what it records is yet to begin
            if kind in IN_FOLDER and self.n_restarted[kind]:
                folder = folder / f"part-{self.n_restarted[kind] + 1}"
        failed = dict(self._failed_devices)
        self.stages[kind].begin(Setup(self._config, self.camera, folder, failed))

    def _ended(self, kind: str, why: str) -> None:
        """Handle the end of a stage's process; called from its own thread."""
        if not why:
            return
        with self._lock:
            if self._over.is_set():
                return
            if kind == "localisation":
                self._over.set()
        if kind == "localisation":
            self._warn(LOCALISATION_DIED, why)
            self._listener.localisation_died()
            return
        self._warn(RESTARTED, f"{kind}: {why}")
        gone, n_before = self.stages[kind], self.n_restarted[kind]
        self._blame_driver(gone, why)
        never_up = not n_before and gone.progress is None and kind not in self._began_later
        if gone.failed is not None and gone.failed.by_input and never_up:
            self._listener.unusable(why)
        if n_before and self._over.wait(min(2.0 ** (n_before - 1), LONGEST_WAIT_S)):
            return
        with self._lock:
            if self._over.is_set():
                return
            self.n_restarted[kind] += 1
            self.stages[kind] = self._start(kind)
            gone.kill()
            self._set_up(kind)
        self._bring_up_to_date(kind)

    def _blame_driver(self, gone: StageProcess, why: str) -> None:
        """Exclude a device whose driver has ended a stage from the rest of the flight.

        A stage may have been too slow to answer for other reasons; that counts the second time.
        """
        driver = gone.driver
        if driver is None:
            return
        if gone.was_interrupted and driver.identity not in self._interrupted_at:
            self._interrupted_at.add(driver.identity)
            return
        self._failed_devices[driver.identity] = f"{driver.named}: {why}"

    def _bring_up_to_date(self, kind: str) -> None:
        """Give a stage that starts in flight the load level and the newest map."""
        if kind == "depth":
            self.stages[kind].offer(SetLoadLevel(self._dense_share))
        if self._last_map is not None:
            self.stages[kind].offer(self._last_map)

    def _deliver(self, message: Message | Snapshot) -> None:
        """Route the output of a stage; called from the stages' threads."""
        if "topics" in self.stages and isinstance(message, PUBLISHED):
            self.stages["topics"].offer(message)
        if isinstance(message, Snapshot):
            self._listener.snapshot(message)
            return
        if isinstance(message, Odometry):
            self._listener.odometry(message)
            self._show(message)
            self.record(message)
            return
        if isinstance(message, (Track, KeyframeAdded, MapUpdate)) and self._dense:
            self.stages["depth"].offer(message)
        if isinstance(message, MapUpdate):
            self._last_map = message
        if isinstance(message, (Track, MapUpdate, PointChunk)):
            self._listener.mapped(message)
        elif isinstance(message, Warned):
            self._listener.warned(message)
            if not self._over.is_set():
                return  # the listener hands it back, see `take`
        if isinstance(message, (MapUpdate, PointChunk)) and self._config.recorder.point_cloud:
            self.record(message)
        self._to_results(message)

    def _to_results(self, message: Watched) -> None:
        self.stages["results"].offer(message)
        self._show(message)

    def _show(self, message: Watched) -> None:
        if self._viewing is not None:
            self._viewing.take(message)

    def _warn(self, what: str, detail: str, good: bool = False) -> None:
        warning = Warned(self._clock.now_ns(), what, detail, good)
        self._listener.warned(warning)

    def dropped(self) -> dict[str, int]:
        """Frames dropped by each stage, and messages dropped by the viewer."""
        counts: dict[str, Any] = {f"{k} frames": s.n_dropped for k, s in self.stages.items()}
        if self._viewing is not None:
            counts["viewer messages"] = self._viewing.n_dropped
        return counts


def depth_elsewhere(config: Config) -> bool:
    """Whether another machine makes the dense map, if any does."""
    return config.distributed.enabled and "depth" not in config.distributed.stages


def makes_depth(config: Config) -> bool:
    """Whether the dense map is made here."""
    return config.depth.enabled and not depth_elsewhere(config)
