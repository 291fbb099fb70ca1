"""Lens and readout of a rolling shutter, in turn: each is needed to measure the other well."""

from __future__ import annotations

from collections.abc import Sequence

from companion.calibration.board_readout import BoardReadout, TimedView, measured_readout
from companion.calibration.board_views import Mask, View
from companion.calibration.lens_calibration import Calibration, calibrate_lens

MAX_ROUNDS = 4
"""Two or three suffice: after one, a lens that is two hundredths off as of a global shutter is not
off any more."""


def calibrate_rolling(
    views: Sequence[View], timed: Sequence[TimedView], lit: Mask, wanted: str, start: Calibration
) -> tuple[Calibration, BoardReadout | None]:
    """Calibration by `views` with the readout undone in them, as far as it can be measured.

    `start` is the calibration as if all rows were exposed at once. `timed` are views in order of
    time, with the views and those just before and after them among them; `wanted` is as for
    `calibrate_lens`.
    """
    calibration = start
    readout: BoardReadout | None = None
    for _ in range(MAX_ROUNDS):
        measured = measured_readout(calibration.lens, timed)
        if measured is None:
            break
        before, (readout, undone) = readout, measured
        if not readout.is_significant or (before is not None and readout.is_as(before)):
            break
        again = calibrate_lens([undone.get(each.number, each) for each in views], lit, wanted)
        if again is None:
            break
        calibration = again
    return calibration, readout
