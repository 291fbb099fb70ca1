"""Judge of optical flow at a lift-off: the ground must sink away as accelerometers say.

A camera that sits otherwise than stated sees the climb as a motion elsewhere, and whatever is
reckoned by it takes the vehicle away. On the ground nothing shows that.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from companion.estimation.lift_off.optical_flow import GroundVelocity
from companion.geometry.transforms import Array

LEAST_SPEED_M_S, MAX_SIGMA_RATIO = 0.1, 0.35
"""Of the velocity by accelerometers, for a direction: 0.2 s after lift-off, some centimetres up."""
MIN_FLOW_SIGMAS = 4.0
N_FRAMES, SHARE = 8, 0.8
"""Frames that count, the latest, and how many of them must say the same."""
AGREES_RAD, CONTRADICTS_RAD = np.radians(35.0), np.radians(60.0)
"""Angle between both. In ArduCopter's simulator it is under 2 degrees with a right mount, and from
105 to 126 with a camera upside down; relief and tilt may turn flow by 15."""


class LiftOffFlow:
    """Takes flow frame by frame since the lift-off."""

    def __init__(self) -> None:
        self._angles_rad: deque[float] = deque(maxlen=N_FRAMES)
        self.agrees: bool | None = None
        """None until there is enough to tell; then it stays."""

    def take(self, velocity_m_s: Array, sigma_m_s: float, flow: GroundVelocity) -> bool:
        """Take flow, and the velocity (3,) by accelerometers at its time, NED by the attitude.

        True where it has just been found to contradict them.
        """
        speed, rate_hz = (float(np.linalg.norm(v)) for v in (velocity_m_s, flow.velocity_hz))
        sigma_hz = float(np.sqrt(np.diag(flow.covariance_hz2).max()))
        too_slow = speed < LEAST_SPEED_M_S or sigma_m_s > MAX_SIGMA_RATIO * speed
        if self.agrees is not None or too_slow or rate_hz < MIN_FLOW_SIGMAS * sigma_hz:
            return False
        cosine = float(velocity_m_s @ flow.velocity_hz) / (speed * rate_hz)
        self._angles_rad.append(float(np.arccos(np.clip(cosine, -1.0, 1.0))))
        angles = np.array(self._angles_rad)
        if len(angles) < N_FRAMES:
            return False
        if float((angles < AGREES_RAD).mean()) >= SHARE:
            self.agrees = True
        elif float((angles > CONTRADICTS_RAD).mean()) >= SHARE:
            self.agrees = False
        return self.agrees is False
