"""Gate of optical flow: of which frames it is sent, and with which turn rates.

Flow without an attitude is none, and old flow is of no use. ArduPilot takes the body's rotation off
by its gyroscopes' mean from the arrival of one message to that of the next: the turn rates of that
interval go with it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from companion.config import FeedbackConfig
from companion.estimation.lift_off.optical_flow import NO_ATTITUDE
from companion.geometry.transforms import Array
from companion.messages import OpticalFlow
from companion.telemetry import AttitudeSample

MAX_AGE_NS = 300_000_000
"""Older flow is not sent."""
PAUSE_NS = 400_000_000
"""After a longer pause ArduPilot takes the first message for standing still, with the quality that
it tells (AP_OpticalFlow_MAV, 0.5 s): that message must have quality 0."""
RATES_KEPT_NS, RATES_AGE_NS = 500_000_000, 120_000_000
TOO_OLD, NO_RATES, UNCERTAIN = "too old", "no turn rates from the autopilot", "uncertain"
AFTER_PAUSE = "after a pause"


@dataclass(frozen=True, slots=True, eq=False)
class FlowToSend:
    """A flow for the autopilot; for OPTICAL_FLOW with the body's mean turn rates (3,), rad/s."""

    flow: OpticalFlow
    rates_body_rad_s: Array | None = None


class FlowGate:
    """Flow of each frame and attitudes in; what is to be sent out."""

    def __init__(self, config: FeedbackConfig) -> None:
        self._config = config
        self._rates: deque[AttitudeSample] = deque()
        self._sent_ns = 0
        self.why_not = ""
        """Reason why the last flow is not sent; "" if it is."""

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Send another message from the next frame on."""
        self._config = config

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot with its turn rates."""
        self._rates.append(sample)
        while sample.t_ns - self._rates[0].t_ns > RATES_KEPT_NS:
            self._rates.popleft()

    def take(self, flow: OpticalFlow, now_ns: int) -> FlowToSend | None:
        """Decide on the flow of a frame: what to send of it, or None."""
        self.why_not = ""
        if flow.why_not == NO_ATTITUDE:
            self.why_not = NO_ATTITUDE
        elif now_ns - flow.t_ns > MAX_AGE_NS:
            self.why_not = TOO_OLD
        elif self._config.flow == "optical_flow_rad":
            # on the ground PX4 believes one of quality 0, too (EKF2_OF_QMIN_GND)
            if flow.flow_rad_s is not None and flow.quality:
                return FlowToSend(flow)
            self.why_not = flow.why_not or UNCERTAIN
        else:
            rates = self._rates_since(max(self._sent_ns, now_ns - PAUSE_NS), now_ns)
            if rates is not None:
                if now_ns - self._sent_ns > PAUSE_NS:
                    flow = replace(flow, flow_rad_s=None, why_not=AFTER_PAUSE)
                return FlowToSend(flow, rates)
            self.why_not = NO_RATES
        return None

    def sent(self, now_ns: int) -> None:
        """Take note that what was given last goes out, at this time."""
        self._sent_ns = now_ns

    def _rates_since(self, since_ns: int, now_ns: int) -> Array | None:
        """Mean turn rates (3,) of the body, the last ones held; None where there are none."""
        known = [
            (sample.t_ns, sample.rates_body_rad_s)
            for sample in self._rates
            if sample.rates_body_rad_s is not None
        ]
        if not known or now_ns - known[-1][0] > RATES_AGE_NS:
            return None
        times = np.array([t_ns for t_ns, _ in known], np.float64)
        at = np.linspace(since_ns, now_ns, 9)
        rates = np.stack([rates for _, rates in known])
        return np.array([np.interp(at, times, each).mean() for each in rates.T])
