"""Correction of the body's state by one measurement, with its innovation gate."""

from __future__ import annotations

import numpy as np

from companion.estimation.body.aiding import Model
from companion.estimation.body.body_state import SCALE, BodyState

CHI_SQUARE_LIMIT = {1: 10.83, 2: 13.82, 3: 16.27}
"""Chi-square that is exceeded once in a thousand times, by degrees of freedom."""


def corrected_by(state: BodyState, model: Model) -> tuple[BodyState | None, float]:
    """The state corrected, None where the innovation gate refuses; the squared innovation."""
    seen, spread = model.seen, state.covariance
    innovation = model.measured - seen @ state.mean
    gained = seen @ spread
    expected = gained @ seen.T + model.covariance
    squared = float(innovation @ np.linalg.solve(expected, innovation))
    if squared > CHI_SQUARE_LIMIT[len(seen)]:
        return None, squared
    gain = np.linalg.solve(expected, gained).T
    gain[[*model.considered, SCALE]] = 0.0
    part = gain @ gained
    spread = spread - part - part.T + gain @ expected @ gain.T
    covariance = 0.5 * (spread + spread.T)
    return state._replace(mean=state.mean + gain @ innovation, covariance=covariance), squared
