"""Verdict on measured depths: whether they give the map the scale that all else gives it.

A baseline or a focal length that is stated wrong stretches all depths alike, which neither camera
shows; positions, accelerometers and ranges do.
"""

from __future__ import annotations

from companion.estimation.georeference.trajectory_alignment import DISAGREE, Scale, apart
from companion.messages import Warned

N_AGREEING = 5
"""Comparisons in a row that have to say the same, one a keyframe while a map is young."""
CONTRADICTED = "measured depths contradict the other scales: check baseline and calibration"
AGREES_AGAIN = "measured depths agree with the other scales again"


class DepthVerdict:
    """Takes the scale by depths and that by all else; says where they begin to contradict."""

    def __init__(self) -> None:
        self._contradicted = False
        self._n_other = 0

    def compare(self, t_ns: int, depths: Scale, others: Scale | None) -> list[Warned]:
        """Compare two scales of a map; a change of the verdict."""
        if others is None:
            return []
        off = apart(depths, others)
        contradicts = abs(off) > DISAGREE * (depths.sigma**2 + others.sigma**2) ** 0.5
        self._n_other = 0 if contradicts == self._contradicted else self._n_other + 1
        if self._n_other < N_AGREEING:
            return []
        self._contradicted, self._n_other = contradicts, 0
        what = CONTRADICTED if contradicts else AGREES_AGAIN
        detail = f"they are {100 * off:+.1f} % longer than by {others.method}"
        return [Warned(t_ns, what, detail, good=not contradicts)]
