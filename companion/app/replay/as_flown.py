"""Replay of a recording as flown: the poses sent to the autopilot are computed again and compared.

Of images recorded without loss all stages up to the pose gate are replayed: telemetry, frames and
mapping in their recorded order, at the recorded load levels. Else other pixels would give other
poses: then only the pose gate is replayed, on the recorded odometry.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from companion.app.progress import Progress
from companion.config import Config
from companion.errors import FlightError, StageError
from companion.estimation.gate.gate_journal import poses_as_sent
from companion.estimation.localisation import LocalisationStage
from companion.estimation.map_resumption import MAP_NOT_RECOGNISED, MAP_RESUMED
from companion.geometry.camera import Camera
from companion.messages import Frame, FrameOverdue, Odometry
from companion.products.atomic_file import write_atomically
from companion.telemetry import AttitudeSample
from companion.timing.clock import StageTimes
from drivers.recording.decisions import Decisions, decisions_of, payloads_of
from drivers.recording.flights_folder import RECORDING
from drivers.recording.recorded_flight import open_recording

AS_FLOWN = "as_flown.json"


def replay_as_flown(
    path: Path, out: Path, config: Config, progress: Progress, notify: Callable[[str], None]
) -> None:
    """Compare the poses with those sent; the result goes to `out`/as_flown.json.

    The settings are those of the flight. FlightError where its decisions are not recorded,
    StageError where a pose differs.
    """
    path = path / RECORDING if path.is_dir() else path
    flight = open_recording(path, config.camera, config.telemetry)
    try:
        told = decisions_of(flight.recording)
        of_frame = told.odometry
        if any(event.startswith((MAP_RESUMED, MAP_NOT_RECOGNISED)) for event in told.events):
            raise FlightError(
                f"{path}: this flight began with the map of a process before it, which is not in "
                "the recording"
            )
        if told.lossless:
            n = flight.n_frames_between(flight.start_ns, flight.stop_ns)
            progress.start(n)
            of_frame = _tracked_again(flight.camera, told, flight.frames(), progress)
            progress.finish()
        else:
            notify(
                "images were compressed with losses: the recorded odometry goes to the pose gate"
            )
        made = [
            payload
            for step, pose in poses_as_sent(
                told.config.feedback,
                told.config.telemetry.use,
                told.gate,
                _attitudes(told),
                lambda seq: _known(of_frame, seq),
            )
            if step.sent
            for payload in payloads_of(pose, told.config.feedback.mode, told.firmware)
        ]
    finally:
        flight.recording.close()
    n_same = next(
        (n for n, (ours, sent) in enumerate(zip(made, told.sent, strict=False)) if ours != sent),
        min(len(made), len(told.sent)),
    )
    n_tracked = sum(_same(of_frame.get(seq), odometry) for seq, odometry in told.odometry.items())
    out.mkdir(parents=True, exist_ok=True)
    found = {
        "sent": len(told.sent), "made_again": len(made), "same": n_same,
        "frames": len(told.odometry), "frames_same": n_tracked, "tracked_again": told.lossless,
    }  # fmt: skip
    write_atomically(out / AS_FLOWN, json.dumps(found, indent=1).encode())
    if told.lossless:
        notify(f"{n_tracked} of {len(told.odometry)} frames have the same odometry")
    if n_same < max(len(made), len(told.sent)):
        raise StageError(
            f"{path}: {len(told.sent)} messages with poses were sent, {len(made)} are made again; "
            f"number {n_same + 1} is the first that differs"
        )
    notify(f"{n_same} messages with poses were sent; made again, each is the same to the byte")


def _tracked_again(
    camera: Camera, told: Decisions, frames: Iterator[object], progress: Progress
) -> dict[int, Odometry]:
    """Odometry by the number of the frame."""
    stage = LocalisationStage(
        told.config, camera, StageTimes(), background=True,
        order=[step.mapping_point for step in told.frames],
    )  # fmt: skip
    pictures = (frame for frame in frames if isinstance(frame, Frame))
    found: dict[int, Odometry] = {}
    n_taken = 0
    try:
        for n_done, step in enumerate(told.frames):
            given: Frame | FrameOverdue | None = (
                next((f for f in pictures if f.seq >= step.seq), None)
                if step.has_picture
                else FrameOverdue(step.seq, step.t_ns)
            )
            if given is None or given.seq != step.seq or step.n_samples > len(told.samples):
                raise FlightError(
                    f"frame {step.seq} was tracked, but its image or telemetry before it is "
                    "missing in the recording"
                )
            for sample in told.samples[n_taken : step.n_samples]:
                stage.step(sample)
            n_taken = step.n_samples
            stage.set_effort(step.feature_ratio)
            for out in stage.step(given):
                if isinstance(out, Odometry):
                    found[out.seq] = out
            progress.update(n_done + 1, stage.state.value, 0)
    finally:
        stage.finish(adjust=False)
    return found


def _attitudes(told: Decisions) -> list[AttitudeSample]:
    return [sample for sample in told.samples if isinstance(sample, AttitudeSample)]


def _known(odometry: dict[int, Odometry], seq: int) -> Odometry:
    if seq not in odometry:
        raise FlightError(f"frame {seq} went to the pose gate, and its odometry is not recorded")
    return odometry[seq]


def _same(made: Odometry | None, recorded: Odometry) -> bool:
    if made is None:
        return False
    if made.world_from_body is None or recorded.world_from_body is None:
        return made.world_from_body is recorded.world_from_body
    return bool(
        (made.world_from_body.translation == recorded.world_from_body.translation).all()
        and (made.world_from_body.rotation == recorded.world_from_body.rotation).all()
    )
