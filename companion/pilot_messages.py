"""Texts for the pilot: one table, explained row by row in docs/pilot_messages.md.

A STATUSTEXT holds 50 bytes, and longer ones are cut or come in pieces, of which one may be lost. So
each text fits into one message, in unambiguous words of aviation. A `Warned` becomes one of these
texts, or stays in the journal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

PREFIX = "Companion: "
WARNING, NOTICE, INFO = 4, 5, 6
"""Values of MAV_SEVERITY."""
OTHER_VALUE = "?"
LONGEST_NAME, LONGEST_NUMBER, LONGEST_REASON = 16, 10, 17
"""Characters of a parameter's name, of a number, and of a reason."""


@dataclass(frozen=True, slots=True)
class PilotText:
    """One STATUSTEXT. Only `PilotMessage` makes them."""

    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class PilotMessage:
    """A row: a text with named gaps, and the longest value of each, characters."""

    severity: int
    text: str
    longest: Mapping[str, int] = field(default_factory=dict)

    def __call__(self, **values: str) -> PilotText:
        """The text with its values; too long ones are cut, and a ? replaces what is not ASCII."""
        fitting = {
            name: values.get(name, OTHER_VALUE).encode("ascii", "replace").decode("ascii")[:most]
            for name, most in self.longest.items()
        }
        return PilotText(self.severity, PREFIX + self.text.format(**fitting))


# -- vision position -----------------------------------------------------------------

POSITION_ON = PilotMessage(INFO, "vision position on")
POSITION_LOST = PilotMessage(WARNING, "vision position lost: {reason}", {"reason": LONGEST_REASON})
POSITION_NONE = PilotMessage(WARNING, "no vision position: {reason}", {"reason": LONGEST_REASON})
DEAD_RECKONING = PilotMessage(WARNING, "position by dead reckoning")
POSITION_OFF = PilotMessage(NOTICE, "vision position off: ground command")
POSITION_STAYS_OFF = PilotMessage(WARNING, "vision position still off: by ground")
POSITION_ENABLED = PilotMessage(NOTICE, "vision position enabled: disarmed")
LIMITS_WAIT = PilotMessage(NOTICE, "looser limits wait for disarming")
SETTINGS_NOT_SAVED = PilotMessage(WARNING, "disk error: settings not saved")
GLOBAL_ON = PilotMessage(WARNING, "global position by vision: no GPS")
GLOBAL_OFF = PilotMessage(NOTICE, "global position by vision off")
TRACKING_FAILED = PilotMessage(WARNING, "visual tracking failed: restarting")
ATTITUDE_MISMATCH = PilotMessage(WARNING, "attitude mismatch: no vision position")
ATTITUDE_USED = PilotMessage(INFO, "attitude matches again")
GIMBAL_MISMATCH = PilotMessage(WARNING, "gimbal mismatch: no vision position")
GIMBAL_SILENT = PilotMessage(WARNING, "gimbal silent: no vision position")
GIMBAL_USED = PilotMessage(INFO, "gimbal angles used again")
MAP_TILTED = PilotMessage(WARNING, "map tilted: restarting")
PICTURE_STANDS = PilotMessage(WARNING, "camera picture stands: restarting")
MAP_RESUMED = PilotMessage(NOTICE, "map resumed after restart")
MAP_NOT_RESUMED = PilotMessage(NOTICE, "old map not recognised: new map")
MAP_NOT_SAVED = PilotMessage(NOTICE, "map not saved for a restart")
MAP_IN_MEMORY = PilotMessage(NOTICE, "disk full: map grows in memory")
SITE_LOCATED = PilotMessage(INFO, "located in the saved map")
SITE_REFUSED = PilotMessage(WARNING, "saved map contradicted: not used")
SITE_MISPLACED = PilotMessage(WARNING, "saved map contradicted: place not used")
SITE_OTHER_CAMERA = PilotMessage(NOTICE, "saved map is of another camera")
SITE_UNREADABLE = PilotMessage(WARNING, "saved map cannot be read: not used")
SITE_DAMAGED = PilotMessage(NOTICE, "saved map damaged: used in part")
OTHER_LENS = PilotMessage(WARNING, "focal length looks wrong: calibrate")
SETUP_UNPROVEN = PilotMessage(WARNING, "{what} unproven: turn it by hand", {"what": 11})
MOUNT_CORRECTED = PilotMessage(NOTICE, "camera mount angle corrected")
IMU_NOT_USED = PilotMessage(NOTICE, "autopilot IMU data not used")
IMU_USED = PilotMessage(INFO, "autopilot IMU data used again")
VELOCITY_NOT_USED = PilotMessage(NOTICE, "autopilot velocity not used")
VELOCITY_USED = PilotMessage(INFO, "autopilot velocity used again")
LIMIT_FAST = PilotMessage(WARNING, "vision near limit: too low or fast")
LIMIT_FAINT = PilotMessage(WARNING, "vision near limit: low contrast")
LIMIT_FEW = PilotMessage(WARNING, "vision near limit: little structure")
LIMIT_AWAY = PilotMessage(INFO, "vision away from its limits")

# -- satellites -----------------------------------------------------------------

GPS_JUMP = PilotMessage(WARNING, "GPS position jump: not used")
GPS_PULL = PilotMessage(WARNING, "GPS drifts from vision: not used")
GPS_HEIGHT = PilotMessage(WARNING, "GPS height drifts: not used")
GPS_STANDS = PilotMessage(WARNING, "GPS position frozen: not used")
GPS_TURNED = PilotMessage(WARNING, "GPS track wrong: not used")
GPS_GONE = PilotMessage(WARNING, "GPS lost or jammed")
GPS_POOR = PilotMessage(WARNING, "GPS accuracy poor: not used")
GPS_AGAIN = PilotMessage(INFO, "GPS agrees with vision: used again")
GPS_WITHDRAWN = PilotMessage(NOTICE, "vision was wrong, not GPS: used again")
SOURCE_VISION = PilotMessage(WARNING, "EKF sources switched: no GPS")
SOURCE_SATELLITES = PilotMessage(NOTICE, "EKF sources switched: GPS again")
SOURCE_NOT = PilotMessage(WARNING, "EKF sources not switched, see its log")

# -- landing marker -----------------------------------------------------------------

MARKER_SEEN = PilotMessage(INFO, "landing marker in sight")
MARKER_LOST = PilotMessage(NOTICE, "landing marker lost")

# -- obstacles -----------------------------------------------------------------

OBSTACLES_KNOWN = PilotMessage(INFO, "obstacles in view are reported")
OBSTACLES_UNKNOWN = PilotMessage(WARNING, "obstacles unknown: none is reported")
OBSTACLES_NEVER_FREE = PilotMessage(WARNING, "no sector can be free: check the mount")

# -- camera and autopilot -----------------------------------------------------------------

CAMERA_NOT_FOUND = PilotMessage(WARNING, "camera not found")
CAMERA_LOST = PilotMessage(WARNING, "camera lost")
CAMERA_RECOVERED = PilotMessage(INFO, "camera recovered")
CAMERA_NO_VIDEO = PilotMessage(WARNING, "camera sends no video")
CAMERA_FROZEN = PilotMessage(WARNING, "camera image frozen")
CAMERA_SIZE = PilotMessage(WARNING, "camera image size wrong")
CAMERA_TIME = PilotMessage(WARNING, "camera time stamps wrong")
CAMERA_SETTINGS = PilotMessage(NOTICE, "camera settings not accepted")
CAMERA_ENDED = PilotMessage(WARNING, "video file ended")
CAMERA_FAULT = PilotMessage(WARNING, "camera driver fault")
AUTOPILOT_CONNECTED = PilotMessage(INFO, "autopilot connected")
AUTOPILOT_LOST = PilotMessage(WARNING, "autopilot link lost")
AUTOPILOT_RECOVERED = PilotMessage(INFO, "autopilot link recovered")
AUTOPILOT_REBOOT = PilotMessage(WARNING, "autopilot reboot detected")
SECOND_VEHICLE = PilotMessage(NOTICE, "second vehicle on link ignored")
SECOND_COMPANION = PilotMessage(WARNING, "second companion on link")
NO_SUCH_TELEMETRY = PilotMessage(NOTICE, "autopilot lacks a telemetry message")
TELEMETRY_ORDER = PilotMessage(WARNING, "telemetry out of order")
TELEMETRY_TIME = PilotMessage(WARNING, "telemetry time stamps wrong")
TELEMETRY_LATE = PilotMessage(WARNING, "telemetry late")
TELEMETRY_INVALID = PilotMessage(WARNING, "telemetry values invalid")
LINK_ERRORS = PilotMessage(WARNING, "telemetry link errors")
CLIENT_REFUSED = PilotMessage(NOTICE, "ground link client refused")
CLIENT_OVERLOAD = PilotMessage(NOTICE, "ground link client sends too much")
CLIENT_SLOW = PilotMessage(NOTICE, "ground link client too slow")
CLIENT_ERRORS = PilotMessage(NOTICE, "ground link client sends errors")

# -- map and recording -----------------------------------------------------------------

PART_RESTARTED = PilotMessage(NOTICE, "{part} restarted", {"part": 16})
MAP_OTHER_DEVICE = PilotMessage(NOTICE, "dense map on another processor")
MAP_NO_DEVICE = PilotMessage(NOTICE, "dense map off: no working processor")
RESULTS_INCOMPLETE = PilotMessage(NOTICE, "flight results incomplete")
DISK_FULL = PilotMessage(WARNING, "disk full: recording stopped")
RECORDING_FAILED = PilotMessage(WARNING, "recording failed")
RECORDING_INCOMPLETE = PilotMessage(NOTICE, "disk slow: recording incomplete")
RECORDING_DELETED = PilotMessage(NOTICE, "disk full: oldest recording deleted")
RECORDING_REPAIRED = PilotMessage(INFO, "earlier recording repaired")
MAP_INCOMPLETE = PilotMessage(NOTICE, "disk full: dense map incomplete")
REMOTE_MAP_LOST = PilotMessage(NOTICE, "remote dense map computer lost")

# -- answers to the ground -----------------------------------------------------------------

NAME = {"name": LONGEST_NAME}
PARAMETER_SET = PilotMessage(INFO, "{name}: {value}", {**NAME, "value": 20})
PARAMETER_NEXT_MAP = PilotMessage(
    INFO, "{name}: {value} (next map)", {**NAME, "value": LONGEST_NUMBER}
)
REFUSED_ARMED = PilotMessage(NOTICE, "{name} refused: armed", NAME)
REFUSED_VALUE = PilotMessage(NOTICE, "{name} refused: out of range", NAME)
REFUSED_OFTEN = PilotMessage(NOTICE, "{name} refused: too often", NAME)
REFUSED_ELSEWHERE = PilotMessage(NOTICE, "{name} refused: not made here", NAME)
NEW_MAP = PilotMessage(NOTICE, "new map: vision position restarts")
NEW_MAP_NO_MAP = PilotMessage(NOTICE, "new map refused: no map yet")
NEW_MAP_ARMED = PilotMessage(NOTICE, "new map refused: armed, position in use")
CLOUD_SAVED = PilotMessage(INFO, "point cloud saved: {n} points", {"n": LONGEST_NUMBER})
CLOUD_NO_MAP = PilotMessage(NOTICE, "point cloud refused: no map yet")
CLOUD_NOT_SAVED = PilotMessage(NOTICE, "point cloud not saved, see its log")
WAY_BACK = PilotMessage(INFO, "way back: {n} waypoints", {"n": LONGEST_NUMBER})
NO_WAY_BACK = PilotMessage(NOTICE, "no way back: no path has a place yet")
RECORDING_GOES_ON = PilotMessage(NOTICE, "recording ends with the flight only")
RECORDING_SET_OFF = PilotMessage(NOTICE, "not recorded: recorder.enabled is false")
RECORDING_NO_FLIGHT = PilotMessage(NOTICE, "not recorded: no flight goes on")
GROUND_TOO_OFTEN = PilotMessage(NOTICE, "too many ground requests")

# -- of messages themselves -----------------------------------------------------------------

LEFT_OUT = PilotMessage(NOTICE, "{n} messages left out, see its log", {"n": 3})
OTHER = PilotMessage(NOTICE, "warning, see its log")
"""Text of a warning without a row of its own."""

REASONS: Mapping[str, str] = {
    "no pose yet": "no position yet",
    "initialising": "map starting",
    "lost": "tracking lost",
    "no metric scale": "no scale",
    "IMU being checked": "IMU being checked",
    "position too uncertain": "uncertain",
    "scale too uncertain": "scale uncertain",
    "quality too low": "low quality",
    "tilt differs from the autopilot's": "attitude mismatch",
    "poses come too late": "too late",
    "no frames": "no video",
    "localisation begins anew": "restarting",
    "waiting for proof": "being checked",
    "the autopilot is silent": "autopilot silent",
    "no autopilot attitude": "no attitude",
    "attitude is not believed": "attitude not used",
    "no autopilot height": "no height",
    "camera mount is not known": "no camera mount",
    "position reset": "position reset",
    "no autopilot clock": "no clock",
    "another companion on the link": "second companion",
    "the link is too slow": "link too slow",
    "disk is slow": "disk slow",
    "autopilot rebooted": "autopilot reboot",
}
"""Texts by the reason for which no pose is sent, see `estimation.gate`, `daemon.pose`."""
OTHER_REASON = "see its log"
SWITCHED_OFF = ("off", "switched off")
"""Reasons for which the pilot or the ground has switched poses off: not reported as a loss."""
PARTS: Mapping[str, str] = {
    "depth": "dense map", "recorder": "recording", "results": "results",
    "topics": "remote map link", "landing": "landing marker",
}  # fmt: skip

OF_WARNING: Mapping[str, PilotMessage] = {
    "located in the map of an earlier flight": SITE_LOCATED,
    "the map of an earlier flight is not used": SITE_REFUSED,
    "the map of an earlier flight is not where satellites are": SITE_MISPLACED,
    "the map of an earlier flight was made with another camera": SITE_OTHER_CAMERA,
    "the map of an earlier flight cannot be read": SITE_UNREADABLE,
    "the map of an earlier flight is damaged": SITE_DAMAGED,
    "localisation has died: the flight ends, and another begins": TRACKING_FAILED,
    "the autopilot's attitude is not the camera's and is not used": ATTITUDE_MISMATCH,
    "camera does not turn with the body: attitude not used, no vision position": ATTITUDE_MISMATCH,
    "camera mount disagrees with the autopilot's attitude: no vision position": ATTITUDE_MISMATCH,
    "camera turns with the body again: attitude used": ATTITUDE_USED,
    "the gimbal's angles do not fit the camera: no vision position": GIMBAL_MISMATCH,
    "the gimbal's angles are not known: no vision position": GIMBAL_SILENT,
    "the gimbal's angles fit the camera again": GIMBAL_USED,
    "the gimbal's angles are known again": GIMBAL_USED,
    "map tilted against the autopilot's attitude: begun anew": MAP_TILTED,
    "the picture stands while the vehicle moves: map begun anew": PICTURE_STANDS,
    "map resumed after restart": MAP_RESUMED,
    "old map not recognised: new map": MAP_NOT_RESUMED,
    "the map cannot be kept for a restart in flight": MAP_NOT_SAVED,
    "the disk takes no more of the map, which grows in memory": MAP_IN_MEMORY,
    "camera and autopilot were found to disagree, corrected": MOUNT_CORRECTED,
    "focal length looks wrong: calibrate the lens": OTHER_LENS,
    "the autopilot's IMU is not used: no scale and no dead reckoning by it": IMU_NOT_USED,
    "the autopilot's IMU is used again": IMU_USED,
    "the autopilot's velocity contradicts its positions and is not used": VELOCITY_NOT_USED,
    "the autopilot's velocity agrees with its positions again": VELOCITY_USED,
    "the ground passes too fast for the camera: tracking may fail": LIMIT_FAST,
    "too little contrast: tracking may fail": LIMIT_FAINT,
    "few points in view: tracking may fail": LIMIT_FEW,
    "tracking is away from its limits again": LIMIT_AWAY,
    "satellite positions jump and are not used": GPS_JUMP,
    "satellite positions drift away from vision and are not used": GPS_PULL,
    "satellite height drifts away from vision and is not used": GPS_HEIGHT,
    "satellite positions stand still and are not used": GPS_STANDS,
    "satellite positions go another way than vision and are not used": GPS_TURNED,
    "no satellite positions any more": GPS_GONE,
    "satellite positions are too inaccurate and are not used": GPS_POOR,
    "satellite positions agree with vision again and are used": GPS_AGAIN,
    "vision failed after it had contradicted satellite positions: they are used": GPS_WITHDRAWN,
    "the EKF's sources are switched to vision": SOURCE_VISION,
    "the EKF's sources are switched to satellites": SOURCE_SATELLITES,
    "the EKF's sources could not be switched": SOURCE_NOT,
    "settings cannot be kept": SETTINGS_NOT_SAVED,
    "reset counter is not kept": SETTINGS_NOT_SAVED,
    "dense map on another OpenCL device": MAP_OTHER_DEVICE,
    "dense map off: no OpenCL device": MAP_NO_DEVICE,
    "the camera is not there": CAMERA_NOT_FOUND,
    "the camera has gone": CAMERA_LOST,
    "the camera is back": CAMERA_RECOVERED,
    "the camera is silent": CAMERA_NO_VIDEO,
    "the camera is frozen": CAMERA_FROZEN,
    "pictures of another size are refused": CAMERA_SIZE,
    "pictures with wrong stamps are refused": CAMERA_TIME,
    "the camera does not do as asked": CAMERA_SETTINGS,
    "the camera's pictures have ended": CAMERA_ENDED,
    "the camera's driver has a fault": CAMERA_FAULT,
    "autopilot found": AUTOPILOT_CONNECTED,
    "autopilot silent": AUTOPILOT_LOST,
    "autopilot heard again": AUTOPILOT_RECOVERED,
    "autopilot rebooted": AUTOPILOT_REBOOT,
    "another vehicle on the link": SECOND_VEHICLE,
    "another companion on the link": SECOND_COMPANION,
    "autopilot does not send a message": NO_SUCH_TELEMETRY,
    "telemetry out of order": TELEMETRY_ORDER,
    "telemetry stamped wildly": TELEMETRY_TIME,
    "telemetry from the future": TELEMETRY_TIME,
    "telemetry late": TELEMETRY_LATE,
    "telemetry that is not usable": TELEMETRY_INVALID,
    "damaged data on the autopilot's link": LINK_ERRORS,
    "a client of the router is refused": CLIENT_REFUSED,
    "a client of the router sends more than the link takes": CLIENT_OVERLOAD,
    "a client of the router is too slow": CLIENT_SLOW,
    "a client of the router sends damaged data": CLIENT_ERRORS,
    "more is asked of the companion over MAVLink than it answers": GROUND_TOO_OFTEN,
    "a stage has died and is started again": PART_RESTARTED,
    "a stage did not give its last results in time": RESULTS_INCOMPLETE,
    "the disk is full: the flight is no longer recorded": DISK_FULL,
    "the recording cannot be written": RECORDING_FAILED,
    "the folder of flights cannot be written": RECORDING_FAILED,
    "the disk is too slow: parts of the flight are not recorded": RECORDING_INCOMPLETE,
    "an old flight was deleted": RECORDING_DELETED,
    "an earlier recording was cut short": RECORDING_REPAIRED,
    "points were given up, as the disk does not take them": MAP_INCOMPLETE,
    "no node elsewhere makes depth any more": REMOTE_MAP_LOST,
}
"""Message for the pilot by the kind (`what`) of a `Warned`."""
JOURNAL_ONLY = frozenset({
    "a node elsewhere makes the depth", "questions came over the network that cannot be read",
    "the autopilot is not asked for its IMU", "the autopilot's IMU is asked for less often",
    "the flight can be seen", "the viewer cannot be shown", "the viewer has gone",
    "the viewer does not keep up", "viewers cannot connect",
    "recordings that were cut short cannot be looked for now",
    "rolling shutter is undone by the rotation between images alone",
    "looks like a rolling shutter: set camera.readout_ms",
    "the rolling shutter looks slower or faster than camera.readout_ms",
    "measured depths contradict the other scales: check baseline and calibration",
    "measured depths agree with the other scales again",
    "camera turns with the body as its mount says", "turns look as the focal length says",
})  # fmt: skip
"""Kinds of `Warned` that do not concern a pilot."""


def of_warning(what: str, detail: str = "", good: bool = False) -> PilotText | None:
    """Text for the pilot about a `Warned`; None without one."""
    if what in JOURNAL_ONLY:
        return None
    message = OF_WARNING.get(what)
    if message is None:
        return None if good else OTHER()
    if message is PART_RESTARTED:
        return message(part=PARTS.get(detail.split(":")[0], "a process"))
    return message()


def no_position(why_not: str) -> PilotText:
    """Text for poses that do not begin, by the same reasons."""
    return POSITION_NONE(reason=REASONS.get(why_not, OTHER_REASON))


def position_lost(why_not: str) -> PilotText:
    """Text for the end of poses, by a reason of `companion.estimation.gate`."""
    if why_not in SWITCHED_OFF:
        return POSITION_OFF()
    return POSITION_LOST(reason=REASONS.get(why_not, OTHER_REASON))
