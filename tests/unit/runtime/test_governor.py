from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from companion.runtime.governor import LEVELS, Governor, LoadSample

S = 1_000_000_000
EASY = LoadSample(0.5, 0.4, 60.0, 30.0)
LATE = LoadSample(0.9, 0.4, 60.0, 80.0)


def run(
    governor: Governor, seconds: range, sample: Callable[[int, int], LoadSample] | LoadSample
) -> list[tuple[int, int]]:
    """Ask once a second: when the level changed and to what."""
    changes = []
    for t in seconds:
        now = sample if isinstance(sample, LoadSample) else sample(t, governor.level.number)
        if governor.step(t * S, now):
            changes.append((t, governor.level.number))
    return changes


def test_order_is_viewer_then_dense_then_features() -> None:
    assert [level.viewer for level in LEVELS] == [True, False, False, False, False]
    assert [level.dense_share for level in LEVELS] == [1.0, 1.0, 0.5, 0.0, 0.0]
    assert [level.feature_share for level in LEVELS] == [1.0, 1.0, 1.0, 1.0, 0.6]
    assert [level.number for level in LEVELS] == [0, 1, 2, 3, 4]


def test_nothing_is_left_out_while_it_goes_easily() -> None:
    governor = Governor(hot_c=85)
    assert run(governor, range(600), EASY) == []
    assert governor.degraded == ""


def test_late_poses_take_one_step_at_a_time_to_the_last() -> None:
    governor = Governor(hot_c=85)
    assert run(governor, range(60), LATE) == [(1, 1), (3, 2), (5, 3), (7, 4)]
    assert governor.degraded == ("viewer and dense map off, fewer features, since poses take 80 ms")


def test_without_a_dense_map_features_are_reduced_sooner_and_come_back() -> None:
    governor = Governor(hot_c=85)
    governor.makes_depth = False
    assert run(governor, range(60), LATE) == [(1, 1), (3, 4)]
    assert governor.degraded == "viewer off, fewer features, since poses take 80 ms"
    assert [number for _, number in run(governor, range(60, 200), EASY)] == [1, 0]
    assert governor.degraded == ""


def test_a_dense_map_that_begins_under_load_is_off() -> None:
    governor = Governor(hot_c=85)
    governor.makes_depth = False
    run(governor, range(60), LATE)
    governor.makes_depth = True
    assert governor.level is LEVELS[-1]
    assert [number for _, number in run(governor, range(60, 200), EASY)] == [3, 2, 1, 0]


def test_a_viewer_that_is_needed_is_kept_and_the_others_give_way() -> None:
    governor = Governor(hot_c=85)
    governor.keeps_viewer = True
    assert run(governor, range(2), LATE) == [(1, 1)]
    assert governor.level.viewer and governor.degraded == ""
    run(governor, range(2, 60), LATE)
    assert governor.level.viewer and governor.level.dense_share == 0.0
    assert governor.degraded == "dense map off, fewer features, since poses take 80 ms"
    governor.keeps_viewer = False
    assert governor.level is LEVELS[-1]
    assert governor.degraded == "viewer and dense map off, fewer features, since poses take 80 ms"


def test_one_late_second_is_no_reason() -> None:
    governor = Governor(hot_c=85)
    assert run(governor, range(60), lambda t, _: LATE if t % 2 else EASY) == []


def test_a_step_that_helps_is_the_last() -> None:
    governor = Governor(hot_c=85)

    def load(t: int, level: int) -> LoadSample:
        return LATE if level < 2 else LoadSample(0.9, 0.4, 60.0, 50.0)

    assert run(governor, range(120), load) == [(1, 1), (3, 2)]


def test_very_late_poses_are_helped_faster() -> None:
    governor = Governor(hot_c=85)
    assert run(governor, range(60), LoadSample(pose_latency_p95_ms=200.0))[-1] == (4, 4)


def test_heat_is_given_time_to_fall() -> None:
    governor = Governor(hot_c=85)
    warm = LoadSample(0.5, 0.4, 86.0, 30.0)
    assert run(governor, range(40), warm) == [(1, 1), (16, 2), (31, 3)]
    assert "86 C" in governor.degraded
    severe = Governor(hot_c=85)
    assert run(severe, range(40), LoadSample(0.5, 0.4, 93.0, 30.0))[-1] == (7, 4)


@pytest.mark.parametrize(
    ("sample", "word"),
    [
        (LoadSample(pose_dropped_hz=5.0), "5 frames/s go without a pose"),
        (LoadSample(memory_share=0.95), "memory is 95 % full"),
        (LoadSample(cpu_share=1.0, pose_latency_p95_ms=55.0), "processor is full"),
    ],
)
def test_each_reason_is_named(sample: LoadSample, word: str) -> None:
    governor = Governor(hot_c=85)
    assert not governor.step(0, sample) and governor.step(S, sample)
    assert governor.degraded.startswith("viewer off, since ")
    assert word in governor.degraded


def test_a_full_processor_alone_is_no_reason() -> None:
    assert run(Governor(hot_c=85), range(60), LoadSample(1.0, 0.4, 60.0, 30.0)) == []


def test_what_is_not_known_is_no_reason() -> None:
    governor = Governor(hot_c=85)
    run(governor, range(2), LATE)
    assert run(governor, range(2, 30), LoadSample()) == [(12, 0)]


def test_it_comes_back_step_by_step_after_a_while() -> None:
    governor = Governor(hot_c=85)
    run(governor, range(10), LATE)
    assert run(governor, range(10, 100), EASY) == [(20, 3), (30, 2), (40, 1), (50, 0)]
    assert governor.degraded == ""


def test_between_easy_and_too_much_it_stays() -> None:
    governor = Governor(hot_c=85)
    run(governor, range(2), LoadSample(temperature_c=86.0))
    assert run(governor, range(2, 300), LoadSample(temperature_c=82.0)) == []
    assert run(governor, range(300, 320), LoadSample(temperature_c=79.0)) == [(310, 0)]


def test_what_does_not_fit_is_tried_less_and_less_often() -> None:
    """The dense map overloads this computer whenever it runs."""
    governor = Governor(hot_c=85)
    changes = run(governor, range(600), lambda t, level: LATE if level < 3 else EASY)
    assert all(level in (2, 3) for _, level in changes[2:])
    tries = [t for t, level in changes[3:] if level == 2]
    waits = [b - a for a, b in itertools.pairwise(tries)]
    assert waits[:3] == [23, 43, 83]
    assert all(wait > 160 for wait in waits[3:])
    assert len(tries) <= 7


def test_steps_do_not_depend_on_how_often_it_is_asked() -> None:
    governor = Governor(hot_c=85)
    changes = [t for t in range(0, 20_000, 100) if governor.step(t * 1_000_000, LATE)]
    assert changes == [1000, 3000, 5000, 7000]
