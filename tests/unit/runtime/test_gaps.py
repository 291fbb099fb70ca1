from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from companion.messages import Frame, Message, Warned
from companion.runtime.gaps import with_gap_warnings
from companion.telemetry import AttitudeSample, PositionSample, PositionSource

S = 1_000_000_000


def frame(t_s: float, image: np.random.Generator | int) -> Frame:
    grey = (
        np.full((48, 64), image, np.uint8)
        if isinstance(image, int)
        else image.integers(0, 255, (48, 64), np.uint8)
    )
    return Frame(0, round(t_s * S), grey, np.repeat(grey[..., None], 3, 2))


def attitude(t_s: float) -> AttitudeSample:
    return AttitudeSample(round(t_s * S), np.array([1.0, 0, 0, 0]))


def position(t_s: float) -> PositionSample:
    return PositionSample(round(t_s * S), PositionSource.GPS, np.zeros(3))


def warnings(messages: Iterable[Message]) -> list[tuple[str, float]]:
    ordered = sorted(messages, key=lambda message: (message.t_ns, isinstance(message, Frame)))
    return [(w.what, w.t_ns / S) for w in with_gap_warnings(ordered) if isinstance(w, Warned)]


def times(start_s: float, stop_s: float, hz: float) -> list[float]:
    return [float(t) for t in np.arange(start_s, stop_s, 1 / hz)]


@pytest.mark.parametrize("hz", [2, 10, 30])
def test_steady_flight_gives_no_warning(rng: np.random.Generator, hz: float) -> None:
    frames = [frame(t, rng) for t in times(0, 20, hz)]
    attitudes, positions = map(attitude, times(0, 20, 4)), map(position, times(0, 20, 1))
    assert warnings([*frames, *attitudes, *positions]) == []


def test_messages_pass_unchanged_and_in_order(rng: np.random.Generator) -> None:
    messages: list[Message] = [frame(t, rng) for t in (0, 0.1, 0.2, 0.3)]
    messages += [attitude(0.35), frame(5, rng)]
    passed = list(with_gap_warnings(messages))
    assert [m for m in passed if not isinstance(m, Warned)] == messages
    assert isinstance(passed[-2], Warned)


def test_each_gap_of_frames_is_named_at_its_end(rng: np.random.Generator) -> None:
    frames = [frame(t, rng) for t in [*times(0, 4, 10), *times(6, 8, 10), *times(8.5, 9, 10)]]
    assert warnings(frames) == [("frames are missing", 6.0), ("frames are missing", 8.5)]


def test_slow_camera_is_not_a_gap(rng: np.random.Generator) -> None:
    assert warnings([frame(t, rng) for t in times(0, 60, 0.5)]) == []


def test_telemetry_that_stops_is_named_once_each_time(rng: np.random.Generator) -> None:
    frames = [frame(t, rng) for t in times(0, 30, 10)]
    heard = [attitude(t) for t in [*times(0, 5, 20), *times(12, 20, 20)]]
    found = warnings([*frames, *heard, *map(position, times(0, 30, 5))])
    assert [what for what, _ in found] == ["attitude telemetry stops"] * 2
    assert [t for _, t in found] == pytest.approx([7.0, 22.0], abs=0.2)


def test_slow_positions_have_longer_to_come(rng: np.random.Generator) -> None:
    """Every second: five seconds without one are a gap, four are not."""
    frames = [frame(t, rng) for t in times(0, 30, 10)]
    assert warnings([*frames, *map(position, [*times(0, 10, 1), *times(13.5, 30, 1)])]) == []
    late = warnings([*frames, *map(position, [*times(0, 10, 1), *times(16, 30, 1)])])
    assert [what for what, _ in late] == ["position telemetry stops"]


def test_image_that_stands_still_is_named_once(rng: np.random.Generator) -> None:
    moving = [frame(t, rng) for t in times(0, 2, 10)]
    frozen = [frame(t, 90) for t in times(2, 5, 10)]
    again = [frame(t, rng) for t in times(5, 7, 10)]
    found = warnings([*moving, *frozen, *again])
    assert [what for what, _ in found] == ["the image stands still"]
    assert found[0][1] == pytest.approx(2.5, abs=0.2)
