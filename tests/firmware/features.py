"""Flights on what a firmware is given besides poses: marker, place on earth, doubt, obstacles."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from companion.geometry.transforms import Array
from tests.firmware import manoeuvres
from tests.firmware.figures import Figures, percentile, strayed_m
from tests.firmware.landmarks import FAMILY_WORD, MARKER_ID, MARKER_M, landmarks_of
from tests.firmware.pilots import SET_EKF_SOURCE_SET, CopterPilot, Px4Pilot
from tests.firmware.trial import Conditions, Trial

GPS_S, PLACED_S = 90.0, 30.0
DEGREE_M = 111319.0
JUMPED_M, PULL_M_S, PULLED_S = 50.0, 1.0, 12.0
SAID_S, JUMP_M = 3.0, 0.3
MARKER_AT = 1.5, 1.0
MARKER_OFF_M = 0.15
WALL_NORTH_M, CLEAR_M = 16.0, 1.5
WALL_S, STOPPED_M_S, HIGHER_S = 25.0, 0.1, 2.0
BEHIND_M, AROUND_S = 6.0, 60.0
BEFORE_A_WALL = Conditions(
    wind_m_s=0.0, pitch_deg=-20.0, landmarks=f"wall:{WALL_NORTH_M:g}", has_depth=True,
    parameters={"PRX1_TYPE": 2, "PRX_FILT": 0, "AVOID_ENABLE": 7},
    settings=("feedback.obstacle_distance=true", "expert.depth.stride=4"),
)  # fmt: skip
OWN_SOURCES = {
    "VISO_TYPE": 1, "VISO_DELAY_MS": 62, "EK3_SRC1_POSXY": 3, "EK3_SRC1_VELXY": 3,
    "EK3_SRC1_VELZ": 3, "EK3_SRC2_POSXY": 6, "EK3_SRC2_VELXY": 6, "EK3_SRC2_VELZ": 6,
    "EK3_SRC2_POSZ": 1, "EK3_SRC2_YAW": 1,
}  # fmt: skip
"""Satellites first, our pose as the second set."""


def up_by_gps(trial: Trial, figures: Figures) -> bool:
    """Arm and take off by satellites, then once round a square, which places the map."""
    trial.start_daemon()
    has_place = trial.ground.until(lambda: trial.ground.believed, GPS_S)
    mode = trial.pilot.modes_to_arm_in[-1]
    armed = has_place and manoeuvres.armed_in(trial, mode, GPS_S)
    figures.add_true("armed by GPS", armed)
    if not armed or not trial.pilot.take_off(manoeuvres.TAKE_OFF_M):
        return False
    manoeuvres.ready_to_go(trial)
    start, yaw_rad = trial.ground.believed_m, manoeuvres.believed_yaw(trial)
    for way in ((6, 0), (6, 6), (0, 6), (0, 0)):
        trial.pilot.go_to(start + np.array([*way, 0.0]), yaw_rad, within_m=0.7)
    time.sleep(manoeuvres.CORNER_S)  # it still brakes: what it moves is to be of the change alone
    return True


def landing_marker(trial: Trial, figures: Figures) -> None:
    """Up beside a marker, and down by the mode that lands: onto the marker."""
    stood = trial.ground.place_m
    if not manoeuvres.up(trial, figures):
        return
    seen = trial.until("marker", lambda: trial.said("marker in sight"), 10.0)
    figures.add_true("marker in sight", seen is not None)
    down = trial.pilot.land(90.0)
    off = (trial.ground.place_m - stood)[:2] - np.array(MARKER_AT)
    trial.mark(f"landed {down}, off the marker by {off.round(2).tolist()}")
    figures.add("landed away from the marker", float(np.linalg.norm(off)), "m", MARKER_OFF_M)
    figures.add_true("disarmed by itself", down)


def spoofed(trial: Trial, figures: Figures) -> None:
    """Satellites jump by 50 m, then are pulled away: said, switched, held; then a reboot."""
    if not up_by_gps(trial, figures):
        return
    sending = trial.until("poses beside GPS", lambda: trial.sending, 20.0)
    figures.add_true("poses beside GPS", sending is not None, str(trial.feedback))
    if sending is None:
        trial.pilot.land()
        return
    time.sleep(PLACED_S - 20.0)  # satellites are compared once the map was metric for ten seconds
    _deceive(trial, figures, "jump of 50 m", lambda _lasts_s: JUMPED_M)
    trial.pilot.set_parameters({"SIM_GPS1_GLTCH_X": 0.0})
    back_s = time.time()
    again = trial.until("GPS", lambda: trial.said("EKF sources switched: GPS", back_s), 25.0)
    figures.add("used again after it is where it was", again, "s")
    time.sleep(manoeuvres.SETTLE_S)
    switched_s = _deceive(trial, figures, "pull of 1 m/s", lambda lasts_s: PULL_M_S * lasts_s)
    if switched_s is not None:
        manoeuvres.keep_place(trial, figures, "hold on our pose", 10.0)
    trial.pilot.land()
    trial.firmware.restart()
    restarted_s = time.time()
    trial.mark("autopilot restarted while its sources are switched")
    again = trial.until("reboot", lambda: trial.said("autopilot reboot", restarted_s), 30.0)
    trial.ground.ask_for_messages()
    time.sleep(10.0)
    figures.add("its restart is seen after", again, "s")
    texts = [t for t in trial.ground.texts_since(restarted_s) if "EKF sources" in t]
    figures.add_true("the source set is asked for anew", bool(texts), " / ".join(texts))


def _deceive(
    trial: Trial, figures: Figures, name: str, off_m: Callable[[float], float]
) -> float | None:
    """Move satellites north, by the time that it lasts; when the source set was switched."""
    before, began_s = manoeuvres.mean_place(trial), time.time()
    trial.mark(name)
    while (lasts_s := time.time() - began_s) < PULLED_S:
        trial.pilot.set_parameters({"SIM_GPS1_GLTCH_X": off_m(lasts_s) / DEGREE_M})
    said_s = _when_told(trial, began_s, "GPS drifts", "GPS position jump")
    switched_s = _when_told(trial, began_s, "EKF sources switched: no GPS")
    figures.add(f"{name}: said after", said_s, "s", SAID_S)
    figures.add(f"{name}: source set switched after", switched_s, "s", SAID_S + 1.0)
    level_m, down_m = strayed_m(trial.ground.window(began_s, time.time()), before)
    figures.add(f"{name}: moved, level", level_m.max(), "m", JUMP_M)
    figures.add(f"{name}: moved, height", down_m.max(), "m", JUMP_M)
    return switched_s


def earth_position(trial: Trial, figures: Figures) -> None:
    """Satellites go; the EKF is told where it is by our map. ArduPilot's reckons by flow beside."""
    if not up_by_gps(trial, figures):
        return
    trial.mark(f"global: {trial.status.get('global_position')}")
    before = manoeuvres.mean_place(trial)
    trial.pilot.lose_gps()
    if isinstance(trial.pilot, CopterPilot):
        trial.ground.command(SET_EKF_SOURCE_SET, 2.0)
    trial.mark("GPS goes")
    began_s = time.time()
    sent = trial.until("place on earth", lambda: trial.said("global position by"), 30.0)
    figures.add("place on earth by vision after", sent, "s", 10.0)
    time.sleep(30.0)
    level_m, _ = strayed_m(trial.ground.window(began_s, time.time()), before)
    figures.add("without satellites: moved, level", level_m.max(), "m", 3.0)
    off_m = _believed_off(trial, began_s + 10.0)
    figures.add("the EKF's place off, 95 %", percentile(off_m, 95), "m", 1.5)
    trial.mark(f"{trial.ground.mode}, global: {trial.status.get('global_position')}")
    trial.pilot.land()


def wall(trial: Trial, figures: Figures) -> None:
    """Towards a wall by the stick: the autopilot's own avoidance stops before it."""
    if not manoeuvres.up(trial, figures):
        return
    trial.pilot.stream(None)
    trial.mark(f"holds: {trial.pilot.set_mode(trial.pilot.holds_in)}")
    time.sleep(manoeuvres.SETTLE_S)
    if isinstance(trial.pilot, Px4Pilot):  # it does not fly into the unknown, and a hover sees none
        trial.mark("a little higher")
        trial.ground.sticks = lambda: Px4Pilot.higher
        time.sleep(HIGHER_S)
    trial.mark("stick forward")
    began_s = time.time()
    trial.ground.sticks = lambda: trial.pilot.forward
    trial.until("at rest", lambda: _at_rest(trial, began_s + 6.0), WALL_S)
    trial.pilot.hold_sticks(in_air=True)
    _add_clearance(trial, figures, began_s)
    trial.pilot.land()


def wall_around(trial: Trial, figures: Figures) -> None:
    """Told a place behind a wall: the autopilot's own planner finds a way round, or none."""
    if not manoeuvres.up(trial, figures):
        return
    manoeuvres.ready_to_go(trial)
    began_s, here = time.time(), trial.ground.believed_m
    behind = here + np.array([WALL_NORTH_M + BEHIND_M, 0.0, 0.0])
    trial.pilot.send_to(behind)

    def is_there() -> bool:
        return bool(np.linalg.norm((trial.ground.believed_m - behind)[:2]) < 1.0)

    trial.until("behind the wall", is_there, AROUND_S)
    _add_clearance(trial, figures, began_s)
    figures.add_true("came behind the wall", is_there())
    trial.pilot.land()


def _add_clearance(trial: Trial, figures: Figures, began_s: float) -> None:
    """Figures of how near the wall was since then."""
    path = trial.ground.window(began_s, time.time())
    (box,) = landmarks_of(trial.conditions.landmarks).walls()
    off = np.abs(path[:, :2] - [box.north, box.east]) - [box.half_north, box.half_east]
    clear_m = float(np.linalg.norm(np.maximum(off, 0.0), axis=1).min())
    nearest = trial.ground.latest.get("COMPANION/OBSTACLE_DISTANCE")
    told = f", told now {min(nearest.distances) / 100:.2f} m" if nearest else ""
    figures.add("flown towards the wall", float(path[:, 0].max() - path[0, 0]), "m")
    figures.add("nearer to the wall than 1.5 m by", max(0.0, CLEAR_M - clear_m), "m", 0.0,
                f"{clear_m:.2f} m clear{told}")  # fmt: skip


def _when_told(trial: Trial, since_s: float, *texts: str) -> float | None:
    """Seconds from a time on until a pilot has read one of them."""
    for when_s, said in trial.ground.texts:
        if when_s >= since_s and any(each in said for each in texts):
            return when_s - since_s
    return None


def _believed_off(trial: Trial, since_s: float) -> Array:
    """Level distance (N,) of the autopilot's place from the true one."""
    true = np.array([(each.t_s, *each.place_m[:2]) for each in trial.ground.true])
    told = np.array([row[:3] for row in trial.ground.believed if row[0] >= since_s])
    at = np.stack([np.interp(told[:, 0], true[:, 0], true[:, k]) for k in (1, 2)], axis=1)
    off_m: Array = np.linalg.norm(told[:, 1:] - at, axis=1)
    return off_m


def _at_rest(trial: Trial, not_before_s: float) -> bool:
    speed = float(np.linalg.norm(trial.ground.true[-1].velocity_m_s[:2]))
    return time.time() > not_before_s and speed < STOPPED_M_S


FEATURES: dict[str, tuple[Callable[[Trial, Figures], None], Conditions]] = {
    "landing_marker": (landing_marker, Conditions(
        pitch_deg=-80.0, landmarks="marker:{}:{}".format(*MARKER_AT),
        parameters={"PLND_ENABLED": 1, "PLND_TYPE": 1, "PLND_LAG": 0.06},
        settings=(f"landing.marker={FAMILY_WORD}", f"landing.id={MARKER_ID}",
                  f"landing.size_m={MARKER_M}"),
    )),
    "spoofed": (spoofed, Conditions(
        has_gps=True, parameters=OWN_SOURCES, settings=("gps.switch_source=true",),
    )),
    "earth_position": (earth_position, Conditions(
        has_gps=True, pose_mode="off",
        # no driver of poses, of which it would hear none: it could not be armed
        parameters={**OWN_SOURCES, "VISO_TYPE": 0, "EK3_SRC2_POSXY": 0, "EK3_SRC2_VELXY": 5,
                    "EK3_SRC2_VELZ": 0, "FLOW_TYPE": 5, "EK3_FLOW_DELAY": 60},
        settings=("feedback.global_position=estimate", "feedback.flow=optical_flow"),
    )),
    "earth_position_px4": (earth_position, Conditions(
        has_gps=True, pose_mode="velocity",
        parameters={"EKF2_EV_CTRL": 4, "EKF2_AGP0_ID": 10, "EKF2_AGP0_CTRL": 1,
                    "EKF2_AGP0_DELAY": 60},
        settings=("feedback.global_position=sensor",),
    )),
    "wall": (wall, BEFORE_A_WALL),
    "wall_px4": (wall, replace(BEFORE_A_WALL, pitch_deg=-12.0, parameters={
        "CP_DIST": 2.4, "MPC_VEL_MANUAL": 5,  # 1.5 m, and what docs/autopilots.md adds
    })),  # 12 degrees down it sees what must be free, as docs/autopilots.md tells
    "wall_around": (wall_around, replace(BEFORE_A_WALL, parameters={
        "PRX1_TYPE": 2, "PRX_FILT": 0, "AVOID_ENABLE": 0, "OA_TYPE": 1, "OA_BR_LOOKAHEAD": 8,
        "OA_MARGIN_MAX": 2.4, "WPNAV_SPEED": 250, "GUID_OPTIONS": 64,
    })),
    "wall_3d": (wall, replace(
        BEFORE_A_WALL, settings=(*BEFORE_A_WALL.settings, "feedback.obstacles_3d=true")
    )),
}  # fmt: skip
