"""Memory that must not grow over hours of flight: counted, not timed. See bench.one_process."""

from __future__ import annotations

import gc
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from companion.config import Config
from companion.estimation.localisation import LocalisationStage
from companion.estimation.sample_series import SampleSeries
from companion.geometry.transforms import Array, Pose
from companion.messages import Frame, Track, TrackState
from companion.products.flight_result import FlightResult
from companion.telemetry import (
    AttitudeSample,
    HeightSample,
    PositionSample,
    PositionSource,
    RangeSample,
    Telemetry,
)
from companion.timing.clock import StageTimes
from tests.support.flights.topic_flight import CAMERA

MINUTE_NS, SAMPLE_NS = 60_000_000_000, 50_000_000
FRAME_NS = 5_000_000_000
START_NS = 1_700_000_000_000_000_000


def held_bytes(of: object) -> int:
    """Reachable arrays and container entries, as bytes; none of modules."""
    seen: set[int] = set()
    waiting, total = [of], 0
    while waiting:
        each = waiting.pop()
        if id(each) in seen or isinstance(each, type):
            continue
        seen.add(id(each))
        if isinstance(each, np.ndarray):
            total += each.nbytes
        elif isinstance(each, (list, tuple, dict, set)) or type(each).__name__ == "deque":
            total += 8 * len(each)  # type: ignore[arg-type]
        if type(each).__name__ not in ("module", "function", "builtin_function_or_method"):
            waiting += gc.get_referents(each)
    return total


def messages(minutes: range) -> Iterator[Telemetry | Frame]:
    """Telemetry at 20 Hz, and occasional blank frames."""
    start_ns = START_NS + minutes.start * MINUTE_NS
    for t_ns in range(start_ns, START_NS + minutes.stop * MINUTE_NS, SAMPLE_NS):
        t_s = (t_ns - START_NS) * 1e-9
        place = np.array([np.sin(t_s / 9), np.cos(t_s / 9), -10.0])
        yield AttitudeSample(t_ns, np.array([1.0, 0, 0, 0]), np.zeros(3))
        for source in PositionSource:
            yield PositionSample(t_ns, source, place, np.zeros(3))
        yield HeightSample(t_ns, 10.0)
        yield RangeSample(t_ns, 10.0)
        if (t_ns - START_NS) % FRAME_NS == 0:
            shape = CAMERA.height, CAMERA.width
            grey = np.zeros(shape, np.uint8)
            yield Frame(round(t_s * 20), t_ns, grey, np.zeros((*shape, 3), np.uint8))


def test_memory_of_localisation_is_bounded() -> None:
    camera = replace(CAMERA, body_from_camera=Pose.identity())
    stage = LocalisationStage(Config(), camera, StageTimes())

    def fly(minutes: range) -> int:
        for message in messages(minutes):
            list(stage.step(message))
        return held_bytes(stage)

    after_twelve = fly(range(12))
    assert after_twelve > 1_000_000, "telemetry of ten minutes"
    assert fly(range(12, 36)) < 1.1 * after_twelve


def test_tracks_and_positions_of_an_hour_take_megabytes() -> None:
    result = FlightResult()
    relative = Pose(np.eye(3), np.array([1.0, 2, 3]))
    tracemalloc.start()
    try:
        for seq in range(3600 * 10):
            t_ns = START_NS + seq * 100_000_000
            own = Pose(np.eye(3), np.full(3, float(seq)))
            result.take(Track(seq, t_ns, TrackState.TRACKING, own, 7, own, 90, 99))
            result.take(PositionSample(t_ns, PositionSource.GPS, np.full(3, float(seq))))
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 36_000 * (150 + 50)
    result.take(Track(3, START_NS, TrackState.TRACKING, relative, 8, relative, 50, 60, None, True))
    assert [track.seq for track in result.tracks] == list(range(36_000))
    third = result.tracks[3]
    assert (third.keyframe_id, third.n_inliers, third.backfilled) == (8, 50, True)
    path = result.autopilot_path()
    assert path is not None
    np.testing.assert_array_equal(path[2][-1], np.full(3, 35_999.0))


def test_tracked_frame_stays_tracked() -> None:
    """Of the tracks of a frame the last tracking one counts, else the last."""
    result = FlightResult()
    pose = Pose.identity()
    tracking = Track(1, 1, TrackState.TRACKING, pose, 4, pose, 10, 20)
    for track in (Track(2, 2, TrackState.INITIALISING), tracking, Track(1, 1, TrackState.LOST)):
        result.take(track)
    result.take(Track(2, 2, TrackState.LOST))
    assert [t.state for t in result.tracks] == [TrackState.TRACKING, TrackState.LOST]
    assert result.tracks[1].keyframe_from_camera is None


@pytest.mark.parametrize("before", [0, 37, 500, 999, 5000])
def test_interpolation_at_keyframes_is_unchanged_by_pruning(before: int) -> None:
    rng = np.random.default_rng(before)
    times = START_NS + np.cumsum(rng.integers(50, 120, 1000)) * 1_000_000
    keyframes: Array = np.sort(rng.integers(times[0] - 10**9, times[-1] + 10**9, 40))
    recent: Array = np.linspace(times[min(before, 999)], times[-1], 60).astype(np.int64)

    def read(series: SampleSeries) -> list[Any]:
        return [series.at(keyframes), series.at(recent)]

    series = SampleSeries()
    for t_ns in times.tolist():
        series.add(t_ns, rng.normal(size=3))
    first = read(series)
    series.prune(int(times[min(before, 999)]) + (before > 999) * 10**12, keyframes)
    assert len(series) <= 1000 - min(before, 999) + 2 * len(keyframes) + 2
    wanted = 1 if before > 999 else 2
    for then, now in list(zip(first, read(series), strict=True))[:wanted]:
        np.testing.assert_array_equal(then[1], now[1])
        np.testing.assert_array_equal(then[0][then[1]], now[0][now[1]])
