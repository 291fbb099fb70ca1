"""Gate of poses sent to the autopilot.

Each must keep the rules (`pose_rules`). They must be kept for a while before the first pose is
sent; gaps shorter than an autopilot's timeout are bridged by prediction, and longer ones by
inertial dead reckoning for as long as its standard deviation is within the limit. After others, and
after every discontinuity, the rules must be kept again, for a time that depends on why (`proof`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from enum import Enum
from statistics import median

import numpy as np

from companion.config import MEASUREMENTS, FeedbackConfig, Measurement
from companion.estimation.attitude.attitude_history import MAX_EXTRAPOLATION_NS, AttitudeHistory
from companion.estimation.gate.held_velocity import HeldVelocity
from companion.estimation.gate.pose_rules import (
    NO_ATTITUDE,
    UNCERTAIN,
    Before,
    rejection_reason,
    sigma_place_m,
)
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.gate.proof import SILENT, Proof, seen_as_reckoned
from companion.estimation.gate.reset_counter import ResetCounter
from companion.geometry.transforms import Pose, length
from companion.messages import Odometry
from companion.telemetry import AttitudeSample, is_believed

MIN_SPACING_NS = 4_000_000
UNAIDED_S = 0.4
"""Flow, where it aids, does so five times a second."""
N_PERIODS = 20
MAX_ATTITUDE_GAP_NS = 2 * MAX_EXTRAPOLATION_NS
"""Between two attitude samples: no time is further from one than extrapolation reaches."""

NOT_YET = "no pose yet"
NOT_BELIEVED = "attitude is not believed"
RESTARTED = "localisation begins anew"
RESET = "position reset"
REBOOTED = "autopilot rebooted"
NO_HEIGHT = "no autopilot height"
PROVING = "waiting for proof"


class Sending(Enum):
    """State of the pose output; docs/pose.md has its changes as a table."""

    OFF = "off"
    PROVING = "proving"
    SENDING = "sending"
    BRIDGING = "bridging"
    """Sent by inertial dead reckoning: nothing is tracked."""


class PoseGate:
    """Odometry and attitude in; poses to send out. `now_ns` is the time of the call.

    `start_down_m` gives the autopilot's own down coordinate at the time of a frame, None to
    withhold poses for want of it; without it poses stay in our world. That is where the receiver
    counts from, no measurement of ours: it is asked whatever of telemetry is in `use`. `may_start`
    gives other reasons not to start sending, "" if none.
    """

    def __init__(
        self,
        config: FeedbackConfig,
        counter: ResetCounter | None = None,
        start_down_m: Callable[[int], float | None] | None = None,
        may_start: Callable[[int], str] = lambda _now_ns: "",
        use: Collection[Measurement] = MEASUREMENTS,
    ) -> None:
        self._config = config
        self._use = use
        self._attitude = AttitudeHistory(400, MAX_ATTITUDE_GAP_NS)
        self._counter = counter or ResetCounter()
        self._start_down_m, self._may_start = start_down_m, may_start
        self._down_shift_m: float | None = None
        """Added to our down axis; fixed with the first pose, until a discontinuity."""
        self._newest: Odometry | None = None
        self._accepted: Odometry | None = None
        self._held = HeldVelocity()
        self._accepted_at_ns = 0
        self._proof = Proof()
        self._last_stamp_ns = 0
        self._n_predicted = 0
        self._n_unaided = 0
        """Poses of accelerometers alone since the last other one."""
        self._periods_ns: deque[int] = deque(maxlen=N_PERIODS)
        self._last_rejection = ""
        self.n_overtaken = 0
        """Measured poses that came when a predicted one with a later stamp, or hardly an earlier
        one, had been sent."""
        self.state = Sending.OFF
        self.why_not = NOT_YET

    @property
    def sending(self) -> bool:
        """True while poses are sent."""
        return self.state in (Sending.SENDING, Sending.BRIDGING)

    @property
    def n_resets(self) -> int:
        """Discontinuities reported to the autopilot, or to be with the next pose."""
        return self._counter.value

    def restart(self) -> None:
        """Restart after a restart of localisation, whose poses are unrelated to earlier ones."""
        self._stop(RESTARTED if self.sending else self.why_not)
        self._discontinuity()
        self._newest = self._accepted = None
        self._periods_ns.clear()

    def autopilot_booted(self, last_sent: int | None) -> None:
        """Handle a boot of the autopilot: the reset counter last sent to it, None if none."""
        self._counter.booted(last_sent)
        self._down_shift_m = None
        self._stop(REBOOTED if self.sending else self.why_not)

    def map_resumed(self) -> None:
        """Go on in the map of the process before, which localisation has verified."""
        self._stop(self.why_not)
        self._proof.foretell()

    def reconfigure(self, config: FeedbackConfig) -> None:
        """Change limits; the state is kept."""
        self._config = config

    def withhold(self, why_not: str) -> None:
        """Stop sending until the conditions have held anew."""
        self._stop(why_not)

    def take_attitude(self, sample: AttitudeSample) -> None:
        """Add an attitude of the autopilot, for checks and predictions, where it is believed."""
        if not is_believed(sample, self._use):
            return
        if not 0.5 < length(sample.ned_from_body) < 2.0:  # rejects nan too
            return
        rates = sample.rates_body_rad_s
        if rates is not None and not np.isfinite(rates).all():
            sample = replace(sample, rates_body_rad_s=None)
        self._attitude.add(sample)

    def take(self, odometry: Odometry, now_ns: int) -> PoseToSend | None:
        """Process the odometry of a frame; the pose to send at once, or None."""
        before = self._newest
        if before is not None and odometry.t_ns <= before.t_ns:
            return None
        self._newest = odometry
        as_reckoned = before is not None and seen_as_reckoned(before, odometry)
        if before is not None:
            self._periods_ns.append(odometry.t_ns - before.t_ns)
            if odometry.reset_counter != before.reset_counter:
                self._reset(as_reckoned)
                return None
        if now_ns - self._accepted_at_ns > self._max_gap_ns:
            self._time_out()
        why_not = self._rejection_reason(odometry, now_ns)
        if why_not:
            self._proof.refuse(why_not)
            if not self.sending:
                self.state, self.why_not = Sending.OFF, why_not
            self._last_rejection = why_not
            return None
        self._accepted, self._accepted_at_ns, self._n_predicted = odometry, now_ns, 0
        self._held.take(odometry)
        self._last_rejection = ""
        if not self.sending:
            whole_ns = int(self._config.resume_after_s * 1e9)
            proven = self._proof.keep(now_ns, whole_ns, as_reckoned)
            self.state = Sending.PROVING
            self.why_not = self._start_sending(odometry, now_ns) if proven else PROVING
            if self.why_not:
                return None
        self.state = Sending.BRIDGING if odometry.inertial else Sending.SENDING
        pose = self._stamped(self._pose_of(odometry))
        self.n_overtaken += pose is None
        return pose

    def due(self, now_ns: int) -> PoseToSend | None:
        """A predicted pose, where the camera is slower than the output rate, or a frame is late.

        To be polled, at `due_ns` at the latest; also detects timeouts.
        """
        accepted = self._accepted
        if not self.sending or accepted is None:
            return None
        since_ns = now_ns - self._accepted_at_ns
        if since_ns > self._max_gap_ns:
            self._time_out()
            return None
        step_ns, wait_ns = self._next_step()
        if since_ns < wait_ns:
            return None
        self._n_predicted += 1
        predicted = self._predicted(accepted, self._n_predicted * step_ns)
        return self._stamped(predicted) if predicted is not None else None

    @property
    def due_ns(self) -> int | None:
        """Time of the next predicted pose, if no frame comes before; None where none is sent."""
        if not self.sending or self._accepted is None:
            return None
        return self._accepted_at_ns + self._next_step()[1]

    def _next_step(self) -> tuple[int, int]:
        """Interval of poses, and time after a frame of the next that is to be predicted, ns."""
        period_ns = self._period_ns()
        n_steps = self._config.poses_per_frame(period_ns * 1e-9)
        step_ns = period_ns // n_steps
        number = self._n_predicted + 1
        # give a frame that is due itself some slack
        slack_ns = step_ns // 2 if number >= n_steps else 0
        return step_ns, number * step_ns + slack_ns

    @property
    def _max_gap_ns(self) -> int:
        return int(self._config.max_gap_ms * 1e6)

    def _period_ns(self) -> int:
        if not self._periods_ns:
            return int(1e9 / self._config.rate_hz)
        return int(median(self._periods_ns))

    def _rejection_reason(self, odometry: Odometry, now_ns: int) -> str:
        """Reason why a pose is rejected; "" if accepted."""
        if "attitude" not in self._use:
            return NOT_BELIEVED
        may_bridge = self.sending or self._proof.paused_lately(now_ns)
        before = Before(self.sending, may_bridge)
        attitude = self._attitude.at(odometry.t_ns)
        return rejection_reason(odometry, now_ns, attitude, before, self._config)

    def _start_sending(self, odometry: Odometry, now_ns: int) -> str:
        """Start sending with a proven pose; the reason where it may not."""
        assert odometry.world_from_body is not None
        shift_m = self._down_shift_m
        if shift_m is None and self._start_down_m is not None:
            start_m = self._start_down_m(odometry.t_ns)
            if start_m is None or not np.isfinite(start_m):
                return NO_HEIGHT
            shift_m = start_m - float(odometry.world_from_body.translation[2])
        why_not = self._may_start(now_ns)
        if not why_not:
            self._down_shift_m = shift_m or 0.0
            self._counter.sent = True
        return why_not

    def _discontinuity(self) -> None:
        self._counter.discontinuity()
        self._down_shift_m = None

    def _reset(self, as_reckoned: bool) -> None:
        """Stop at a reset; where that only ends dead reckoning, heights stay those of before.

        An autopilot's own height may have followed dead reckoning.
        """
        shift_m = self._down_shift_m
        self._discontinuity()
        self._down_shift_m = shift_m if as_reckoned else None
        self._stop(RESET)
        if as_reckoned:
            self._proof.foretell()

    def _time_out(self) -> None:
        """Stop sending: no pose was accepted for too long."""
        if not self.sending:
            self._proof.interrupt()
            return
        why_not = self._last_rejection or SILENT
        self._stop(why_not, why_not, self._accepted_at_ns if why_not == SILENT else None)

    def _stop(self, why_not: str, ceased: str = "", silent_since_ns: int | None = None) -> None:
        self.state, self.why_not = Sending.OFF, why_not
        self._proof.begin_anew(ceased, silent_since_ns)

    def _pose_of(self, odometry: Odometry) -> PoseToSend:
        assert odometry.world_from_body is not None and odometry.velocity_world_m_s is not None
        pose, down_m = odometry.world_from_body, self._down_shift_m or 0.0
        return PoseToSend(
            odometry.t_ns, Pose(pose.rotation, pose.translation + [0.0, 0.0, down_m]),
            odometry.velocity_world_m_s, odometry.sigma_position_m, odometry.sigma_velocity_m_s,
            odometry.sigma_attitude_rad, odometry.sigma_yaw_rad, odometry.quality,
            self._counter.value & 0xFF,
        )  # fmt: skip

    def _predicted(self, accepted: Odometry, ahead_ns: int) -> PoseToSend | None:
        """A pose extrapolated by velocity, and rotated by measured attitude.

        None where the attitude is unknown, or the pose too uncertain by then.
        """
        before, now = self._attitude.at(accepted.t_ns), self._attitude.at(accepted.t_ns + ahead_ns)
        if before is None or now is None:
            self._last_rejection = self._last_rejection or NO_ATTITUDE
            return None
        grown = self._held.after(ahead_ns * 1e-9)
        if not np.hypot(sigma_place_m(accepted), grown.place_m) <= self._config.max_sigma_m:
            self._last_rejection = self._last_rejection or UNCERTAIN
            return None
        return self._pose_of(accepted).ahead(ahead_ns, before, now, grown)

    def _stamped(self, pose: PoseToSend) -> PoseToSend | None:
        """The same, if its stamp is later than the last sent by `MIN_SPACING_NS`; else None."""
        if pose.t_ns < self._last_stamp_ns + MIN_SPACING_NS:
            return None
        self._last_stamp_ns = pose.t_ns
        accepted = self._accepted
        is_unaided = accepted is not None and accepted.unaided_s > UNAIDED_S
        self._n_unaided = self._n_unaided + 1 if is_unaided else 0
        return pose.repeated(self._n_unaided) if is_unaided else pose
