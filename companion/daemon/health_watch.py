"""Health of the daemon, and the reactions to it.

The governor's load levels go to the flight from here, and a hanging pose loop is detected here.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from companion import __version__
from companion.config import Config
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.flown_stages import makes_depth
from companion.daemon.flights.viewing import VIEWERS
from companion.daemon.pose.senders import Senders
from companion.health import (
    ComputerLoad,
    Health,
    StageHealth,
)
from companion.messages import Georeferenced, Odometry, TrackState, Warned
from companion.meters import LatencyMeter, StageMeter
from companion.runtime.governor import Governor, LoadSample
from companion.status_lines import StatusLines, line_of
from companion.timing.clock import FlightClock, monotonic_s
from drivers.camera.camera_feed import CameraFeed
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.system.journal import Journal
from drivers.system.system_load import SystemLoad
from drivers.system.ticks import tick

GOVERN_NS = 1_000_000_000
MAX_ARRIVALS = 64
STUCK_NS = 3_000_000_000
"""Time with frames but no track after which the pose loop counts as hanging."""
BUSY_STUCK_NS, BUSY_CORES = 10_000_000_000, 0.02
"""The same where it uses the processor, by so many cores at least: the computer is overloaded."""
START_S = 120.0
"""Longest start of localisation; the first of all may compile its loops."""
VIEWER_KEPT_NS = 5_000_000_000
"""The viewer is kept for so long after a view of the setup has asked for its pictures: it asks five
times a second, the page passes that on every two seconds."""
PATIENCE_NS = 20_000_000_000
"""Time with frames but no track, after a restart of localisation, before the daemon gives up."""
NO_SIGN_S = 10.0
"""A stage in one step for longer is reported as down; it is restarted later, see live_flight."""
SETTLE_NS = 3_000_000_000
"""Time after the begin of a map that is ignored: initialisation is slow."""
STUCK = "localisation hangs and is ended"
IN_WORDS = {
    TrackState.INITIALISING: "initialising",
    TrackState.TRACKING: "tracking",
    TrackState.DEAD_RECKONING: "dead reckoning",
    TrackState.LOST: "lost",
    TrackState.STANDING: "standing",
}


class HealthWatch:
    """Counts messages and computes health. To be used in the event loop."""

    def __init__(
        self,
        config: Config,
        clock: FlightClock,
        journal: Journal,
        feed: CameraFeed,
        link: AutopilotLink | None,
        senders: Senders | None,
        flights: Flights,
        loop_delay: LatencyMeter,
    ) -> None:
        self._clock, self._journal, self._flights = clock, journal, flights
        self._feed, self._link, self._senders = feed, link, senders
        self._loop_delay = loop_delay
        self._began_ns = clock.now_ns()
        self._config, self._believed = config.daemon, config.telemetry.use
        self._governor = Governor(config.daemon.hot_c)
        self._governor.makes_depth = makes_depth(config)
        self._lines = StatusLines(config.daemon.status_every_s)
        self._load_reader = SystemLoad(Path(config.daemon.flights))
        self.load = ComputerLoad()
        self._governed_ns = 0
        self._settled_ns = 0
        self._n_dropped = 0
        self._viewer_until_ns = 0
        """Time until which the viewer is kept, at any load level."""
        self._last_frame_ns = 0
        self._odometry: Odometry | None = None
        self._odometry_ns = 0
        self._progress_ns = self._began_ns
        self._has_tracked = False
        """True once localisation has given anything: a later start compiles nothing any more."""
        self.flight_due = False
        """True while a flight is to begin and cannot yet: then it is missed that no pose comes."""
        self._scale = ""
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=MAX_ARRIVALS)
        """Time of the latest frames, and of their arrival."""
        self._recent = LatencyMeter(1.0)
        """From arrival to pose: less work shortens nothing else of a pose's latency."""
        self.set_by_ground: Mapping[str, Any] = {}
        """Keys of the configuration, and the values set by the ground."""
        self._pose = StageMeter("localisation")
        self._depth = StageMeter("depth")

    @property
    def too_hot(self) -> bool:
        """True while the load level is reduced because of the temperature."""
        return "hot" in self._governor.why

    def reconfigure(self, config: Config) -> None:
        """Apply a changed configuration."""
        self._believed = config.telemetry.use
        is_other = config.daemon.hot_c != self._config.hot_c
        if is_other or makes_depth(config) != self._governor.makes_depth:
            self._governor = Governor(config.daemon.hot_c) if is_other else self._governor
            self._governor.makes_depth = makes_depth(config)
            self._apply()
        if config.daemon == self._config:
            return
        self._config = config.daemon
        self._lines = StatusLines(config.daemon.status_every_s)

    def restart(self) -> None:
        """Begin another flight."""
        self._odometry, self._scale, self._n_dropped = None, "", 0
        self._odometry_ns = self._clock.now_ns()
        self._governed_ns = 0

    def keep_viewer(self) -> None:
        """Keep the viewer's pictures for some seconds; the motors are disarmed."""
        self._viewer_until_ns = self._clock.now_ns() + VIEWER_KEPT_NS

    def armed(self) -> None:
        """Take that the motors are armed: at any load the pose has priority again."""
        self._viewer_until_ns = 0

    def frame_came(self, t_ns: int) -> None:
        """Count a frame of this time; from the camera's thread."""
        now_ns = self._clock.now_ns()
        self._last_frame_ns = now_ns
        self._arrivals.append((t_ns, now_ns))

    def take_odometry(self, odometry: Odometry) -> None:
        """Count the odometry of a frame."""
        now_ns = self._clock.now_ns()
        if odometry.state is not TrackState.TRACKING:
            self._settled_ns = now_ns + SETTLE_NS
        self._odometry, self._odometry_ns, self._progress_ns = odometry, now_ns, now_ns
        self._has_tracked = True
        self._pose.done(now_ns, odometry.t_ns)
        came_ns = next((at for t, at in tuple(self._arrivals) if t == odometry.t_ns), None)
        if came_ns is not None:
            self._recent.add(now_ns, (now_ns - came_ns) * 1e-6)

    def take_georeference(self, told: Georeferenced) -> None:
        """Take the source of the scale."""
        found = told.georeference
        self._scale = found.method if found is not None else ""

    def points_made(self, t_ns: int) -> None:
        """Take the latency of depth from the time of a keyframe whose points have come."""
        self._depth.done(self._clock.now_ns(), t_ns)

    @property
    def up(self) -> bool:
        """True if the stages are ready for frames, and the link is open."""
        link_open = self._link is None or self._link.health.state != "missing"
        return link_open and self._flights.stages_up

    @property
    def progress(self) -> bool:
        """False where frames come but no pose has for long, though one is due; ask often."""
        now_ns = self._clock.now_ns()
        frames_come = now_ns - self._last_frame_ns < GOVERN_NS
        is_wanted = self._flights.current is not None or self.flight_due
        compiles = self._starts and not self._has_tracked
        if not is_wanted or not frames_come or compiles:
            self._progress_ns = now_ns
        return now_ns - self._progress_ns < PATIENCE_NS

    @property
    def _starts(self) -> bool:
        """True while localisation starts, and may take longer for that."""
        flight = self._flights.current
        return flight is not None and not flight.ready and flight.duration_s < START_S

    @property
    def pose_loop_alive(self) -> bool:
        """False while frames come to a pose loop that gives nothing."""
        flight, now_ns = self._flights.current, self._clock.now_ns()
        frames_come = now_ns - self._last_frame_ns < GOVERN_NS
        if flight is None or not flight.ready or not frames_come:
            self._odometry_ns = max(self._odometry_ns, now_ns - STUCK_NS // 2)
            return flight is None or flight.ready or self._starts
        works = any(
            each.name == "localisation" and each.cpu_cores > BUSY_CORES
            for each in self.load.processes
        )
        return now_ns - self._odometry_ns < (BUSY_STUCK_NS if works else STUCK_NS)

    def kill_stuck(self) -> None:
        """End a localisation that hangs, so that it is restarted."""
        flight, now_ns = self._flights.current, self._clock.now_ns()
        if flight is not None:
            self._odometry_ns = now_ns
            self._journal.warn(Warned(now_ns, STUCK))
            flight.kill_localisation()

    def end_stalled(self) -> None:
        """End any other stage that hangs."""
        for flight in (self._flights.current, self._flights.standby):
            if flight is not None:
                flight.end_stalled()

    async def govern(self) -> None:
        """Read the load and set load levels; ends by cancellation."""
        loop = asyncio.get_running_loop()
        while True:
            flight = self._flights.current
            pids = {"daemon": 0} | (flight.pids if flight is not None else {})
            self.load = await loop.run_in_executor(None, self._load_reader.read, pids)
            self._step_governor()
            await tick(GOVERN_NS * 1e-9)

    def _step_governor(self) -> None:
        flight, now_ns = self._flights.current, self._clock.now_ns()
        keeps_viewer = now_ns < self._viewer_until_ns
        if keeps_viewer != self._governor.keeps_viewer:
            self._governor.keeps_viewer = keeps_viewer
            self._apply()
        if flight is None or not flight.ready or now_ns < self._settled_ns:
            return
        n_dropped = flight.stages["localisation"].n_dropped
        if not self._governed_ns:  # the levels of the flight before hold for this one
            self._governed_ns, self._n_dropped = now_ns, n_dropped
            self._apply()
            return
        dropped_hz = (n_dropped - self._n_dropped) * 1e9 / (now_ns - self._governed_ns)
        self._n_dropped, self._governed_ns = n_dropped, now_ns
        changed = self._governor.step(now_ns, LoadSample(
            cpu_share=self.load.cpu_share,
            memory_share=self.load.memory_share,
            temperature_c=self.load.temperature_c,
            pose_latency_p95_ms=self._recent.percentile_ms(95, now_ns),
            pose_dropped_hz=dropped_hz,
        ))  # fmt: skip
        if changed:
            self._apply()

    def _apply(self) -> None:
        level = self._governor.level
        if self._flights.current is not None:
            self._flights.current.set_load_levels(
                level.feature_share, level.dense_share, level.viewer
            )

    def line_due(self, health: Health) -> str | None:
        """Status line for the journal, by the health now, if due."""
        return self._lines.step(health)

    def document(self) -> dict[str, Any]:
        """Status document of `companion status`."""
        flight = self._flights.current
        believed = self._believed if flight is None else flight.believed
        health = self.health()
        return {
            "version": __version__, "believed": list(believed), **health.to_json(),
            "line": line_of(health),
        }  # fmt: skip

    def health(self) -> Health:
        """Health now."""
        now_ns, flight = self._clock.now_ns(), self._flights.current
        odometry = self._odometry if flight is not None else None
        pose = self._pose.health(now_ns)
        sources = [self._feed.health] + ([self._link.health] if self._link is not None else [])
        return Health(
            t_ns=now_ns,
            uptime_s=(now_ns - self._began_ns) * 1e-9,
            sources=tuple(sources),
            stages=self._stages(now_ns, pose),
            tracker=self._tracker(),
            quality=odometry.quality if odometry is not None else -1,
            scale=self._scale,
            refused={} if odometry is None else odometry.refused,
            pose_latency_p95_ms=pose.latency_p95_ms,
            **(self._senders.health() if self._senders is not None else {}),
            flight=flight.folder.name if flight and flight.folder and flight.kept else "",
            load=self.load,
            degradation=self._governor.level.number,
            degraded=self._governor.degraded,
            loop_delay_p99_ms=self._loop_delay.percentile_ms(99, now_ns),
            n_warnings=dict(self._journal.n_warnings),
            set_by_ground=dict(self.set_by_ground),
        )

    def _tracker(self) -> str:
        flight = self._flights.current
        if flight is None:
            there = self._feed.health.state in ("running", "frozen", "silent", "ended")
            return "waiting for the autopilot" if there else "waiting for the camera"
        if self._odometry is None:
            return "starting"
        return IN_WORDS[self._odometry.state]

    def _stages(self, now_ns: int, pose: StageHealth) -> tuple[StageHealth, ...]:
        flight = self._flights.current
        if flight is None:
            return ()
        out = []
        now_s = monotonic_s()
        for kind, stage in flight.stages.items():
            measured = StageHealth(kind)
            if kind == "localisation":
                measured = pose
            elif kind == "depth":
                measured = self._depth.health(now_ns)
            said = stage.progress
            detail = said.device if said is not None else "starting"
            no_sign_s = stage.stalled_s(now_s)
            is_off = kind == "depth" and not flight.dense
            hangs = said is not None and no_sign_s > NO_SIGN_S and not is_off
            if is_off:
                detail = "switched off"
            n_dropped = stage.n_dropped
            if kind == VIEWERS and flight.viewing is not None:
                detail, n_dropped = flight.viewing.detail, n_dropped + flight.viewing.n_skipped
            out.append(
                replace(
                    measured,
                    alive=stage.alive and not hangs,
                    n=said.n_done if said is not None else 0,
                    n_dropped=n_dropped,
                    waiting_mb=stage.waiting_bytes * 1e-6,
                    n_restarted=flight.n_restarted.get(kind, 0),
                    detail=f"no sign of it for {no_sign_s:.0f} s" if hangs else detail,
                )
            )
        return tuple(out)
