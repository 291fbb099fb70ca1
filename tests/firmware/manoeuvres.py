"""Manoeuvres of a trial and what they measure, each by the truth."""

from __future__ import annotations

import math
import time

import numpy as np

from companion.geometry.transforms import Array
from tests.firmware.figures import Figures, percentile, strayed_m
from tests.firmware.trial import Trial

READY_S = 30.0
TAKE_OFF_M = 5.0
SETTLE_S, CORNER_S = 3.0, 6.0
"""The second until a vehicle that is told its corner anew all the time has come to rest there."""
LIMIT_HOLD_M, LIMIT_HEIGHT_M = 0.10, 0.15
JUMP_M = 0.3
CIRCLE_RADIUS_M, CIRCLE_SPEED_M_S = 5.0, 2.0
CORNERS = ((1, 0), (1, 1), (0, 1), (0, 0))
TURN_S = 24.0
MEAN_S = 1.0
SWING_RAD, SWING_PERIOD_S = 0.5, 8.0


def up(trial: Trial, figures: Figures) -> bool:
    """The daemon started, and 5 m up on its poses."""
    trial.start_daemon()
    return get_ready(trial, figures) and take_off(trial, figures)


def armed_in(trial: Trial, mode: str, patience_s: float = 15.0) -> bool:
    """Arm in a mode with the sticks at rest; what the autopilot says to it is noted."""
    began_s = time.time()
    trial.pilot.hold_sticks(in_air=False)
    armed = trial.pilot.set_mode(mode, patience_s) and trial.pilot.arm(patience_s)
    texts = dict.fromkeys(trial.ground.texts_since(began_s)[-6:])
    trial.mark(f"armed {armed}: {' / '.join(texts)}")
    return armed


def get_ready(trial: Trial, figures: Figures) -> bool:
    """From power-on to a vehicle that has been armed where it stands, in each mode that matters."""
    began_s = time.time()
    sending = trial.until("poses", lambda: trial.sending, 3 * READY_S)
    figures.add("first pose after both are up", sending, "s", READY_S)
    if sending is None:
        trial.mark(f"why not: {trial.feedback}")
        return False
    trial.pilot.hold_sticks(in_air=False)
    for mode in trial.pilot.modes_to_arm_in:
        has_mode = trial.pilot.set_mode(mode, 20.0)
        armed = has_mode and trial.pilot.arm(20.0)
        texts = " / ".join(dict.fromkeys(trial.ground.texts_since(began_s)[-6:]))
        trial.mark(f"{mode} {has_mode}, armed {armed}")
        figures.add_true(f"armed in {mode}, all checks on", armed, "" if armed else texts)
        if not armed:
            return False
        if mode == trial.pilot.modes_to_arm_in[0]:
            figures.add("armed after both are up", time.time() - began_s, "s", READY_S)
        trial.pilot.disarm()
    return True


def take_off(trial: Trial, figures: Figures, height_m: float = TAKE_OFF_M) -> bool:
    """By command, without a stick, in the mode that goes to places."""
    ground, pilot = trial.ground, trial.pilot
    stood = ground.place_m
    began_s = time.time()
    armed = pilot.set_mode(pilot.modes_to_arm_in[-1], 10.0) and pilot.arm(30.0)
    if not armed:
        figures.add_true("armed for take-off", False, " / ".join(ground.texts_since(began_s)[-4:]))
        return False
    trial.mark("armed")
    up = pilot.take_off(height_m)
    time.sleep(SETTLE_S)
    trial.mark(f"take-off {up}")
    rose = ground.place_m - stood
    figures.add_true("took off by command", up, " / ".join(ground.texts_since(began_s)[-4:]))
    figures.add("height after take-off", abs(-rose[2] - height_m), "m", 0.3)
    path = ground.window(began_s, time.time())
    figures.add("level way in take-off", strayed_m(path, stood)[0].max(), "m", 0.5)
    return up and -rose[2] > 0.5 * height_m


def keep_place(trial: Trial, figures: Figures, name: str, seconds: float) -> None:
    """Hold, in the mode that is on."""
    began_s = time.time()
    begun = mean_place(trial)
    mode = trial.ground.mode
    while time.time() - began_s < seconds and trial.ground.mode == mode and trial.ground.armed:
        time.sleep(0.1)
    level_m, down_m = strayed_m(trial.ground.window(began_s, time.time()), begun)
    trial.mark(f"{name}, {time.time() - began_s:.0f} s in {mode}")
    figures.add(f"{name}, level, 95 %", percentile(level_m, 95), "m", LIMIT_HOLD_M)
    figures.add(f"{name}, height, 95 %", percentile(down_m, 95), "m", LIMIT_HEIGHT_M)
    figures.add_true(f"{name}, mode kept", trial.ground.mode == mode, trial.ground.mode)


def mean_place(trial: Trial) -> Array:
    """The true one of the last second."""
    place_m: Array = trial.ground.window(time.time() - MEAN_S, time.time()).mean(axis=0)
    return place_m


def ready_to_go(trial: Trial) -> bool:
    """Into the mode that goes to places, holding where it is."""
    here, yaw_rad = trial.ground.believed_m, believed_yaw(trial)
    trial.pilot.stream(lambda: (here, np.zeros(3), yaw_rad))
    time.sleep(0.5)
    return trial.pilot.set_mode(trial.pilot.flown_in)


def believed_yaw(trial: Trial) -> float:
    """The heading of the autopilot."""
    return float(trial.ground.latest["ATTITUDE"].yaw)


def fly_square(trial: Trial, figures: Figures, side_m: float, asked_m: float) -> None:
    """Corners where they were asked for; sides as long as they were."""
    start, true_start, yaw_rad = trial.ground.believed_m, mean_place(trial), believed_yaw(trial)
    errors, corners = [], [np.zeros(2)]
    for corner in CORNERS:
        way = np.array([*corner, 0.0]) * side_m
        there = trial.pilot.go_to(start + way, yaw_rad)
        time.sleep(CORNER_S)
        corners.append((mean_place(trial) - true_start)[:2])
        errors.append(float(np.linalg.norm(corners[-1] - way[:2])))
        trial.mark(f"corner {corner} of {side_m:g} m: {there}, off by {errors[-1]:.2f} m")
    sides = np.linalg.norm(np.diff(np.array(corners), axis=0), axis=1)
    turned_rad, own = _in_own_axes(side_m * np.array([[0, 0], *CORNERS]), np.array(corners))
    figures.add(f"square of {side_m:g} m, worst corner", max(errors), "m")
    figures.add(f"square of {side_m:g} m, turned by its compass", math.degrees(turned_rad), "deg")
    figures.add(f"square of {side_m:g} m, worst corner in its own axes", own, "m", asked_m)
    if side_m >= 10:
        scale = 100 * abs(sides.mean() / side_m - 1)
        figures.add(f"square of {side_m:g} m, scale off", scale, "%", 1.0)


def _in_own_axes(wanted_m: Array, reached_m: Array) -> tuple[float, float]:
    """Angle of the axes that an autopilot has by its compass, and the worst error about them."""
    a, b = wanted_m - wanted_m.mean(0), reached_m - reached_m.mean(0)
    angle = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return angle, float(np.linalg.norm(wanted_m @ turn.T - reached_m, axis=1).max())


def fly_circle(trial: Trial, figures: Figures) -> None:
    """Once round, as fast as asked."""
    start, true_start, yaw_rad = trial.ground.believed_m, mean_place(trial), believed_yaw(trial)
    rate_hz = CIRCLE_SPEED_M_S / CIRCLE_RADIUS_M
    began_s = time.time()

    def wanted(t_s: float) -> tuple[Array, Array]:
        angle = rate_hz * t_s
        way = CIRCLE_RADIUS_M * np.array([math.cos(angle) - 1, math.sin(angle), 0.0])
        speed = CIRCLE_SPEED_M_S * np.array([-math.sin(angle), math.cos(angle), 0.0])
        return way, speed

    def setpoint() -> tuple[Array, Array, float]:
        way, speed = wanted(time.time() - began_s)
        return start + way, speed, yaw_rad

    trial.pilot.stream(setpoint)
    time.sleep(2 * math.pi / rate_hz)
    end_s = time.time()
    trial.pilot.go_to(start, yaw_rad)
    path = trial.ground.window(began_s + 3.0, end_s) - true_start
    centre = np.array([-CIRCLE_RADIUS_M, 0.0])
    radius_m = np.linalg.norm(path[:, :2] - centre, axis=1)
    time.sleep(CORNER_S)
    back_m = float(np.linalg.norm((mean_place(trial) - true_start)[:2]))
    trial.mark(f"circle, radius {np.median(radius_m):.2f} m")
    figures.add("circle, median radius", float(np.median(radius_m)), "m")
    figures.add("circle, back where it began", back_m, "m", JUMP_M)


def climb(trial: Trial, figures: Figures, by_m: float = 10.0) -> None:
    """Up and back."""
    start, true_start, yaw_rad = trial.ground.believed_m, mean_place(trial), believed_yaw(trial)
    trial.pilot.go_to(start - [0, 0, by_m], yaw_rad)
    time.sleep(SETTLE_S)
    up = mean_place(trial) - true_start
    trial.pilot.go_to(start, yaw_rad)
    time.sleep(SETTLE_S)
    back_m = float(np.linalg.norm(mean_place(trial) - true_start))
    trial.mark(f"climbed {-up[2]:.2f} m")
    figures.add("climb, level way at the top", float(np.linalg.norm(up[:2])), "m", JUMP_M)
    figures.add("climb, back where it began", back_m, "m", JUMP_M)


def turn(trial: Trial, figures: Figures) -> None:
    """Once about, on the spot."""
    start, true_start, yaw_rad = trial.ground.believed_m, mean_place(trial), believed_yaw(trial)
    n_resets = trial.feedback.get("n_resets")
    began_s = time.time()
    trial.pilot.stream(
        lambda: (start, np.zeros(3), _wrapped(yaw_rad + 2 * math.pi * _done(began_s)))
    )
    time.sleep(TURN_S + SETTLE_S)
    level_m, _ = strayed_m(trial.ground.window(began_s, time.time()), true_start)
    trial.mark("turned about")
    figures.add("full turn, level", percentile(level_m, 95), "m", 0.15)
    resets = (trial.feedback.get("n_resets") or 0) - (n_resets or 0)
    figures.add("full turn, resets", resets, "", 0.0)


def swing(trial: Trial) -> None:
    """Begin to turn to and fro on the spot, over ground that stays in view."""
    ready_to_go(trial)
    here, yaw_rad, began_s = trial.ground.believed_m, believed_yaw(trial), time.time()
    rate = 2 * math.pi / SWING_PERIOD_S
    trial.pilot.stream(
        lambda: (here, np.zeros(3), yaw_rad + SWING_RAD * math.sin(rate * (time.time() - began_s)))
    )


def land(trial: Trial, figures: Figures, took_off_m: Array) -> None:
    """Down, where it took off."""
    down = trial.pilot.land()
    off_m = float(np.linalg.norm((trial.ground.place_m - took_off_m)[:2]))
    trial.mark(f"landed, disarmed {down}")
    figures.add("landed away from take-off", off_m, "m", JUMP_M)
    figures.add_true("disarmed by itself", down)


def _done(began_s: float) -> float:
    return min(1.0, (time.time() - began_s) / TURN_S)


def _wrapped(angle_rad: float) -> float:
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
