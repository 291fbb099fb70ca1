"""Journal of the pose gate: its inputs, from which its poses can be computed again.

The gate decides by the time of each call, the autopilot's height at that time, and the boot of the
autopilot. The journal has these, in their order among attitudes and frames; polls without effect
are left out.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import asdict

from companion.config import FeedbackConfig, Measurement
from companion.estimation.gate.pose_gate import PoseGate, PoseToSend
from companion.estimation.gate.reset_counter import ResetCounter
from companion.flight_notes import GateStep
from companion.messages import Odometry
from companion.telemetry import AttitudeSample

BEGIN, FRAME, DUE = "begin", "frame", "due"
BOOTED, RESTARTED, WITHHELD, LIMITS = "booted", "restarted", "withheld", "limits"


class JournaledGate(PoseGate):
    """A pose gate that passes each step to `tell`; call `begin` with each flight."""

    def __init__(
        self, config: FeedbackConfig, counter: ResetCounter,
        start_down_m: Callable[[int], float | None], may_start: Callable[[int], str],
        now_ns: Callable[[], int], heard: Callable[[], bool], tell: Callable[[GateStep], None],
    ) -> None:  # fmt: skip
        self._now_ns, self._heard, self._tell = now_ns, heard, tell
        self._n_attitudes = 0
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
        self._n_attitudes = 0
        self._say(BEGIN, self._now_ns())

    def take_attitude(self, sample: AttitudeSample) -> None:
        """As `PoseGate.take_attitude`, journaled; one that is not believed counts, too."""
        self._n_attitudes += 1
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

    def withhold(self, why_not: str) -> None:
        """As `PoseGate.withhold`, journaled."""
        super().withhold(why_not)
        self._say(WITHHELD, self._now_ns(), why_not=why_not)

    def reconfigure(self, config: FeedbackConfig) -> None:
        """As `PoseGate.reconfigure`, journaled."""
        super().reconfigure(config)
        self._say(LIMITS, self._now_ns(), limits=asdict(config))

    def _say(self, what: str, now_ns: int, **values: object) -> None:
        if self._why_not_start is not None:
            values |= {"down_m": self._down_m, "why_not_start": self._why_not_start}
        self._down_m = self._why_not_start = None
        self._tell(
            GateStep(
                now_ns,
                what,
                self._n_attitudes,
                self._counter.value,
                self._counter.sent,
                self._heard(),
                values,
            )
        )


def poses_as_sent(
    config: FeedbackConfig, use: Collection[Measurement], steps: Iterable[GateStep],
    attitudes: Iterable[AttitudeSample], odometry_of: Callable[[int], Odometry],
) -> Iterator[tuple[GateStep, PoseToSend]]:  # fmt: skip
    """Poses of a gate by its journal, from the beginning of a flight.

    `odometry_of` gives that of a frame, and raises where there is none.
    """
    counter = ResetCounter()
    answers: dict[str, object] = {}

    def down_m(_t_ns: int) -> float | None:
        given = answers.get("down_m")
        return float(given) if isinstance(given, int | float) else None

    def may_start(_now_ns: int) -> str:
        counter.value, counter.sent = step.counter, step.counter_sent
        return str(answers.get("why_not_start", ""))

    gate = PoseGate(config, counter, down_m, may_start, use)
    waiting = deque(attitudes)
    n_taken = 0
    for step in steps:
        while n_taken < step.n_attitudes and waiting:
            gate.take_attitude(waiting.popleft())
            n_taken += 1
        answers = dict(step.values)
        pose = _done_again(gate, step, odometry_of)
        counter.value, counter.sent = step.counter, step.counter_sent
        if pose is not None:
            yield step, pose


def _done_again(
    gate: PoseGate, step: GateStep, odometry_of: Callable[[int], Odometry]
) -> PoseToSend | None:
    values: Mapping[str, object] = step.values
    if step.what == FRAME:
        seq = values["seq"]
        assert isinstance(seq, int)
        return gate.take(odometry_of(seq), step.t_ns)
    if step.what == DUE:
        return gate.due(step.t_ns)
    if step.what == BOOTED:
        last = values.get("last_sent")
        gate.autopilot_booted(last if isinstance(last, int) else None)
    elif step.what == RESTARTED:
        gate.restart()
    elif step.what == WITHHELD:
        gate.withhold(str(values["why_not"]))
    elif step.what == LIMITS:
        limits = values["limits"]
        assert isinstance(limits, Mapping)
        gate.reconfigure(FeedbackConfig(**limits))
    return None
