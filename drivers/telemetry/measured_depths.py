"""Depths by a second sensor of the same clock, put beside the telemetry of a recorded flight."""

from __future__ import annotations

import dataclasses
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from companion.messages import Warned
from companion.telemetry import DepthSample
from drivers.images.stereo_pair import Depths
from drivers.telemetry.telemetry_log import TelemetryLog, rates_hz

EVERY_NS = 240_000_000
"""Between two images that are measured: about as keyframes come."""
MAX_OFF_LINE_PX = 0.7
"""Median of matches from their epipolar lines; a good calibration has a tenth of a pixel."""
OFF_LINE = "the second camera's calibration does not fit its pictures"

Stamped = Sequence[tuple[int, Path]]


def with_depths(
    log: TelemetryLog, first: Stamped, second: Stamped, tolerance_ns: int, what: str,
    measure: Callable[[Path, Path], Depths | None],
) -> TelemetryLog:  # fmt: skip
    """A log with the depths that pairs of pictures show.

    `first` and `second` are times and files in order of time; a pair is no further apart than
    `tolerance_ns`. `what` is the second sensor in words; None of `measure` is a pair that cannot be
    read.
    """
    samples: list[DepthSample] = []
    off_line_px: list[float] = []
    n_pairs = n_unreadable = 0
    for t_ns, here, there in _pairs(first, second, tolerance_ns):
        n_pairs += 1
        found = measure(here, there)
        if found is None:
            n_unreadable += 1
            continue
        samples += [
            DepthSample(t_ns, float(u), float(v), float(depth), float(sigma))
            for (u, v), depth, sigma in zip(*found[:3], strict=True)
        ]
        if np.isfinite(found.off_line_px):
            off_line_px.append(found.off_line_px)
    warnings = [
        Warned(first[0][0], said, detail)
        for said, detail, is_so in (
            (f"no picture of {what} is of the time of one of the camera's", "", not n_pairs),
            (f"pictures of {what} could not be read", f"{n_unreadable} of {n_pairs}", n_unreadable),
            (f"{what} measures no depths", f"in {n_pairs} pictures", n_pairs and not samples),
        )
        if is_so
    ]
    off_px = float(np.median(off_line_px)) if off_line_px else 0.0
    if off_px > MAX_OFF_LINE_PX:
        detail = f"matches are {off_px:.1f} pixels off their epipolar lines"
        warnings.append(Warned(first[0][0], OFF_LINE, detail))
    every = sorted([*log.samples, *samples], key=lambda sample: sample.t_ns)
    return dataclasses.replace(
        log, samples=every, warnings=(*log.warnings, *warnings), rates_hz=rates_hz(every)
    )


def _pairs(first: Stamped, second: Stamped, tolerance_ns: int) -> Iterator[tuple[int, Path, Path]]:
    times_ns = [t_ns for t_ns, _ in second]
    next_ns = None
    for t_ns, here in first:
        if next_ns is not None and t_ns < next_ns:
            continue
        after = bisect_left(times_ns, t_ns)
        near = [k for k in (after - 1, after) if 0 <= k < len(second)]
        best = min(near, key=lambda k: abs(times_ns[k] - t_ns), default=None)
        if best is not None and abs(times_ns[best] - t_ns) <= tolerance_ns:
            yield t_ns, here, second[best][1]
            next_ns = t_ns + EVERY_NS
