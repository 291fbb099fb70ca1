"""Faults in the air: how far the vehicle moved, how long it had no pose, what the pilot read."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tests.firmware.figures import Figures, strayed_m
from tests.firmware.manoeuvres import mean_place
from tests.firmware.trial import Trial

WATCH_S = 12.0
PAUSE_S = 0.4
MOVED_M = {2.0: 0.1, 5.0: 0.3, 10.0: 1.0}
AGAIN_S = 15.0


class Fault(NamedTuple):
    """`order` is for the camera, or the cable; without one the daemon is killed."""

    name: str
    seconds: float
    camera: str = ""
    cable: str = ""


def _of_camera(name: str, order: str, *seconds: float) -> list[Fault]:
    return [Fault(f"{name} {s:g} s", s, camera=order.replace("S", f"{s:g}")) for s in seconds]


def _of_cable(name: str, order: str, *seconds: float) -> list[Fault]:
    return [Fault(f"{name} {s:g} s", s, cable=order.replace("S", f"{s:g}")) for s in seconds]


FAULTS = [
    *_of_camera("camera frozen", "freeze S", 2.0, 5.0),
    *_of_camera("camera repeats", "repeat S", 2.0, 5.0),
    *_of_camera("camera gone", "gone S", 2.0, 5.0),
    *_of_camera("black", "black S", 2.0, 5.0),
    *_of_camera("sun", "sun S", 2.0, 5.0),
    *_of_camera("half of the frames lost", "drop 0.5 S", 5.0),
    *_of_camera("latency 150 ms", "latency 150 S", 5.0),
    *_of_camera("exposure steps", "exposure S", 5.0),
    *_of_cable("link cut", "cut S", 2.0, 5.0),
    *_of_cable("packets lost 20 %", "lose 0.2 S", 5.0),
    *_of_cable("packets doubled or late 10 %", "disturb 0.1 S", 5.0),
    Fault("companion killed", 5.0),
    *_of_camera("camera gone", "gone S", 10.0),
    *_of_camera("black", "black S", 10.0),
]


def suffer(trial: Trial, figures: Figures, fault: Fault) -> bool:
    """Cause one in the mode that holds; whether it can go on from there."""
    ground = trial.ground
    mode, began_s, before = ground.mode, time.time(), mean_place(trial)
    if fault.camera:
        trial.tell_camera(fault.camera)
    elif fault.cable:
        trial.tell_cable(fault.cable)
    else:
        trial.kill_daemon()
    came_s = _watch(trial, began_s + fault.seconds + WATCH_S, lambda: ground.mode != mode)
    gaps_s = np.diff(np.array([began_s, *came_s, time.time()]))
    level_m, down_m = strayed_m(ground.window(began_s, time.time()), before)
    texts = list(dict.fromkeys(ground.texts_since(began_s)))
    asked_m = MOVED_M.get(fault.seconds, 0.3)
    figures.add(f"{fault.name}: moved, level", level_m.max(), "m", asked_m)
    figures.add(f"{fault.name}: moved, height", down_m.max(), "m", max(asked_m, 0.15))
    figures.add(f"{fault.name}: longest time without a pose", gaps_s.max(), "s",
                note=f"{ground.mode}; {' / '.join(texts)}")  # fmt: skip
    trial.mark(f"after {fault.name}: {ground.mode}, sending {trial.sending}")
    if ground.mode != mode or not trial.sending:
        again = trial.until("poses again", lambda: trial.sending, AGAIN_S)
        if again is None or not trial.pilot.set_mode(mode, AGAIN_S):
            return False
        time.sleep(5.0)
    return ground.armed


def _watch(trial: Trial, until_s: float, ended: Callable[[], bool]) -> list[float]:
    """When poses came."""
    came_s: list[float] = []
    while time.time() < until_s and not ended():
        last_s = trial.last_pose_s()
        if not came_s or last_s > came_s[-1]:
            came_s.append(last_s)
        time.sleep(0.02)
    return came_s
