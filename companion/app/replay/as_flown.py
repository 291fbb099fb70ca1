"""Replay of a recording as flown: what the autopilot was sent is computed again and compared.

Of images recorded without loss all stages up to the gates are replayed: telemetry, frames and
mapping in their recorded order, at the recorded load levels. Else other pixels would give other
poses: then only the gates are replayed, on the recorded odometry, landing targets and optical flow.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from companion.app.progress import Progress
from companion.app.replay.obstacles_again import ObstaclesAgain
from companion.app.replay.sent_again import Payloads, SentAgain, steps_as_tracked
from companion.config import Config
from companion.errors import FlightError, StageError
from companion.estimation.gate.gate_journal import OBSTACLES
from companion.estimation.gate.gates_again import placed_values
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.landing.marker_detector import MarkerDetector
from companion.estimation.localisation import LocalisationStage
from companion.estimation.resumption.checkpoint import CheckpointError, decode, read_arrays
from companion.estimation.resumption.map_resumption import MAP_NOT_RECOGNISED
from companion.estimation.satellites.satellite_watch import doubts
from companion.estimation.site.site_use import SiteUse
from companion.geometry.camera import Camera
from companion.geometry.geodesy import GeoOrigin
from companion.messages import (
    Frame,
    FrameOverdue,
    FrameTracked,
    LandingTarget,
    MapUpdate,
    Message,
    Odometry,
    OpticalFlow,
    Warned,
)
from companion.products.atomic_file import write_atomically
from companion.products.site_map_file import map_path, read_site_map
from companion.timing.clock import StageTimes
from drivers.recording.decisions import Decisions, decisions_of
from drivers.recording.flights_folder import RECORDING
from drivers.recording.recording_as_flight import RecordedFlight, open_recording

AS_FLOWN = "as_flown.json"


def replay_as_flown(
    path: Path, out: Path, config: Config, progress: Progress, notify: Callable[[str], None]
) -> None:
    """Compare what is sent with what was; the result goes to `out`/as_flown.json.

    The settings are those of the flight; where `map.use` of `config` is set, the site map that the
    flight used is there. FlightError where the flight's decisions are not recorded, or that map is
    not to be had; StageError where a message differs.
    """
    path = path / RECORDING if path.is_dir() else path
    flight = open_recording(path, config.camera, config.telemetry)
    try:
        told = decisions_of(flight.recording)
        if told.lossless:
            tracked = _tracked_again(flight, told, config, progress)
        else:
            tracked = Tracked(told.odometry, told.targets, told.flows)
            notify(
                "images were compressed with losses: the recorded odometry, landing targets and "
                "optical flow go to the gates"
            )
    finally:
        flight.recording.close()
    made = _made_again(told, tracked)
    by_gate = {
        gate: _compared(made.get(gate, []), told.sent.get(gate, []))
        for gate in sorted({*made, *told.sent} & {step.gate for step in told.gates})
        if told.lossless or gate != OBSTACLES
    }
    not_made = {gate: len(sent) for gate, sent in told.sent.items() if gate not in by_gate}
    n_tracked = sum(_same(tracked.odometry.get(n), each) for n, each in told.odometry.items())
    n_seen = sum(_same_target(tracked.targets.get(n), each) for n, each in told.targets.items())
    out.mkdir(parents=True, exist_ok=True)
    totals = {
        name: sum(each[name] for each in by_gate.values())
        for name in ("sent", "made_again", "same")
    }
    found = {
        **totals, "by_gate": by_gate, "not_made_again": not_made,
        "frames": len(told.odometry), "frames_same": n_tracked,
        "targets": len(told.targets), "targets_same": n_seen, "tracked_again": told.lossless,
    }  # fmt: skip
    write_atomically(out / AS_FLOWN, json.dumps(found, indent=1).encode())
    if told.lossless:
        notify(f"{n_tracked} of {len(told.odometry)} frames have the same odometry")
        if told.targets:
            notify(f"{n_seen} of {len(told.targets)} frames have the same landing target")
    _check_same(path, by_gate)
    for gate, n in not_made.items():
        why = (
            "they are found in images, which were compressed with losses"
            if gate == OBSTACLES and not told.lossless
            else "the recording is of a version that kept no journal of them"
        )
        notify(f"{n} messages of `{gate}` were sent and are not made again: {why}")
    parts = ", ".join(f"{gate} {each['same']}" for gate, each in by_gate.items())
    notify(
        f"{totals['same']} messages were sent ({parts}); made again, each is the same to the byte"
    )


def _check_same(path: Path, by_gate: Mapping[str, Mapping[str, int]]) -> None:
    for gate, each in by_gate.items():
        if each["same"] < max(each["sent"], each["made_again"]):
            raise StageError(
                f"{path}: {each['sent']} messages of the gate `{gate}` were sent, "
                f"{each['made_again']} are made again; number {each['same'] + 1} is the first that "
                "differs"
            )


@dataclass
class Tracked:
    """Output of the stages, by the number of the frame; `places` and `verdicts` in their order."""

    odometry: dict[int, Odometry] = field(default_factory=dict)
    targets: dict[int, LandingTarget] = field(default_factory=dict)
    flows: dict[int, OpticalFlow] = field(default_factory=dict)
    places: list[Mapping[str, object]] = field(default_factory=list)
    """Of each update of the map its place, see `placed_values`."""
    verdicts: list[bool] = field(default_factory=list)
    """True where satellites begin to be doubted, False where that ends."""
    obstacles: ObstaclesAgain | None = None
    """None where they are not looked for again."""

    def take(self, message: Message) -> None:
        """Take an output of localisation."""
        if self.obstacles is not None:
            self.obstacles.take(message)
        if isinstance(message, Odometry):
            self.odometry[message.seq] = message
        elif isinstance(message, OpticalFlow):
            self.flows[message.seq] = message
        elif isinstance(message, MapUpdate):
            self.places.append(placed_values(message.georeference))
        elif isinstance(message, Warned):
            doubted = doubts(message)
            if doubted is not None:
                self.verdicts.append(doubted)


def _site_of(told: Decisions, config: Config, camera: Camera) -> SiteUse | None:
    """The site map that the flight used, None without one; FlightError where it is another."""
    used = told.site_map
    if used is None:
        return None
    path = map_path(config.map.use or used.path)
    if not path.exists():
        raise FlightError(
            f"{path}: the flight used this map of an earlier flight, revision {used.revision}, and "
            "it is not there; --map FILE names it where it is now"
        )
    read = read_site_map(path)
    if read.digest != used.digest:
        raise FlightError(
            f"{path}: the flight used another map of an earlier flight: this one has revision "
            f"{read.site.revision}, that had {used.revision} and the digest {used.digest}; "
            "--map FILE names it where it is now"
        )
    return SiteUse(read.site, camera, origin=None, is_live=True)


def _made_again(told: Decisions, tracked: Tracked) -> Payloads:
    """Messages by their gates, of what was tracked."""
    steps = told.gates
    if told.lossless:
        steps = list(steps_as_tracked(steps, tracked.places, tracked.verdicts))
    made = SentAgain(told, tracked.odometry, tracked.targets, tracked.flows).payloads(steps)
    if tracked.obstacles is not None:
        made[OBSTACLES] = tracked.obstacles.payloads
    return made


def _tracked_again(
    flight: RecordedFlight, told: Decisions, config: Config, progress: Progress
) -> Tracked:
    """All that the stages give, of the frames that they took in flight."""
    camera = flight.camera
    stage = LocalisationStage(
        told.config, camera, StageTimes(), background=True,
        order=[step.mapping_point for step in told.frames], site=_site_of(told, config, camera),
    )  # fmt: skip
    progress.start(flight.n_frames_between(flight.start_ns, flight.stop_ns))
    _take_up(stage, told, camera)
    found = Tracked(obstacles=ObstaclesAgain(told, camera))
    pictures = _looked_at(flight.frames(), camera, told, found)
    n_taken = 0
    try:
        for n_done, step in enumerate(told.frames):
            given: Frame | FrameOverdue | None = (
                next((f for f in pictures if f.seq >= step.seq), None)
                if step.has_picture
                else FrameOverdue(step.seq, step.t_ns)
            )
            if given is None or given.seq != step.seq:
                raise _not_recorded(step, "its image", flight.recording.health)
            if step.n_samples > len(told.samples):
                raise _not_recorded(step, "telemetry before it", flight.recording.health)
            for sample in told.samples[n_taken : step.n_samples]:
                stage.step(sample)
            n_taken = step.n_samples
            if step.origin is not None:
                stage.step(GeoOrigin(*step.origin))
            stage.set_effort(step.feature_ratio)
            for out in stage.step(given):
                found.take(out)
            progress.update(n_done + 1, stage.state.value, 0)
        for _ in pictures:
            pass
    finally:
        stage.finish(adjust=False)
    progress.finish()
    return found


def _not_recorded(step: FrameTracked, what: str, health: Mapping[str, Any]) -> FlightError:
    """Error for a frame that cannot be tracked again, and the reason where the flight knew it."""
    stages = health.get("health", {}).get("stages", ())
    n_dropped = sum(each["n_dropped"] for each in stages if each["name"] == "recorder")
    why = f": the recorder could not keep up, and dropped {n_dropped} messages" if n_dropped else ""
    return FlightError(f"frame {step.seq} was tracked, but {what} is missing in the recording{why}")


def _take_up(stage: LocalisationStage, told: Decisions, camera: Camera) -> None:
    """Begin with the map of a process before, where the flight did."""
    taken = told.map_taken_up
    if taken is None:
        if any(event.startswith((MAP_RESUMED, MAP_NOT_RECOGNISED)) for event in told.events):
            raise FlightError(
                "this flight began with the map of a process before it, which is not in the "
                "recording: it is of an older version"
            )
        return
    try:
        _, arrays = read_arrays(taken.data.tobytes())
        kept = decode(arrays, camera, told.config.features.scale_factor)
    except CheckpointError as error:
        raise FlightError(f"the map of the process before it, in the recording: {error}") from error
    stage.resume(kept, taken.t_ns, taken.absent_ns)


def _looked_at(
    frames: Iterator[object], camera: Camera, told: Decisions, found: Tracked
) -> Iterator[Frame]:
    """Frames one by one, each looked at for the landing marker where it was in flight."""
    detector = MarkerDetector(told.config.landing, camera) if told.targets else None
    for frame in frames:
        if isinstance(frame, Frame):
            if found.obstacles is not None:
                found.obstacles.frame(frame)
            if detector is not None and frame.seq in told.targets:
                found.targets[frame.seq] = detector.step(frame)
            yield frame


def _compared(made: list[tuple[int, bytes]], sent: list[tuple[int, bytes]]) -> dict[str, int]:
    """Numbers of messages, and of those at the beginning that are the same."""
    n_same = next(
        (n for n, (ours, theirs) in enumerate(zip(made, sent, strict=False)) if ours != theirs),
        min(len(made), len(sent)),
    )
    return {"sent": len(sent), "made_again": len(made), "same": n_same}


def _same(made: Odometry | None, recorded: Odometry) -> bool:
    if made is None:
        return False
    ours, theirs = made.world_from_body, recorded.world_from_body
    if ours is None or theirs is None:
        return ours is theirs
    return np.array_equal(ours.translation, theirs.translation) and np.array_equal(
        ours.rotation, theirs.rotation
    )


def _same_target(made: LandingTarget | None, recorded: LandingTarget) -> bool:
    if made is None or made.why_not != recorded.why_not:
        return False
    ours, theirs = made.position_body_m, recorded.position_body_m
    return ours is theirs if ours is None or theirs is None else np.array_equal(ours, theirs)
