"""A long flight made of a short one: forward and return passes in turn."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from companion.messages import Frame
from companion.telemetry import AttitudeSample, HeightSample, PositionSample, RangeSample, Telemetry

KINDS = (AttitudeSample, PositionSample, RangeSample, HeightSample)


def back_and_forth(first: int, last: int, n: int) -> Iterator[int]:
    """`n` indices that go from `first` to `last` and back, again and again."""
    at, step = first, 1
    for _ in range(n):
        yield at
        if not first <= at + step <= last:
            step = -step
        at += step


def reordered(
    frames: list[Frame], telemetry: Iterable[Telemetry], order: Iterable[int]
) -> Iterator[Frame | Telemetry]:
    """Frames in this order, and the telemetry between them, as one flight with rising times."""
    samples = [s for s in telemetry if isinstance(s, KINDS)]
    times = np.array([s.t_ns for s in samples])
    now_ns, before = frames[0].t_ns, None
    for seq, index in enumerate(order):
        here_ns = frames[index].t_ns
        if before is not None:
            there_ns = frames[before].t_ns
            low, high = np.searchsorted(times, sorted((there_ns, here_ns)), "right")
            between = samples[low:high]
            back = here_ns < there_ns
            for sample in reversed(between) if back else between:
                yield _moved(sample, now_ns + abs(sample.t_ns - there_ns), back)
            now_ns += abs(here_ns - there_ns)
        yield replace(frames[index], seq=seq, t_ns=now_ns)
        before = index


def _moved(sample: Telemetry, t_ns: int, back: bool) -> Telemetry:
    sign = -1.0 if back else 1.0
    if isinstance(sample, AttitudeSample) and sample.rates_body_rad_s is not None:
        return replace(sample, t_ns=t_ns, rates_body_rad_s=sign * sample.rates_body_rad_s)
    if isinstance(sample, PositionSample) and sample.velocity_ned_m_s is not None:
        return replace(sample, t_ns=t_ns, velocity_ned_m_s=sign * sample.velocity_ned_m_s)
    return replace(sample, t_ns=t_ns)
