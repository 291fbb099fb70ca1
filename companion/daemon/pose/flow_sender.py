"""Optical flow to the autopilot: one message for each frame, as it comes.

Runs in the event loop.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from companion.config import FeedbackConfig
from companion.estimation.lift_off.optical_flow import NO_ATTITUDE
from companion.geometry.transforms import Array
from companion.health import FlowHealth
from companion.messages import OpticalFlow
from companion.meters import LatencyMeter, RateMeter
from companion.telemetry import AttitudeSample
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.measurements.flow_messages import (
    optical_flow_message,
    optical_flow_rad_message,
)

MAX_AGE_NS = 300_000_000
"""Older flow is not sent."""
PAUSE_NS = 400_000_000
"""After a longer pause ArduPilot takes the first message for standing still, with the quality that
it tells (AP_OpticalFlow_MAV, 0.5 s): that message must have quality 0."""
RATES_KEPT_NS, RATES_AGE_NS = 500_000_000, 120_000_000
SILENT_NS = 1_000_000_000
UNHEARD, TOO_OLD, NO_FLOW, NO_RATES = (
    "the autopilot is silent", "too old", "no frame", "no turn rates from the autopilot",
)  # fmt: skip
AFTER_PAUSE = "after a pause"


class FlowSender:
    """Optical flow of the current flight in; OPTICAL_FLOW or OPTICAL_FLOW_RAD out, or nothing."""

    def __init__(self, config: FeedbackConfig, link: AutopilotLink, clock: FlightClock) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._rates: deque[AttitudeSample] = deque()
        self._rate, self._latency = RateMeter(), LatencyMeter()
        self._sent_ns = self._taken_ns = 0
        self._quality = 0
        self._why_not = ""
        self._n_sent = 0

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Send another message from the next frame on, or none."""
        self._config = config

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Take an attitude of the autopilot with its turn rates."""
        self._rates.append(sample)
        while sample.t_ns - self._rates[0].t_ns > RATES_KEPT_NS:
            self._rates.popleft()

    def take(self, flow: OpticalFlow) -> None:
        """Send the flow of a frame, or not."""
        now_ns = self._clock.now_ns()
        self._taken_ns = now_ns
        if self._config.flow == "off":
            return
        self._why_not = self._send(flow, now_ns) or flow.why_not
        self._quality = 0 if self._why_not else flow.quality

    def health(self) -> FlowHealth:
        """Health of the flow now."""
        if self._config.flow == "off":
            return FlowHealth()
        now_ns = self._clock.now_ns()
        gone = now_ns - self._taken_ns > SILENT_NS
        return FlowHealth(
            message=self._config.flow,
            sending=not gone and now_ns - self._sent_ns < SILENT_NS and self._link.alive,
            why_not=NO_FLOW if gone else self._why_not,
            rate_hz=self._rate.hz(now_ns),
            quality=0 if gone else self._quality,
            latency_p50_ms=self._latency.percentile_ms(50, now_ns),
            n_sent=self._n_sent,
        )

    def _send(self, flow: OpticalFlow, now_ns: int) -> str:
        """Send a flow; else why not."""
        if not self._link.alive:
            return UNHEARD
        if flow.why_not == NO_ATTITUDE:
            return NO_ATTITUDE
        if now_ns - flow.t_ns > MAX_AGE_NS:
            return TOO_OLD
        if self._config.flow == "optical_flow_rad":
            # on the ground PX4 believes one of quality 0, too (EKF2_OF_QMIN_GND)
            if flow.flow_rad_s is None or not flow.quality:
                return flow.why_not or "uncertain"
            message = optical_flow_rad_message(flow)
        else:
            rates = self._rates_since(max(self._sent_ns, now_ns - PAUSE_NS), now_ns)
            if rates is None:
                return NO_RATES
            if now_ns - self._sent_ns > PAUSE_NS:
                flow = replace(flow, flow_rad_s=None, why_not=AFTER_PAUSE)
            message = optical_flow_message(flow, rates)
        self._link.send(message)
        self._n_sent += 1
        self._sent_ns = now_ns
        self._rate.add(now_ns)
        self._latency.add(now_ns, (now_ns - flow.t_ns) * 1e-6)
        return ""

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
