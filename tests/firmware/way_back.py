"""The way back, flown by the autopilot's mission mode: a flight over a site, then one in its map.

The first flight has satellites, which place the map, and flies the way to and fro. The second has
none, from power-on: it is located in the first one's map, flies out by command, fetches the way
back from the companion, gives it to the autopilot, and lets it fly.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import numpy as np

from companion.geometry.transforms import Array
from tests.firmware import manoeuvres
from tests.firmware.features import OWN_SOURCES, up_by_gps
from tests.firmware.figures import Figures, percentile
from tests.firmware.missions import fetched, uploaded
from tests.firmware.trial import Conditions, Trial

WAY_M = ((12.0, 0.0), (12.0, 8.0))
FLOWN_S, LOCATED_S = 60.0, 30.0
OFF_M = 1.0
LOW_M, STILL_M_S = 1.2, 0.15


def way_back(trial: Trial, figures: Figures) -> None:
    """See above."""
    if not up_by_gps(trial, figures):
        return
    _fly(trial, WAY_M)
    _fly(trial, ((12.0, 0.0), (0.0, 0.0)))
    trial.pilot.land()
    saved = trial.end_daemon()
    figures.add_true("the first flight leaves its map", saved is not None, str(saved))
    if saved is None:
        return
    _restart_without_gps(trial)
    _use_map(trial, saved)
    if manoeuvres.up(trial, figures):
        _out_and_back(trial, figures)
    trial.pilot.land()


def _out_and_back(trial: Trial, figures: Figures) -> None:
    located = trial.until("located in the saved map", lambda: _is_located(trial), LOCATED_S)
    figures.add("located in the saved map after take-off", located, "s")
    manoeuvres.ready_to_go(trial)
    began_s = time.time()
    _fly(trial, WAY_M)
    out_m = trial.ground.window(began_s, time.time())
    items = fetched(trial.ground)
    figures.add("waypoints of the way back", len(items))
    trial.mark(f"way back: {[(each.x, each.y, round(each.z, 1)) for each in items]}")
    took = bool(items) and uploaded(trial.ground, items)
    figures.add_true("the autopilot takes the mission", took)
    if not took:
        return
    trial.pilot.stream(None)
    began_s = time.time()
    trial.mark(f"AUTO: {trial.pilot.set_mode('AUTO')}")
    trial.until("back", lambda: _is_back(trial, out_m[0], began_s), FLOWN_S)
    back_m = trial.ground.window(began_s, time.time())
    near_m = np.linalg.norm(back_m[:, None, :2] - out_m[None, ::10, :2], axis=2).min(axis=1)
    end_m = float(np.linalg.norm((back_m[-1] - out_m[0])[:2]))
    trial.mark(f"back, {end_m:.2f} m from where it set out")
    figures.add("way back: off the way out, level, 95 %", percentile(near_m, 95), "m", OFF_M)
    figures.add("way back: off the way out, level, at most", near_m.max(), "m", OFF_M)
    figures.add("way back: its end from where it set out, level", end_m, "m", OFF_M)


def _fly(trial: Trial, places_m: tuple[tuple[float, float], ...]) -> None:
    """To places about where it set out, north and east, in its own frame."""
    yaw_rad, down_m = manoeuvres.believed_yaw(trial), trial.ground.believed_m[2]
    for north_m, east_m in places_m:
        trial.pilot.go_to(np.array([north_m, east_m, down_m]), yaw_rad, within_m=0.5)
    time.sleep(manoeuvres.SETTLE_S)


def _is_back(trial: Trial, set_out_m: Array, began_s: float) -> bool:
    newest = trial.ground.true[-1]
    still = float(np.linalg.norm(newest.velocity_m_s)) < STILL_M_S
    near = float(np.linalg.norm((newest.place_m - set_out_m)[:2])) < 2 * OFF_M
    return -newest.place_m[2] < LOW_M or (near and still and time.time() - began_s > 5.0)


def _is_located(trial: Trial) -> bool:
    return any("located in the saved map" in text for _, text in trial.ground.texts)


def _restart_without_gps(trial: Trial) -> None:
    """Off and on again, as in a shed: no receiver, our pose in the first source set."""
    firmware = trial.firmware
    firmware.parameters |= {**firmware.without_gps, **firmware.on_our_pose}
    firmware.restart()
    trial.mark("autopilot restarted, without GPS")
    time.sleep(manoeuvres.SETTLE_S)
    trial.ground.until(lambda: time.time() - trial.ground.came_s["HEARTBEAT"] < 1.0, 30.0)
    trial.ground.ask_for_messages()


def _use_map(trial: Trial, saved: Path) -> None:
    settings = (*trial.conditions.settings, f"map.use={saved}")
    trial.conditions = dataclasses.replace(trial.conditions, settings=settings)


WAY_BACK = Conditions(has_gps=True, parameters=OWN_SOURCES)
