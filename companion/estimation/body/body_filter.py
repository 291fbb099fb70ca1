"""The filter of the body's motion: one state with its covariance, and all that corrects it.

Rotations are given: their heading is the autopilot's, their level that of `SteadyLevel`. So place,
velocity, the accelerometers' bias, the tilt and its drift are linear, and a Kalman filter of these
has no point of linearisation to be wrong about (the same model finds the scale, see
`inertial_scale`).
Where no accelerations are to be had, or to be believed, the velocity is held.

| state (`body_state`) | size, unit, axes | goes on by |
|---|---|---|
| `PLACE`, `VELOCITY` | 3, m; 3, m/s; of the map | accelerations; white noise of these |
| `BIAS` of the accelerometers | 3, m/s2; body | a random walk |
| `TILT` of the given level | 2, m/s2; horizontal, as gravity's part | `DRIFT`; it decays |
| `DRIFT` of the tilt | 2, m/s3; horizontal | it decays |
| `GROUND`, `BAROMETER` | down, m: ground below, barometer's zero | relief, weather |
| `SCALE` of the map | logarithm, its mean 0 | constant |
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

import numpy as np

from companion.estimation.body.aiding import (
    LEAST_SIGMA_PLACE_M,
    SIGMA_BAROMETER_M,
    Aid,
    AidedHeight,
    AidedPlace,
    AidedRest,
    Aiding,
    model_of,
)
from companion.estimation.body.body_state import (
    BAROMETER,
    DOWN,
    DRIFT,
    GROUND,
    N_STATE,
    SIGMA_DRIFT_M_S3,
    BodyState,
    Reckoned,
    carried_on,
    held,
    propagated,
)
from companion.estimation.body.gated_correction import CHI_SQUARE_LIMIT, corrected_by
from companion.estimation.body.refused_run import RefusedRun
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.inertial_motion import (
    BIAS,
    PLACE,
    SIGMA_BIAS_M_S2,
    SIGMA_SPEED_M_S,
    SIGMA_TILT_M_S2,
    TILT,
    VELOCITY,
    InertialStart,
)
from companion.geometry.transforms import Array

START = slice(VELOCITY.start, BIAS.stop)
MAX_HELD_NS = 400_000_000
"""The newest acceleration is taken to stay for at most so long, and a velocity where there is none;
and so late a measurement may come."""
LEAST_MOVE = 1e-12
"""Of a frame, metres and radians: less is rounding."""
NORMALISED_TAU = 30
"""Places, two seconds of them."""
TELL_LEVEL = Aid.PLACE, Aid.FLOW, Aid.REST
MAX_REFUSED_NS = 1_000_000_000
"""Places refused in a row for longer are believed: the filter begins anew. Where none came for so
long, a row ends."""
SHOCK_NS = 500_000_000
"""Rest refused in a row for so long, while no place is accepted, is believed: a blow has stopped
the body. Accelerometers sample it too seldom to measure it, and what they are off by afterwards is
no bias."""


class BodyFilter:
    """Kalman filter of one body in a frame that changes only by what it is told.

    Each measurement counts at its own time: one that comes before the accelerations up to it
    waits, and after one that comes late what was measured since is taken again.
    """

    def __init__(self, integral: AccelerationIntegral) -> None:
        self._integral = integral
        self._state = _unknown()
        self._begun = False
        self._waiting: deque[Aiding] = deque()
        self._taken: deque[tuple[BodyState, Aiding]] = deque()
        """The latest measurements, and the state before each."""
        self._refused_places = RefusedRun(MAX_REFUSED_NS)
        self._refused_rests = RefusedRun(MAX_HELD_NS)
        self._aided_ns = 0
        self._normalised = 1.0
        """Mean squared innovation per degree of freedom, of the latest places."""
        self._n_refused = Counter[str]()

    @property
    def world_from_attitude(self) -> Array:
        """Rotation (3, 3) from the autopilot's NED axes to those of the places."""
        return self._state.world_from_attitude

    @property
    def knows_ground(self) -> bool:
        """True where flow over the ground is of use."""
        return self._begun and float(self._state.covariance[GROUND, GROUND]) > 0.0

    def over_ground(self) -> tuple[float, float]:
        """Height above the ground at the last measurement, metres, and its standard deviation."""
        seen = np.zeros(N_STATE)
        seen[GROUND], seen[DOWN] = 1.0, -1.0
        return float(seen @ self._state.mean), float(np.sqrt(seen @ self._state.covariance @ seen))

    @property
    def refuses(self) -> bool:
        """True where the innovation gate has refused the newest place, and the one before."""
        return self._refused_places.repeated

    @property
    def n_refused(self) -> dict[str, int]:
        """Number of measurements that the innovation gate refused, by kind; others are left out."""
        return dict(self._n_refused)

    def aid(self, measured: Aiding) -> None:
        """Add what was measured, at its time by autopilot stamps."""
        self._waiting.append(measured)
        self._take_waiting()

    def turn(self, t_ns: int, segment: int, map_from_body: Array) -> None:
        """Learn of the gyroscopes from a rotation (3, 3) in a map, at a time by their stamps."""
        self._integral.level.see(t_ns, segment, map_from_body)

    def lift_off(self, ground_down_m: float, sigma_m: float) -> None:
        """Take the ground that the body has lifted off, at a down coordinate."""
        self._state = self._state.with_part(GROUND, ground_down_m, sigma_m)
        self._taken.clear()

    def reset(self) -> None:
        """Forget place, velocity and heights; bias and tilt are the same in another map."""
        self._state, self._begun = self._state.without(GROUND, BAROMETER), False
        self._refused_places.end()
        self._refused_rests.end()
        self._waiting.clear()
        self._taken.clear()

    def doubt(self, sigma_m: float, sigma_m_s: float) -> None:
        """Take that what has aided it was wrong: by how much in place and velocity.

        Bias and tilt are as uncertain as at first again.
        """
        covariance = self._state.covariance.copy()
        doubted = ((PLACE, sigma_m), (VELOCITY, sigma_m_s), (BIAS, SIGMA_BIAS_M_S2))
        for part, sigma in (*doubted, (TILT, SIGMA_TILT_M_S2)):
            covariance[part, part] += sigma**2 * np.eye(part.stop - part.start)
        self._state = self._state._replace(covariance=covariance)
        self._waiting = deque(each for each in self._waiting if not isinstance(each, AidedPlace))
        self._taken.clear()
        self._refused_places.end()

    def forget(self) -> None:
        """Forget all: the accelerations were wrong."""
        self.reset()
        self._state = _unknown()._replace(world_from_attitude=self.world_from_attitude)

    def move(self, rotation: Array, about_m: Array, to_m: Array) -> None:
        """Change of the frame: what was at `about_m` is at `to_m`, turned about it."""
        if np.abs(np.r_[to_m - about_m, (rotation - np.eye(3)).ravel()]).max() < LEAST_MOVE:
            return
        self._change(
            lambda state: state.moved(rotation, about_m, to_m, 1.0),
            lambda place: place.moved(rotation, about_m, to_m, 1.0),
        )

    def rescale(self, about_m: Array, ratio: float, sigma: float) -> None:
        """Change of the map's scale, known to `sigma` now: it has grown about a place (3,)."""
        self._change(
            lambda state: state.rescaled(about_m, ratio, sigma),
            lambda place: place.moved(np.eye(3), about_m, about_m, ratio),
        )

    def _change(
        self, state: Callable[[BodyState], BodyState], place: Callable[[AidedPlace], AidedPlace]
    ) -> None:
        """Change all that is in the frame of the places."""

        def changed(each: Aiding) -> Aiding:
            return place(each) if isinstance(each, AidedPlace) else each

        self._state = state(self._state)
        self._waiting = deque(map(changed, self._waiting))
        self._taken = deque((state(before), changed(each)) for before, each in self._taken)

    def at(self, t_ns: int) -> Reckoned | None:
        """Place and velocity at a time by autopilot stamps; None where not known.

        By accelerations from the last measurement that was taken, and not before that.
        """
        self._take_waiting()
        end_ns = min(t_ns, self._integral.newest_ns)
        integral = self._integral
        if not self._begun or not integral.believed or integral.level.contradicted:
            return None
        if t_ns - end_ns > MAX_HELD_NS or end_ns < self._state.t_ns:
            return None
        state = propagated(self._state, end_ns, self._integral)
        if state is not None and t_ns > end_ns:
            state = carried_on(state, t_ns, self._integral)
        return None if state is None else self._reckoned(state)

    def moving(self, t_ns: int) -> Reckoned | None:
        """The same, with the velocity held where accelerations are missing.

        None while they are there and not believed yet: bias and tilt are learnt by them meanwhile.
        """
        found = self.at(t_ns)
        unproved = self._integral.has_samples and not self._integral.believed
        if found is not None or unproved or not self._begun:
            return found
        if not 0 <= t_ns - self._state.t_ns <= MAX_HELD_NS:
            return None
        return self._reckoned(held(self._state, t_ns))

    def _reckoned(self, state: BodyState) -> Reckoned:
        """Motion by a state, at its time."""
        mean = state.mean
        # accelerations that do not fit what is seen are stated as less certain
        unlikely = max(1.0, float(np.sqrt(self._normalised)))
        velocity_ned_m_s = state.world_from_attitude.T @ mean[VELOCITY]
        covariance = unlikely**2 * state.in_true_metres().covariance[START, START]
        start = InertialStart(state.t_ns, velocity_ned_m_s, mean[BIAS].copy(), covariance)
        return Reckoned(
            mean[PLACE].copy(), mean[VELOCITY].copy(), unlikely * state.sigma(PLACE),
            unlikely * state.sigma(VELOCITY), start, (state.t_ns - self._aided_ns) * 1e-9,
        )  # fmt: skip

    def _take_waiting(self) -> None:
        """Take all that does not wait for accelerations up to it which are about to come."""
        while self._waiting:
            ahead_ns = self._waiting[0].t_ns - self._integral.newest_ns
            if 0 < ahead_ns <= MAX_HELD_NS:
                break
            self._take(self._waiting.popleft())

    def _take(self, measured: Aiding) -> None:
        """Take a measurement at its time, and again what was measured since."""
        since = deque[Aiding]()
        while self._taken and self._taken[-1][1].t_ns > measured.t_ns:
            self._state, again = self._taken.pop()
            since.appendleft(again)
        self._correct_by(measured)
        for each in since:
            self._correct_by(each, again=True)
        while self._taken and self._taken[0][1].t_ns < self._state.t_ns - MAX_HELD_NS:
            self._taken.popleft()

    def _correct_by(self, measured: Aiding, again: bool = False) -> None:
        """Correct by what was measured, unless the gate refuses it; count it unless taken again."""
        if not self._begun:
            if isinstance(measured, AidedPlace):
                self._begin(measured)
            return
        if measured.t_ns < self._state.t_ns:
            return  # from before all that is kept
        before = self._state
        state = propagated(before, measured.t_ns, self._integral) or held(before, measured.t_ns)
        if isinstance(measured, AidedPlace):
            state = state._replace(world_from_attitude=measured.world_from_attitude)
        if isinstance(measured, AidedHeight) and not state.covariance[BAROMETER, BAROMETER] > 0.0:
            self._taken.append((before, measured))
            self._state = state.with_barometer(measured.height_m, SIGMA_BAROMETER_M)
            return
        if isinstance(measured, AidedPlace) and measured.sigma_scale is not None:
            self._taken.append((before, measured))
            self._state = _placed(state, measured)
            self._refused_places.end()
            return
        model = model_of(measured, state)
        if model is None:
            return
        self._taken.append((before, measured))
        corrected, squared = corrected_by(state, model)
        if corrected is not None:
            self._state = corrected
            self._aided_ns = measured.t_ns if model.kind in TELL_LEVEL else self._aided_ns
        if again:
            return
        if corrected is None:
            self._n_refused[model.kind.value] += 1
        if isinstance(measured, AidedPlace):
            # a refused one shows that it does not fit, not by how much those that fit are off
            squared = min(squared, CHI_SQUARE_LIMIT[3])
            self._normalised += (squared / 3.0 - self._normalised) / NORMALISED_TAU
            self._judge(measured, refused=corrected is None)
        if isinstance(measured, AidedRest):
            self._judge_rest(state, measured, refused=corrected is None)

    def _judge(self, place: AidedPlace, refused: bool) -> None:
        """Begin anew with a place, where places have been refused for too long."""
        if not refused:
            self._refused_places.end()
            self._refused_rests.end()
        elif self._refused_places.refuse(place.t_ns) > MAX_REFUSED_NS:
            self._begin(place)

    def _judge_rest(self, state: BodyState, rest: AidedRest, refused: bool) -> None:
        """Take a body to rest, with a state at its time, where that was refused for too long."""
        if not refused:
            self._refused_rests.end()
        elif self._refused_rests.refuse(rest.t_ns) >= SHOCK_NS:
            self._state = state.with_part(VELOCITY, np.zeros(3), rest.sigma_m_s)
            self._refused_rests.end()
            self._taken.clear()

    def _begin(self, place: AidedPlace) -> None:
        """Place and velocity anew."""
        state = self._state
        if not state.covariance[BIAS, BIAS].any():
            state = state.with_part(BIAS, state.mean[BIAS], SIGMA_BIAS_M_S2)
            state = state.with_part(TILT, state.mean[TILT], SIGMA_TILT_M_S2)
            state = state.with_part(DRIFT, state.mean[DRIFT], SIGMA_DRIFT_M_S3)
        state = _placed(state, place).with_part(VELOCITY, np.zeros(3), SIGMA_SPEED_M_S)
        self._state = state._replace(t_ns=place.t_ns, world_from_attitude=place.world_from_attitude)
        self._begun, self._aided_ns = True, place.t_ns
        self._refused_places.end()
        self._taken.clear()


def _placed(state: BodyState, place: AidedPlace) -> BodyState:
    """The state with a place that is taken as it is."""
    sigma_m = max(place.sigma_m, LEAST_SIGMA_PLACE_M)
    if place.sigma_scale is None:
        return state.with_part(PLACE, place.place_m, sigma_m)
    return state.in_map(place.place_m, sigma_m, place.sigma_scale)


def _unknown() -> BodyState:
    """A state of which nothing is known."""
    return BodyState(0, np.zeros(N_STATE), np.zeros((N_STATE, N_STATE)), np.eye(3))
