"""Resumption of a map left by another process, where the camera relocalises in it.

The sample flight is flown for a while; then another localisation hangs over the same ground, whose
telemetry has no more than attitude: nothing that tells a scale.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config
from companion.estimation.gate.proof import MAP_RESUMED
from companion.estimation.localisation import LocalisationStage
from companion.estimation.resumption.checkpoint import (
    MAX_BYTES,
    Checkpoint,
    decode,
    encode,
    read_arrays,
)
from companion.estimation.resumption.map_resumption import MAP_NOT_RECOGNISED
from companion.estimation.resumption.map_verification import TIMEOUT_NS
from companion.geometry.camera import Camera
from companion.geometry.transforms import (
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)
from companion.messages import Frame, Message, Odometry, Warned
from companion.runtime.stage_protocol import Finish, KeepMap, Setup
from companion.stages.localisation_work import work
from companion.stages.map_keeper import MapKeeper
from companion.telemetry import AttitudeSample, Telemetry
from drivers.open_flight import open_flight
from tests.support.autopilot.received_poses import TrueFlight
from tests.support.flights.return_pass import back_and_forth, reordered

SAMPLE = Path("sample/survey")
CONFIG = Config()
FLOWN_S, ABSENT_S, AFTER_S = 14.0, 8.0, 8.0
OVER = 10
"""The vehicle sways over what the last so many frames showed,"""
ELSEWHERE = slice(300, 311)
"""or over another part of the field, 30 m away."""
Change = Callable[[Telemetry], Telemetry]


@dataclass
class Left:
    """What a process left behind, and what it had to fly with."""

    checkpoint: Checkpoint
    data: bytes
    camera: Camera
    frames: list[Frame]
    telemetry: list[Telemetry]
    last: int
    """Index of the last frame."""
    last_pose: Odometry


@pytest.fixture(scope="module")
def left() -> Left:
    flight = open_flight(SAMPLE, CONFIG.camera, CONFIG.telemetry)
    telemetry = list(flight.telemetry().samples)
    frames = [f for f in flight.frames(flight.start_ns, flight.stop_ns) if isinstance(f, Frame)]
    stage = LocalisationStage(CONFIG, flight.camera, lambda _: nullcontext())
    last = next(i for i, f in enumerate(frames) if f.t_ns > flight.start_ns + FLOWN_S * 1e9)
    poses: list[Odometry] = []
    for message in reordered(frames, telemetry, range(last + 1)):
        poses += [out for out in stage.step(message) if isinstance(out, Odometry)]
    checkpoint = stage.checkpoint()
    assert checkpoint is not None
    data = b"".join(encode(checkpoint, {}))
    _, arrays = read_arrays(data)
    read = decode(arrays, flight.camera, CONFIG.features.scale_factor)
    return Left(read, data, flight.camera, frames, telemetry, last, poses[-1])


def unchanged(sample: Telemetry) -> Telemetry:
    return sample


def turned(*degrees: float) -> Change:
    """An autopilot whose attitude is another: turned about north, east and down."""
    turn = rotation_from_vector(np.radians(degrees))

    def change(sample: Telemetry) -> Telemetry:
        assert isinstance(sample, AttitudeSample)
        rotation = turn @ rotation_from_quaternion(sample.ned_from_body)
        return replace(sample, ned_from_body=quaternion_from_rotation(rotation))

    return change


def hovering(left: Left, places: slice, change: Change) -> Iterator[Message]:
    """To and fro over some frames, attitude told and nothing else."""
    first, end = places.start, places.stop - 1
    n = round(AFTER_S / ((left.frames[1].t_ns - left.frames[0].t_ns) * 1e-9))
    attitudes = [s for s in left.telemetry if isinstance(s, AttitudeSample)]
    yield from (
        message if isinstance(message, Frame) else change(message)
        for message in reordered(left.frames, attitudes, back_and_forth(first, end, n))
    )


@dataclass
class Resumed:
    """What the next process gave; times are seconds after its first frame."""

    stage: LocalisationStage
    poses: list[tuple[float, Odometry, int]]
    """With the index of the frame that was shown."""
    said: list[Warned]
    first_ns: int


def resumed(left: Left, places: slice, change: Change = unchanged, kept: bool = True) -> Resumed:
    stage = LocalisationStage(CONFIG, left.camera, lambda _: nullcontext())
    out = Resumed(stage, [], [], 0)
    shown = list(back_and_forth(places.start, places.stop - 1, 1000))
    for message in hovering(left, places, change):
        if isinstance(message, Frame) and not out.first_ns:
            out.first_ns = message.t_ns
            if kept:
                stage.resume(left.checkpoint, message.t_ns, round(ABSENT_S * 1e9))
        for given in stage.step(message):
            if isinstance(given, Odometry):
                after_s = (given.t_ns - out.first_ns) * 1e-9
                out.poses.append((after_s, given, shown[given.seq]))
            elif isinstance(given, Warned):
                out.said.append(given)
    return out


def over(left: Left) -> slice:
    return slice(left.last - OVER, left.last + 1)


def test_hovering_where_it_was_it_has_a_metric_pose_again_within_a_second(left: Left) -> None:
    found = resumed(left, over(left))
    metric = [(s, o, i) for s, o, i in found.poses if o.world_from_body is not None]
    first_s = metric[0][0]
    truth = TrueFlight(SAMPLE)
    shown = np.array([left.frames[i].t_ns * 1e-9 for _, _, i in metric])
    place = np.array([o.world_from_body.translation for _, o, _ in metric if o.world_from_body])
    was_off = left.last_pose.world_from_body.translation - truth.place(  # type: ignore[union-attr]
        np.array([left.last_pose.t_ns * 1e-9])
    )
    error_m = np.linalg.norm(place - truth.place(shown), axis=1)
    print(f"first after {first_s:.2f} s; wrong by {error_m.max():.2f} m at most, before the"
          f" restart by {np.linalg.norm(was_off):.2f} m")  # fmt: skip
    assert first_s < 1.0
    assert len(metric) > 0.9 * len([s for s, _, _ in found.poses if s >= first_s])
    assert error_m.max() < np.linalg.norm(was_off) + 0.3
    assert all(o.sigma_position_m < 1.0 for _, o, _ in metric)
    assert [w.what for w in found.said if w.what in (MAP_RESUMED, MAP_NOT_RECOGNISED)] == [
        MAP_RESUMED
    ]


def test_without_what_was_kept_hovering_tells_no_scale(left: Left) -> None:
    found = resumed(left, over(left), kept=False)
    assert all(o.world_from_body is None for _, o, _ in found.poses)


@pytest.mark.parametrize(
    ("places", "change"),
    [("elsewhere", unchanged), ("here", turned(0.0, 0.0, 25.0)), ("here", turned(20.0, 0.0, 0.0))],
    ids=["over other ground", "under another heading", "under another vertical"],
)
def test_what_does_not_agree_is_never_taken_up(left: Left, places: str, change: Change) -> None:
    found = resumed(left, ELSEWHERE if places == "elsewhere" else over(left), change)
    assert all(o.world_from_body is None for _, o, _ in found.poses)
    (said,) = (w for w in found.said if w.what in (MAP_RESUMED, MAP_NOT_RECOGNISED))
    assert said.what == MAP_NOT_RECOGNISED
    assert said.t_ns - found.first_ns < TIMEOUT_NS + 2e9  # another map has begun by then
    print(said.detail)


def test_a_map_in_question_that_is_given_up_lends_the_next_no_scale(left: Left) -> None:
    """As where it is found to be tilted. No attitude is asked for, which could tell them apart."""
    kept = replace(left.checkpoint, ned_from_map=None)
    stage = LocalisationStage(CONFIG, left.camera, lambda _: nullcontext())
    said: list[str] = []
    n_frames = 0
    for message in hovering(left, over(left), unchanged):
        if isinstance(message, Frame):
            if not n_frames:
                stage.resume(kept, message.t_ns, round(ABSENT_S * 1e9))
            n_frames += 1
            if n_frames == 3:
                stage._tracker.reinitialise(0, keep=True)
        for out in stage.step(message):
            assert not (isinstance(out, Odometry) and out.world_from_body is not None)
            said += [out.what] if isinstance(out, Warned) else []
    assert MAP_NOT_RECOGNISED in said and MAP_RESUMED not in said
    assert stage.n_segments == 1


@pytest.mark.parametrize("take_up", [True, False], ids=["taken up", "not wanted"])
def test_the_process_takes_up_what_another_kept_and_keeps_its_own(
    left: Left, tmp_path: Path, take_up: bool
) -> None:
    path, setup = tmp_path / "map.checkpoint", Setup(CONFIG, left.camera)
    keeper = MapKeeper(path, setup)
    keeper.put(left.checkpoint)
    while keeper.busy:
        time.sleep(0.001)
    keeper.close(forget=False)
    process = work(setup)
    assert not list(process.step(KeepMap(path, take_up)))
    assert not path.exists()
    given = [out for m in hovering(left, over(left), unchanged) for out in process.step(m)]
    metric = [o for o in given if isinstance(o, Odometry) and o.world_from_body is not None]
    said = [w.what for w in given if isinstance(w, Warned)]
    assert (MAP_RESUMED in said, bool(metric)) == (take_up, take_up)
    list(process.finish(Finish(hurry=True, keep_map=take_up)))
    assert path.exists() == take_up


def test_what_is_kept_is_bounded(left: Left) -> None:
    assert len(left.data) < 1.05 * MAX_BYTES
    assert len(left.checkpoint.part.keyframes) >= 10
