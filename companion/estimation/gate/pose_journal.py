"""Journal of the pose gate: written in flight, and the gate that is asked again by it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from typing import Any

from companion.config import FeedbackConfig, Measurement
from companion.estimation.gate.gate_journal import POSE, GateJournal, Takes
from companion.estimation.gate.pose_gate import PoseGate
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.estimation.gate.reset_counter import ResetCounter
from companion.flight_notes import GateStep
from companion.messages import Odometry
from companion.telemetry import AttitudeSample

FRAME, DUE = "frame", "due"
BOOTED, RESTARTED, WITHHELD, LIMITS = "booted", "restarted", "withheld", "limits"
RESUMED = "resumed"


class JournaledPoseGate(PoseGate):
    """A pose gate that passes each step to `tell`; call `begin` with each flight.

    `heard` is True while the autopilot is, so that poses go out.
    """

    def __init__(
        self, config: FeedbackConfig, counter: ResetCounter,
        start_down_m: Callable[[int], float | None], may_start: Callable[[int], str],
        now_ns: Callable[[], int], heard: Callable[[], bool], tell: Callable[[GateStep], None],
    ) -> None:  # fmt: skip
        self._now_ns, self._heard = now_ns, heard
        self._journal = GateJournal(POSE, tell)
        self._down_m: float | None = None
        self._why_not_start: str | None = None

        def asked_down_m(t_ns: int) -> float | None:
            self._down_m = start_down_m(t_ns)
            return self._down_m

        def asked_may_start(t_ns: int) -> str:
            self._why_not_start = may_start(t_ns)
            return self._why_not_start

        super().__init__(config, counter, asked_down_m, asked_may_start)

    def begin(self, use: Collection[Measurement]) -> None:
        """Begin the journal of a flight, with its recording, and with what it believes."""
        self._use = use
        self._journal.begin(self._now_ns(), self._counted)

    def take_attitude(self, sample: AttitudeSample) -> None:
        """As `PoseGate.take_attitude`, journaled."""
        self._journal.sample()
        super().take_attitude(sample)

    def take(self, odometry: Odometry, now_ns: int) -> PoseToSend | None:
        """As `PoseGate.take`, journaled."""
        pose = super().take(odometry, now_ns)
        self._say(FRAME, now_ns, seq=odometry.seq)
        return pose

    def due(self, now_ns: int) -> PoseToSend | None:
        """As `PoseGate.due`, journaled."""
        before = self.sending, self._n_predicted
        pose = super().due(now_ns)
        if before != (self.sending, self._n_predicted):
            self._say(DUE, now_ns)
        return pose

    def autopilot_booted(self, last_sent: int | None) -> None:
        """As `PoseGate.autopilot_booted`, journaled."""
        super().autopilot_booted(last_sent)
        self._say(BOOTED, self._now_ns(), last_sent=last_sent)

    def restart(self) -> None:
        """As `PoseGate.restart`, journaled."""
        super().restart()
        self._say(RESTARTED, self._now_ns())

    def map_resumed(self) -> None:
        """As `PoseGate.map_resumed`, journaled."""
        super().map_resumed()
        self._say(RESUMED, self._now_ns())

    def withhold(self, why_not: str) -> None:
        """As `PoseGate.withhold`, journaled."""
        super().withhold(why_not)
        self._say(WITHHELD, self._now_ns(), why_not=why_not)

    def reconfigure(self, config: FeedbackConfig) -> None:
        """As `PoseGate.reconfigure`, journaled."""
        super().reconfigure(config)
        self._say(LIMITS, self._now_ns(), limits=asdict(config))

    @property
    def _counted(self) -> dict[str, object]:
        """The reset counter; `counter_sent` once this boot of the autopilot was sent a pose."""
        return {"counter": self._counter.value, "counter_sent": self._counter.sent}

    def _say(self, what: str, now_ns: int, **values: object) -> None:
        if self._why_not_start is not None:
            values |= {"down_m": self._down_m, "why_not_start": self._why_not_start}
        self._down_m = self._why_not_start = None
        self._journal.step(what, now_ns, values | self._counted, self._heard())


class PoseGateAgain:
    """The pose gate of a flight; `odometry_of` gives that of a frame, and raises without one."""

    def __init__(
        self, config: FeedbackConfig, use: Collection[Measurement],
        odometry_of: Callable[[int], Odometry],
    ) -> None:  # fmt: skip
        self.config = config
        self._odometry_of = odometry_of
        self._counter = ResetCounter()
        self._values: Mapping[str, Any] = {}
        """Inputs of the call that is repeated."""
        self._gate = PoseGate(config, self._counter, self._down_m, self._may_start, use)
        self.takes: Takes = {AttitudeSample: self._gate.take_attitude}

    def ask(self, step: GateStep) -> PoseToSend | None:
        """Repeat a call; the pose that it gives, if any."""
        self._values = step.values
        pose = self._done_again(step)
        self._count()
        return pose

    def _done_again(self, step: GateStep) -> PoseToSend | None:
        values = step.values
        if step.what == FRAME:
            return self._gate.take(self._odometry_of(values["seq"]), step.t_ns)
        if step.what == DUE:
            return self._gate.due(step.t_ns)
        if step.what == BOOTED:
            last = values.get("last_sent")
            self._gate.autopilot_booted(last if isinstance(last, int) else None)
        elif step.what == RESTARTED:
            self._gate.restart()
        elif step.what == RESUMED:
            self._gate.map_resumed()
        elif step.what == WITHHELD:
            self._gate.withhold(str(values["why_not"]))
        elif step.what == LIMITS:
            self.config = FeedbackConfig(**values["limits"])
            self._gate.reconfigure(self.config)
        return None

    def _count(self) -> None:
        self._counter.value = self._values["counter"]
        self._counter.sent = self._values["counter_sent"]

    def _down_m(self, _t_ns: int) -> float | None:
        given = self._values.get("down_m")
        return float(given) if isinstance(given, int | float) else None

    def _may_start(self, _now_ns: int) -> str:
        self._count()
        return str(self._values.get("why_not_start", ""))
