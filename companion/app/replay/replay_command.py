"""Replay of a recorded flight through the stages of the daemon: map, recording, report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

from companion.app.progress import Progress
from companion.app.replay.landing_sent import LandingSent
from companion.app.replay.poses_sent import PosesSent
from companion.config import Config
from companion.config.passwords import command_shown
from companion.config_file import shown
from companion.errors import FlightError, StageError
from companion.estimation.site.site_use import LOCATED
from companion.geometry.geodesy import GeoOrigin
from companion.messages import (
    DepthMap,
    Frame,
    Georeferenced,
    Message,
    PointChunk,
    Track,
    TrackState,
    Warned,
)
from companion.messages.run_facts import RunFacts
from companion.products.site_map_file import map_path, read_head
from companion.products.versions import versions
from companion.runtime.gaps import with_gap_warnings
from companion.runtime.in_order import InOrder, in_order_of_time, in_words
from companion.runtime.stage_protocol import Finish, SaveSiteMap, Setup
from companion.runtime.stage_start import Start
from companion.runtime.stages import Stage, stage_named
from companion.streaming.live_viewer import LiveViewer
from companion.timing.clock import monotonic_s
from companion.timing.overdue_frames import with_notices
from drivers.flight import ENDS_EARLY, Flight
from drivers.open_flight import open_flight

LEAD_NS = 10_000_000_000
"""Telemetry used from before the first frame."""
LEAST = ("localisation", "results")
NO_DEPTH = "none (depth.enabled = false)"


class Watched:
    """State and counts of the map, taken from its messages for the progress line and the report."""

    def __init__(self) -> None:
        self.state = TrackState.INITIALISING
        self.n_points = self.n_depth_maps = 0
        self.has_tracked = False
        """True once a frame was placed in a map."""
        self.has_origin = self.located = False
        """True once the map is georeferenced, and once it was found in that of another flight."""

    def take(self, message: Message) -> None:
        """Take a message of any kind."""
        if isinstance(message, Track):
            self.see(message.state)
        elif isinstance(message, PointChunk):
            self.n_points += len(message.points_camera)
        elif isinstance(message, DepthMap):
            self.n_depth_maps += 1
        elif isinstance(message, Georeferenced):
            found = message.georeference
            self.has_origin = found is not None and found.has_origin
        elif isinstance(message, Warned) and message.what == LOCATED:
            self.located = True

    def see(self, state: TrackState) -> None:
        """Take the tracker's state at a frame."""
        self.state = state
        self.has_tracked |= state is TrackState.TRACKING

    def check(self, out: Path) -> None:
        """FlightError where no frame of the whole flight was placed."""
        if not self.has_tracked:
            raise FlightError(
                "no map: none of the pictures could be placed. A map begins where the camera moves "
                "sideways and sees the same texture in several pictures; the calibration has to "
                f"be that of the lens. What there is to see is in {out / 'report.html'}"
            )

    def origin(self, of_log: GeoOrigin | None, of_map: GeoOrigin | None) -> GeoOrigin | None:
        """Origin of the map's world: of the log, else of the map in use, if it was found there."""
        if not self.has_origin:
            return None
        return of_log or (of_map if self.located else None)


class RecordedInput:
    """Frames and telemetry of a recorded flight between two times; InputError where invalid."""

    def __init__(
        self, path: Path, config: Config, start_s: float | None = None, stop_s: float | None = None
    ) -> None:
        self.flight = open_flight(path, config.camera, config.telemetry, config.mount)
        self._start_ns, self._stop_ns = _span(self.flight, start_s, stop_s)
        self.log = self.flight.telemetry()
        self.n_frames = self.flight.n_frames_between(self._start_ns, self._stop_ns)
        self.warnings = [*self.flight.warnings, *self.log.warnings]
        """Faults of the recording."""

    def messages(self) -> Iterator[Message]:
        """All in order of time, with warnings of gaps and notices of frames that are missing."""
        yield from self.warnings
        first_ns = self._start_ns - LEAD_NS
        samples = [s for s in self.log.samples if first_ns <= s.t_ns <= self._stop_ns]
        frames = self.flight.frames(self._start_ns, self._stop_ns)
        yield from with_gap_warnings(with_notices(in_order_of_time(samples, frames)))


def replay(
    given: RecordedInput, out: Path, config: Config, viewer: str, progress: Progress,
    notify: Callable[[str], None], start: Start | None = None,
) -> None:  # fmt: skip
    """Replay a flight into the folder `out`; InputError when it cannot begin, or gives no map.

    `notify` takes remarks: OpenCL devices refused, address of the viewer. With `start` dense map
    and results get processes.

    Results so far are written also when it is interrupted or fails on the way. Where only the dense
    map fails, all frames are tracked and written with the cloud so far; then StageError.
    """
    camera, log = given.flight.camera, given.log
    watched = Watched()
    live: LiveViewer | None = None
    sent: list[PosesSent | LandingSent] = [PosesSent(config)]
    names = ("localisation", "depth", "results") if config.depth.enabled else LEAST
    if config.landing.marker != "off":
        sent.append(LandingSent(config))
        names = (*names, "landing")
    of_map = map_origin(config)
    setup = Setup(config, camera, out, origin=log.origin, is_live=False)
    takers: list[Callable[[Message], None]] = [watched.take, *(each.take for each in sent)]

    def watch(message: Message) -> None:
        for take in takers:
            take(message)

    with ExitStack() as stack:
        stages = InOrder(map(stage_named, names), setup, watch, notify, start)
        began_s = monotonic_s()
        completed = False

        def finish(stage: Stage) -> Finish:
            if stage.name == "localisation":
                save = SaveSiteMap(out, given.flight.path.name, log.origin)
                return Finish(hurry=False, save_map=save)
            if stage.name != "results":
                return Finish(hurry=False)
            origin, wall_s = watched.origin(log.origin, of_map), monotonic_s() - began_s
            dropped = {} if live is None else {"viewer messages": live.n_dropped}
            facts = _facts(given, config, stages, origin, wall_s, completed, dropped)
            return Finish(hurry=False, facts=facts)

        try:
            if viewer != "none":
                live = stack.enter_context(
                    LiveViewer(config.viewer, camera, viewer, origin=log.origin)
                )
                takers.append(live.take)
                if live.page:
                    notify(f"viewer: open {live.page}")
            progress.start(given.n_frames)
            n_done = 0
            for message in stages.looked_ahead(given.messages()):
                stages.feed(message)
                if isinstance(message, Frame):
                    n_done += 1
                    progress.update(n_done, watched.state.value, watched.n_points)
            completed = True
        finally:
            progress.finish()
            try:
                stages.finish(finish)
            finally:
                for each in sent:
                    each.write(out)
    if config.depth.enabled and stages.progress("depth").details["failures"]:
        notify(f"dense map: {stages.progress('depth').device}")
    if stages.depth_fault is not None:
        raise StageError(
            f"the dense map failed after {watched.n_depth_maps} depth maps: "
            f"{in_words(stages.depth_fault)}; path, report and the cloud so far are in {out}"
        ) from stages.depth_fault
    watched.check(out)


def _facts(
    given: RecordedInput, config: Config, stages: InOrder, origin: GeoOrigin | None,
    wall_s: float, completed: bool, dropped: Mapping[str, int],
) -> RunFacts:  # fmt: skip
    """Facts of a replay for its report."""
    return RunFacts(
        stage_times=stages.times, wall_s=wall_s, clock=given.log.clock, origin=origin,
        device=stages.progress("depth").device if config.depth.enabled else NO_DEPTH,
        config=shown(config), versions=versions(), command=command_shown(sys.argv),
        peak_memory_mb=stages.peak_memory_mb, camera=given.flight.camera,
        n_frames_total=given.n_frames, completed=completed,
        dropped={"frames": 0, "depth frames": 0, **dropped}, rates_hz=dict(given.log.rates_hz),
        believed=config.telemetry.use,
    )  # fmt: skip


def map_origin(config: Config) -> GeoOrigin | None:
    """Origin of the world of a flight that has none of its own: that of the map in use."""
    return read_head(map_path(config.map.use)).georeference.origin if config.map.use else None


def _span(flight: Flight, start_s: float | None, stop_s: float | None) -> tuple[int, int]:
    start_ns = flight.start_ns + int((start_s or 0.0) * 1e9)
    stop_ns = flight.stop_ns if stop_s is None else flight.start_ns + int(stop_s * 1e9)
    short = next((w for w in flight.warnings if w.what == ENDS_EARLY), None)
    if short is not None and (stop_s is None or stop_ns > flight.stop_ns):
        there_s = (flight.stop_ns - flight.start_ns) * 1e-9
        raise FlightError(
            f"{flight.path}: {short.what}: {short.detail}; "
            f"--stop {int(there_s * 10) / 10:g} replays what is there"
        )
    if flight.n_frames_between(start_ns, stop_ns) == 0:
        length_s = (flight.stop_ns - flight.start_ns) * 1e-9
        raise FlightError(
            f"{flight.path}: no frame between --start and --stop; it is {length_s:.1f} s long"
        )
    return start_ns, stop_ns
