"""One live flight: its stages as processes, from the first frame to the report.

Which stages there are, and what each listens to, is in `companion.runtime.stages`. Whoever calls
`frame` or `take` never waits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

from companion.config import Config, Measurement
from companion.daemon.flights.flown_stages import VIDEO, makes_depth, stages_of
from companion.daemon.flights.viewing import VIEWERS, Viewing
from companion.flight_notes import FlightNote, LinkBytes, LinkReads
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.health import Health
from companion.messages import (
    DepthMap,
    Frame,
    FrameOverdue,
    Georeferenced,
    LandingTarget,
    MapUpdate,
    ObstaclesSeen,
    Odometry,
    OpticalFlow,
    PointChunk,
    Track,
    Warned,
)
from companion.messages.run_facts import RunFacts
from companion.runtime.in_processes import InProcesses, Supervisor, in_words
from companion.runtime.parcel import Parcel
from companion.runtime.stage_outbox import GATHER_S
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import (
    Finish,
    KeepMap,
    Listening,
    ResultsWritten,
    SaveSiteMap,
    SetBudget,
    SetLoadLevel,
    Setup,
    Snapshot,
    TakeSnapshot,
    WriteResults,
)
from companion.runtime.stage_start import Start
from companion.runtime.stages import Stage, stage_named
from companion.telemetry import Telemetry
from companion.timing.clock import FlightClock, monotonic_s

FRAMES_APART_S = {VIEWERS: math.inf, VIDEO: 1.0}
"""Of stages whose pictures are left out first. A video that stands would pass for a broken one, and
who begins to watch gets no answer before a picture comes."""
RESTARTED = "a stage has died and is started again"
LOCALISATION_DIED = "localisation has died: the flight ends, and another begins"
NOT_DENSE = "the dense map cannot be begun now; switch it off and on to try again"
NOT_FINISHED = "a stage did not give its last results in time"
HEALTH_EVERY_NS = 1_000_000_000
GATHER_NS = round(GATHER_S * 1e9)
Taken = Telemetry | Warned | FrameOverdue | FlightNote | ObstaclesSeen
Given = Odometry | OpticalFlow | LandingTarget | Georeferenced | Snapshot
GIVEN = {kind.__name__ for kind in get_args(Given)}
MAPPED = {kind.__name__ for kind in (Track, MapUpdate, DepthMap, PointChunk)}


@dataclass(frozen=True, slots=True)
class Listener:
    """Callbacks for the output of a flight; called from its threads, must not block."""

    given: Callable[[Given], None]
    warned: Callable[[Warned], None]
    localisation_died: Callable[[], None]
    unusable: Callable[[str], None]
    """A stage could never start because of the user's input."""
    results_written: Callable[[ResultsWritten], None] = lambda _: None
    points_made: Callable[[int], None] = lambda _: None
    """Time of the keyframe whose points they are."""
    mapped: Callable[[Track | MapUpdate | DepthMap | PointChunk], None] | None = None
    """None where nobody needs them: they are large."""


class LiveFlight:
    """Processes of one flight: on standby before `begin`, then flying."""

    def __init__(
        self, config: Config, camera: Camera, clock: FlightClock,
        listener: Callable[[LiveFlight], Listener], start: Start,
    ) -> None:  # fmt: skip
        self._config, self.camera, self._clock = config, camera, clock
        self._began_s = monotonic_s()
        self._listener = listener(self)
        self.folder: Path | None = None
        """Folder of the results; None before the begin."""
        self.keep_map = False
        """True at the end of a process in the air: the next process may continue the map."""
        self.kept = False
        """True once the motors were armed: its folder stays when it ends."""
        self.n_frames = 0
        self._flies = False
        """True once the stages take messages: none gets any before the recorder does."""
        self._viewing: Viewing | None = None
        self._health_ns = 0
        self._reads: list[LinkBytes] = []
        """Bytes of the link that gather for the recorder."""
        self._origin: GeoOrigin | None = None
        self.has_origin = False
        """True once the map is georeferenced to the autopilot's origin."""
        self._dense = makes_depth(config)
        self._dense_share = 1.0
        self._processes = InProcesses(
            stages_of(config),
            start,
            Supervisor(
                self._setup, self._hear, self._say_restarted, self._die, self._listener.unusable
            ),
        )
        self._processes.start()

    @property
    def stages(self) -> dict[str, StageProcess]:
        """Processes of the stages, by name."""
        return self._processes.by_name

    @property
    def pids(self) -> dict[str, int]:
        """Process ids that are known, by stage."""
        pids = {name: process.pid for name, process in self.stages.items()}
        return {name: pid for name, pid in pids.items() if pid is not None}

    @property
    def n_restarted(self) -> dict[str, int]:
        """Restarts of each stage."""
        return self._processes.n_restarted

    @property
    def ready(self) -> bool:
        """True while frames are processed as they come."""
        return self.folder is not None and self.stages["localisation"].progress is not None

    @property
    def stages_up(self) -> bool:
        """True if every stage that can run is up, or has failed to start and is retried."""
        return self._processes.up

    def begin(self, folder: Path, keep: KeepMap | None = None) -> None:
        """Begin the flight, with its results in `folder`; `keep` says where its map is kept."""
        self.folder, self._began_s = folder, monotonic_s()
        if keep is not None:
            self._processes.order("localisation", keep)
        if VIEWERS in self.stages:  # before the exporter tells where it listens
            self._viewing = Viewing(self._config, lambda: self.stages[VIEWERS], self._warn)
        self._processes.fly()
        self._flies = True

    def frame(self, frame: Frame) -> None:
        """Take a frame of the camera's size; never waits."""
        if self._takes:
            self.n_frames += 1
            self._processes.publish(Parcel.of(frame))

    def take(self, message: Taken) -> None:
        """Take what does not come of its stages, but for frames; never waits.

        Until `finish`, also where localisation has died: that may come between what a gate decided
        and what the link then carried, and one without the other is no record.
        """
        takes = self._takes if isinstance(message, Warned) else self._flies
        if takes and isinstance(message, LinkBytes):
            self._reads.append(message)
            if message.t_ns - self._reads[0].t_ns >= GATHER_NS:
                self._publish_reads()
        elif takes:
            self._processes.take(message)

    def publish_health(self, health: Health, origin: GeoOrigin | None) -> None:
        """Send health to viewers and results once a second, and a changed world's origin."""
        if self._takes:
            self._publish_reads()  # where the link has fallen silent
        if not self._takes or health.t_ns - self._health_ns < HEALTH_EVERY_NS:
            return
        self._health_ns = health.t_ns
        self._processes.take(health)
        if origin is not None:
            self.set_origin(origin)

    def set_origin(self, origin: GeoOrigin) -> None:
        """Tell the stages the world's origin, where it has changed."""
        if origin != self._origin:
            self._origin = origin
            self._processes.take(origin)

    @property
    def viewing(self) -> Viewing | None:
        """State of the viewers; None if nobody may view."""
        return self._viewing

    def set_load_levels(self, features: float, dense: float, viewer: bool) -> None:
        """Set the share of work of the stages; see companion.runtime.governor."""
        self._processes.frames_apart_s = {} if viewer else FRAMES_APART_S
        self._dense_share = dense
        self._processes.order("localisation", SetLoadLevel(features))
        self._processes.order("depth", SetLoadLevel(dense))

    @property
    def believed(self) -> tuple[Measurement, ...]:
        """Telemetry that may decide about its pose, by `telemetry.use`."""
        return self._config.telemetry.use

    @property
    def dense(self) -> bool:
        """True while the dense map is made."""
        return self._dense

    def set_dense(self, dense: bool) -> None:
        """Start or stop dense mapping; the dense map so far stays."""
        if dense == self._dense or self._processes.over:
            return
        if not dense:
            self._dense = False
            self._processes.muted.add("depth")
            return
        try:
            self._processes.add(stage_named("depth"))
        except (OSError, RuntimeError) as error:  # no memory, process or descriptor for it
            self._warn(NOT_DENSE, in_words(error))
            return
        self._dense = True
        self._processes.muted.discard("depth")
        self._processes.order("depth", SetLoadLevel(self._dense_share))
        self._processes.bring_up_to_date("depth")

    def set_budget(self, kbit_s: float) -> None:
        """Limit the rate of all viewers together; 0 for no limit."""
        stream = replace(self._config.stream, budget_kbit_s=kbit_s)
        self._config = replace(self._config, stream=stream)
        self._processes.order(VIEWERS, SetBudget(kbit_s))

    def take_snapshot(self, number: int, origin: GeoOrigin | None) -> None:
        """Write the cloud as it is now; progress goes to the listener."""
        self._processes.order("results", TakeSnapshot(number, origin))

    def write_results(self, facts: RunFacts) -> None:
        """Write the results so far, while it goes on; the listener is told when they are."""
        self._processes.order("results", WriteResults(facts))

    @property
    def duration_s(self) -> float:
        """Seconds since it began."""
        return monotonic_s() - self._began_s

    def kill_localisation(self) -> None:
        """End a localisation that hangs."""
        self.stages["localisation"].interrupt()

    def end_stalled(self) -> None:
        """End stages that hang, so that they are restarted."""
        self._processes.end_stalled()

    def hurry(self) -> None:
        """Have `finish` end within three seconds."""
        self._processes.hurry()

    def finish(self, facts: Callable[[LiveFlight], RunFacts]) -> None:
        """Write all results and end; within three seconds after `hurry`. Blocks."""

        def finish_of(stage: Stage) -> Finish:
            hurried = self._processes.hurried
            of_flight = facts(self) if stage.name == "results" else None
            is_shown = self._viewing is not None and self._viewing.is_shown
            save = None
            if stage.name == "localisation" and self.folder is not None:
                save = SaveSiteMap(self.folder, self.folder.name, self._origin)
            return Finish(hurried, of_flight, self.keep_map, n_viewers=int(is_shown), save_map=save)

        if self._viewing is not None:
            self._viewing.open_no_more()
        self._publish_reads()
        for name, why in self._processes.finish(finish_of).items():
            if name != VIEWERS:  # of what they did not see all is in the results
                made_by = " (`companion replay` makes them of the recording)" * (name == "results")
                self._warn(NOT_FINISHED, (f"{name}: {why}" if why else name) + made_by)
        if self._viewing is not None:
            self._viewing.close(self._processes.hurried)

    def dropped(self) -> dict[str, int]:
        """Messages dropped by each stage, frames most of all."""
        return {
            "viewer messages" if name == VIEWERS else f"{name} frames": process.n_dropped
            for name, process in self.stages.items()
        }

    @property
    def _takes(self) -> bool:
        return self._flies and not self._processes.over

    def _publish_reads(self) -> None:
        """Send the bytes of the link that have gathered, in one message for all."""
        if self._reads:
            reads, self._reads = self._reads, []
            self._processes.take(LinkReads(reads[0].t_ns, tuple(reads)))

    def _setup(self, stage: Stage, n_restarted: int, failed_devices: dict[str, str]) -> Setup:
        folder = self.folder
        if folder is not None and stage.in_folder and n_restarted:
            folder = folder / f"part-{n_restarted + 1}"
        return Setup(self._config, self.camera, folder, failed_devices=failed_devices)

    def _hear(self, parcel: Parcel) -> None:
        """Take a message of a stage; called from the stages' threads."""
        if parcel.kind in GIVEN:
            given: Given = parcel.open()
            if isinstance(given, Georeferenced):
                self.has_origin = given.georeference is not None and given.georeference.has_origin
            self._listener.given(given)
        elif parcel.kind == Listening.__name__:
            if self._viewing is not None:
                self._viewing.take_port(parcel.open().port)
        elif parcel.kind == ResultsWritten.__name__:
            self._listener.results_written(parcel.open())
        elif parcel.kind == Warned.__name__:
            self._listener.warned(parcel.open())
            if not self._processes.over:
                return  # the listener hands it back, see `take`
        elif parcel.kind in MAPPED and self._listener.mapped is not None:
            self._listener.mapped(parcel.open())
        if parcel.kind == PointChunk.__name__:
            self._listener.points_made(parcel.t_ns)
        self._processes.publish(parcel)

    def _die(self, why: str) -> None:
        self._warn(LOCALISATION_DIED, why)
        self._listener.localisation_died()

    def _say_restarted(self, stage: Stage, why: str) -> None:
        if stage.name == VIEWERS and self._viewing is not None:
            self._viewing.stage_gone(why)
            return
        self._warn(RESTARTED, f"{stage.name}: {why}")

    def _warn(self, what: str, detail: str, good: bool = False) -> None:
        self._listener.warned(Warned(self._clock.now_ns(), what, detail, good))
