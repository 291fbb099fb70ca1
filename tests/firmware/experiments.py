"""The table of experiments: each is one flight, or one try on the ground."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.firmware import manoeuvres
from tests.firmware.faults import FAULTS, suffer
from tests.firmware.features import BEFORE_A_WALL, DEGREE_M, FEATURES, OWN_SOURCES, up_by_gps
from tests.firmware.figures import Figures, strayed_m
from tests.firmware.pilots import SET_EKF_SOURCE_SET
from tests.firmware.trial import Conditions, Trial
from tests.firmware.way_back import WAY_BACK, way_back

Flown = Callable[[Trial, Figures], None]
HOLD_S, READY_S, PATIENT_S, SWING_S, TOLD_S = 60.0, 30.0, 45.0, 40.0, 5.0
USUAL = "position on", "dead reckoning", "autopilot connected", "camera recovered"
"""Texts of a flight in which nothing is wrong."""
SIXTY_POSES = "expert.feedback.rate_hz=60"
"""A second: 15 kB, of which 115200 baud carry 11.5."""
GLITCH_DEG = 50.0 / DEGREE_M


def take_off(trial: Trial, figures: Figures) -> None:
    """No GPS from power-on; up, hold, down."""
    stood = trial.ground.place_m
    if manoeuvres.up(trial, figures):
        time.sleep(manoeuvres.SETTLE_S)
        manoeuvres.keep_place(trial, figures, "hold after take-off", 15.0)
        manoeuvres.land(trial, figures, stood)


def square(trial: Trial, figures: Figures) -> None:
    """No GPS from power-on; the first half of a tour: hold, square of 4 m, landing."""
    stood = trial.ground.place_m
    if not manoeuvres.up(trial, figures):
        return
    trial.mark(f"holds in {trial.pilot.holds_in}: {trial.pilot.set_mode(trial.pilot.holds_in)}")
    time.sleep(manoeuvres.SETTLE_S)
    manoeuvres.keep_place(trial, figures, "hold", 0.5 * HOLD_S)
    manoeuvres.ready_to_go(trial)
    manoeuvres.fly_square(trial, figures, 4.0, 0.15)
    manoeuvres.land(trial, figures, stood)


def tour(trial: Trial, figures: Figures) -> None:
    """No GPS from power-on; hold, squares, circle, climb, full turn, landing where it took off."""
    stood = trial.ground.place_m
    if not manoeuvres.up(trial, figures):
        return
    trial.mark(f"holds in {trial.pilot.holds_in}: {trial.pilot.set_mode(trial.pilot.holds_in)}")
    time.sleep(manoeuvres.SETTLE_S)
    manoeuvres.keep_place(trial, figures, "hold", HOLD_S)
    manoeuvres.ready_to_go(trial)
    home, yaw_rad = trial.ground.believed_m, manoeuvres.believed_yaw(trial)
    manoeuvres.fly_square(trial, figures, 4.0, 0.15)
    manoeuvres.fly_square(trial, figures, 20.0, 0.3)
    manoeuvres.fly_circle(trial, figures)
    manoeuvres.climb(trial, figures)
    manoeuvres.turn(trial, figures)
    trial.pilot.go_to(np.array([*home[:2], trial.ground.believed_m[2]]), yaw_rad)
    time.sleep(manoeuvres.SETTLE_S)
    manoeuvres.land(trial, figures, stood)


def full_turn(trial: Trial, figures: Figures) -> None:
    """No GPS from power-on; once about on the spot over ground seen for a few seconds, landing."""
    stood = trial.ground.place_m
    if not manoeuvres.up(trial, figures):
        return
    time.sleep(manoeuvres.SETTLE_S)
    manoeuvres.ready_to_go(trial)
    home, yaw_rad = trial.ground.believed_m, manoeuvres.believed_yaw(trial)
    manoeuvres.turn(trial, figures)
    trial.pilot.go_to(home, yaw_rad)
    time.sleep(manoeuvres.SETTLE_S)
    manoeuvres.land(trial, figures, stood)


def wander(trial: Trial, figures: Figures) -> None:
    """Five minutes about, and back over known ground."""
    if not manoeuvres.up(trial, figures):
        return
    manoeuvres.ready_to_go(trial)
    start, true_start = trial.ground.believed_m, manoeuvres.mean_place(trial)
    yaw_rad, rng = manoeuvres.believed_yaw(trial), np.random.default_rng(trial.conditions.seed)
    end_s = time.time() + 300.0
    while time.time() < end_s and trial.ground.armed:
        way = np.append(rng.uniform(-12, 12, 2), rng.uniform(-4, 0))
        trial.pilot.go_to(start + way, yaw_rad + rng.uniform(-1, 1), within_m=1.0)
    trial.pilot.go_to(start, yaw_rad)
    time.sleep(manoeuvres.SETTLE_S)
    off = manoeuvres.mean_place(trial) - true_start
    figures.add("drift after five minutes", float(np.linalg.norm(off)), "m", 0.3)
    trial.pilot.land()


def faults(trial: Trial, figures: Figures) -> None:
    """Camera, cable and companion fail in the air, one after the other."""
    if not manoeuvres.up(trial, figures):
        return
    trial.pilot.set_mode(trial.pilot.holds_in)
    time.sleep(manoeuvres.SETTLE_S)
    wanted = [w.removeprefix("fault=") for w in trial.words if w.startswith("fault=")]
    for fault in FAULTS:
        if wanted and not any(each in fault.name for each in wanted):
            continue
        if not suffer(trial, figures, fault):
            figures.add_true(f"goes on after {fault.name}", False)
            break
    trial.pilot.land()


def second_flight(trial: Trial, figures: Figures) -> None:
    """Two flights after one power-on; the autopilot restarts on the ground between a third."""
    stood = trial.ground.place_m
    if not manoeuvres.up(trial, figures):
        return
    manoeuvres.land(trial, figures, stood)
    time.sleep(manoeuvres.SETTLE_S)
    figures.add_true("poses go on after landing", trial.sending, str(trial.feedback))
    if manoeuvres.take_off(trial, figures):
        manoeuvres.land(trial, figures, trial.ground.place_m)
    trial.firmware.restart()
    trial.mark("autopilot restarted")
    time.sleep(manoeuvres.SETTLE_S)
    trial.ground.until(lambda: time.time() - trial.ground.came_s["HEARTBEAT"] < 1.0, 30.0)
    trial.ground.ask_for_messages()
    began_s = time.time()
    if manoeuvres.take_off(trial, figures):
        figures.add("flies again after a restart", time.time() - began_s, "s")
        manoeuvres.land(trial, figures, trial.ground.place_m)


def gps_lost(trial: Trial, figures: Figures) -> None:
    """Up by GPS; over to our pose by source set; GPS goes, and comes back 50 m off."""
    if not up_by_gps(trial, figures):
        return
    sending = trial.until("poses", lambda: trial.sending, 20.0)
    figures.add_true("poses beside GPS", sending is not None, str(trial.feedback))
    if sending is None:
        trial.pilot.land()
        return
    for name, change in (
        ("over to our pose", {}),
        ("GPS goes", {"SIM_GPS1_ENABLE": 0.0}),
        ("GPS comes back 50 m off", {"SIM_GPS1_ENABLE": 1.0, "SIM_GPS1_GLTCH_X": GLITCH_DEG}),
    ):
        before = manoeuvres.mean_place(trial)
        if not change:
            trial.ground.command(SET_EKF_SOURCE_SET, 2.0)
        trial.pilot.set_parameters(change)
        trial.mark(name)
        began_s = time.time()
        time.sleep(20.0)
        moved = trial.ground.window(began_s, time.time()) - before
        figures.add(f"{name}: moved", float(np.linalg.norm(moved, axis=1).max()), "m", 0.3)
    manoeuvres.fly_square(trial, figures, 4.0, 0.15)
    trial.pilot.land()


def doctor(trial: Trial, figures: Figures) -> None:
    """From the firmware's own defaults by `companion doctor --write` alone; then take-off."""
    said = trial.run_companion("doctor", "--write", "--yes")
    figures.add_true("doctor writes", said.returncode == 0, said.stdout[-300:])
    trial.firmware.restart()
    time.sleep(manoeuvres.SETTLE_S)
    trial.ground.ask_for_messages()
    trial.start_daemon()
    stood = trial.ground.place_m
    if manoeuvres.get_ready(trial, figures) and manoeuvres.take_off(trial, figures):
        manoeuvres.land(trial, figures, stood)


def wrong_set_up(trial: Trial, figures: Figures) -> None:
    """Something is not as it is said to be: refused or said, and never flown away on."""
    began_s, stood = time.time(), trial.ground.place_m
    trial.start_daemon()
    sending = trial.until("poses", lambda: trial.sending, PATIENT_S)
    figures.add("first pose after both are up", sending, "s", note=str(trial.feedback))
    told = trial.until("told before arming", lambda: _warnings(trial, began_s), TOLD_S)
    said = " / ".join(_warnings(trial, began_s))
    figures.add_true("the pilot is told before arming", told is not None, said)
    armed = sending is not None and manoeuvres.armed_in(trial, trial.pilot.modes_to_arm_in[-1])
    if armed:
        trial.pilot.take_off(manoeuvres.TAKE_OFF_M)
        time.sleep(10.0)
        level_m, _ = strayed_m(trial.ground.window(began_s, time.time()), stood)
        figures.add("level way until 10 s after take-off", level_m.max(), "m", 1.0)
        trial.mark(f"sending {trial.sending}, {trial.ground.mode}")
        trial.pilot.land()
    texts = _warnings(trial, began_s)
    figures.add_true("the pilot is told", bool(texts), " / ".join(texts))


def _warnings(trial: Trial, since_s: float) -> list[str]:
    """What the pilot has read from the companion since then, but for what is usual."""
    texts = dict.fromkeys(t for t in trial.ground.texts_since(since_s) if "Companion" in t)
    return [text for text in texts if not any(good in text for good in USUAL)]


def wrong_lens(trial: Trial, figures: Figures) -> None:
    """Another focal length than is said: told by turning to and fro, which a drone may in hand."""
    stood, began_s = trial.ground.place_m, time.time()
    if not manoeuvres.up(trial, figures):
        return
    figures.add_true("unproven lens told before arming", trial.said("unproven", began_s))
    said = trial.until("focal length", lambda: trial.said("focal length", began_s), 1.0)
    figures.add_true("nothing is said before it turns", said is None)
    turned_s = time.time()
    manoeuvres.swing(trial)
    said = trial.until("focal length", lambda: trial.said("focal length", turned_s), SWING_S)
    figures.add("focal length said after so long of turning", said, "s", SWING_S)
    level_m, _ = strayed_m(trial.ground.window(began_s, time.time()), stood)
    figures.add("level way until then", level_m.max(), "m", 1.0)
    manoeuvres.land(trial, figures, stood)


def two_companions(trial: Trial, figures: Figures) -> None:
    """Two are started at once: neither begins while the other is there; then one flies."""
    trial.start_daemon()
    with trial.second_companion():
        began = trial.until("poses", lambda: trial.sending, 2 * READY_S)
        figures.add_true("no pose beside another companion", began is None, str(trial.feedback))
        told = any("second companion" in text for _, text in trial.ground.texts)
        figures.add_true("the pilot is told", told)
        figures.add_true(
            "cannot be armed", not manoeuvres.armed_in(trial, trial.pilot.modes_to_arm_in[0])
        )
    trial.mark("the other has gone")
    stood = trial.ground.place_m
    if manoeuvres.get_ready(trial, figures) and manoeuvres.take_off(trial, figures):
        manoeuvres.land(trial, figures, stood)


COPTER_PARAMETERS = {
    "VISO_TYPE": (2, 3), "EK3_SRC1_POSZ": (6,), "EK3_SRC1_VELZ": (0,), "EK3_SRC1_VELXY": (0,),
    "EK3_SRC1_YAW": (6,), "VISO_DELAY_MS": (0, 160), "EK3_SRC_OPTIONS": (0,),
}  # fmt: skip
PX4_PARAMETERS = {
    "EKF2_EV_CTRL": (3, 15), "EKF2_HGT_REF": (3,), "EKF2_EV_DELAY": (50,), "EKF2_EV_NOISE_MD": (1,),
    "COM_ARM_WO_GPS": (0,),
}  # fmt: skip
"""Values other than those that docs/autopilots.md asks for, tried one at a time."""
EXPERIMENTS: dict[str, tuple[Flown, Conditions]] = {
    "take_off": (take_off, Conditions()),
    "square": (square, Conditions()),
    "square_avoiding": (square, replace(BEFORE_A_WALL, landmarks="")),
    "tour": (tour, Conditions()),
    "full_turn": (full_turn, Conditions()),
    "wander": (wander, Conditions()),
    "faults": (faults, Conditions()),
    "second_flight": (second_flight, Conditions()),
    "doctor": (doctor, Conditions(by_doctor=True)),
    "gps_lost": (gps_lost, Conditions(has_gps=True, parameters=OWN_SOURCES)),
    **FEATURES,
    "way_back": (way_back, WAY_BACK),
    "mount_90": (wrong_set_up, Conditions(mount_roll_deg=90.0)),
    "upside_down": (wrong_set_up, Conditions(mount_roll_deg=180.0)),
    "lens_10": (wrong_lens, Conditions(lens_scale=1.1)),
    "two_companions": (two_companions, Conditions()),
    "baud_115200": (take_off, Conditions(baud=115200)),
    "slow_link": (wrong_set_up, Conditions(baud=115200, settings=(SIXTY_POSES,))),
    "perfect": (tour, Conditions(perfect=True)),
    **{
        f"{name}={value}": (take_off, Conditions(parameters={name: value}))
        for name, values in (COPTER_PARAMETERS | PX4_PARAMETERS).items()
        for value in values
    },
    **{look: (take_off, Conditions(look=look)) for look in ("dusk", "lawn", "water", "shadow")},
}
