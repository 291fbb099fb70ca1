"""Health of the daemon: what it costs to build."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.config import Config
from companion.daemon.health_watch import PATIENCE_NS, VIEWER_KEPT_NS, HealthWatch
from companion.health import SourceHealth
from companion.messages import Odometry, TrackState
from companion.meters import LatencyMeter
from companion.status_lines import line_of
from companion.timing.clock import FlightClock
from drivers.system.journal import Journal


def watch_of(flight: Any, folder: Path) -> HealthWatch:
    config, clock = Config(), FlightClock()
    config = replace(config, daemon=replace(config.daemon, flights=str(folder)))
    parts: tuple[Any, ...] = (
        config, clock, Journal({}), SimpleNamespace(health=SourceHealth("camera")), None, None,
        SimpleNamespace(current=flight), LatencyMeter(),
    )  # fmt: skip
    return HealthWatch(*parts)


def test_latencies_are_sorted_once_for_a_health(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stage = SimpleNamespace(
        progress=None, stalled_s=lambda now_s: 0.0, n_dropped=0, waiting_bytes=0, alive=True
    )
    flight = SimpleNamespace(
        stages={"localisation": stage, "depth": stage}, dense=True, viewing=None, n_restarted={},
        folder=None,
    )  # fmt: skip
    watch = watch_of(flight, tmp_path)
    pose: Any = SimpleNamespace(
        t_ns=watch._clock.now_ns() - 20_000_000,
        state=TrackState.TRACKING,
        quality=80,
        refused={},
    )
    odometry: Odometry = pose
    watch.take_odometry(odometry)
    asked: list[LatencyMeter] = []
    percentiles_ms = LatencyMeter.percentiles_ms

    def count(meter: LatencyMeter, percents: Sequence[float], now_ns: int) -> list[float | None]:
        asked.append(meter)
        return percentiles_ms(meter, percents, now_ns)

    monkeypatch.setattr(LatencyMeter, "percentiles_ms", count)
    health = watch.health()
    assert len(asked) == len(set(asked))
    (localisation, _) = health.stages
    assert health.pose_latency_p95_ms == localisation.latency_p95_ms
    assert localisation.latency_p95_ms is not None and localisation.latency_p95_ms >= 20.0
    asked.clear()
    assert watch.line_due(health) == line_of(health)
    assert not asked, "the health that there is will do"


@pytest.mark.parametrize("is_due", [True, False])
def test_no_pose_for_long_is_no_progress_where_a_flight_is_due(
    is_due: bool, tmp_path: Path
) -> None:
    """Also while another flight waits for its begin, after one that died."""
    watch, clock = watch_of(None, tmp_path), FlightClock()
    times_ns = [PATIENCE_NS // 40 * n for n in range(41)]
    watch._clock, watch._progress_ns, watch.flight_due = clock, 0, is_due
    seen = []
    for now_ns in times_ns:
        clock.now_ns = lambda now_ns=now_ns: now_ns  # type: ignore[method-assign,misc]
        watch.frame_came(now_ns)
        seen.append(watch.progress)
    assert all(seen[:-1])
    assert seen[-1] is not is_due


@pytest.mark.parametrize(("started_s", "seen"), [(60.0, True), (121.0, False)])
def test_a_first_start_that_compiles_is_no_lack_of_progress(
    started_s: float, seen: bool, tmp_path: Path
) -> None:
    flight = SimpleNamespace(ready=False, duration_s=started_s)
    watch, clock = watch_of(flight, tmp_path), FlightClock()
    watch._clock, watch._progress_ns = clock, 0
    clock.now_ns = lambda: 2 * PATIENCE_NS  # type: ignore[method-assign]
    watch.frame_came(2 * PATIENCE_NS)
    assert watch.progress is seen
    assert watch.pose_loop_alive is seen


def test_a_camera_that_is_late_by_itself_is_no_load(tmp_path: Path) -> None:
    """Of a network camera a picture may be 200 ms old when it comes."""
    stage = SimpleNamespace(n_dropped=0)
    levels: list[Any] = []
    flight = SimpleNamespace(
        ready=True,
        stages={"localisation": stage},
        set_load_levels=lambda *level: levels.append(level),
    )
    watch, clock = watch_of(flight, tmp_path), FlightClock()
    watch._clock = clock
    for work_ms, n_levels in ((20, 1), (80, 5)):
        for second in range(10):
            for frame in range(20):
                t_ns = 1_000_000_000 * (100 * work_ms + second) + 50_000_000 * frame
                clock.now_ns = lambda t_ns=t_ns: t_ns + 200_000_000  # type: ignore[method-assign,misc]
                watch.frame_came(t_ns)
                now_ns = t_ns + (200 + work_ms) * 1_000_000
                clock.now_ns = lambda now_ns=now_ns: now_ns  # type: ignore[method-assign,misc]
                pose: Any = SimpleNamespace(t_ns=t_ns, state=TrackState.TRACKING, quality=80)
                watch.take_odometry(pose)
            watch._step_governor()
        assert len(levels) == n_levels


@pytest.mark.parametrize("is_armed", [True, False])
def test_a_viewer_whose_pictures_are_needed_is_kept_under_load_until_the_motors_are_armed(
    is_armed: bool, tmp_path: Path
) -> None:
    viewer: list[bool] = []
    flight = SimpleNamespace(
        ready=True,
        stages={"localisation": SimpleNamespace(n_dropped=0)},
        set_load_levels=lambda features, dense, kept: viewer.append(kept),
    )
    watch, clock = watch_of(flight, tmp_path), FlightClock()
    watch._clock = clock
    second = itertools.count(1)

    def late(n: int) -> None:
        for _ in range(n):
            now_ns = next(second) * 1_000_000_000
            clock.now_ns = lambda now_ns=now_ns: now_ns  # type: ignore[method-assign,misc]
            watch._recent.add(now_ns, 80.0)
            watch._step_governor()

    watch.keep_viewer()
    late(1)
    watch.keep_viewer()
    late(4)
    assert len(viewer) > 2 and all(viewer)
    if is_armed:
        watch.armed()
    else:
        late(VIEWER_KEPT_NS // 1_000_000_000)
    late(1)
    assert viewer[-1] is False
