"""Advice for each warning, and for each reason why no pose is sent."""

from __future__ import annotations

from collections.abc import Mapping

CABLE = "Check the cable and its plugs."
NOTHING = "Nothing to do."
ATTITUDE = (
    "The camera must be fixed to the frame, and [mount] must say how it sits. It is used again by "
    "itself once it fits."
)
CLOSE_OTHERS = "The others on this drone go on. Look at what that program sends."
SPOOFED = (
    "Leave modes that fly by GPS, or switch the EKF's sources: it may be spoofed. It is used again "
    "by itself once it agrees."
)
OF_WARNING: Mapping[str, str] = {
    "localisation has died: the flight ends, and another begins":
        "Fly by other means until the position is back, some seconds later.",
    "the autopilot's attitude is not the camera's and is not used": ATTITUDE,
    "camera does not turn with the body: attitude not used, no vision position": ATTITUDE,
    "camera mount disagrees with the autopilot's attitude: no vision position":
        "Correct the angles of [mount], or body_from_camera of the calibration, by what is said.",
    "camera turns with the body again: attitude used": NOTHING,
    "the gimbal's angles do not fit the camera: no vision position":
        "Centre the gimbal, or start it anew; its messages must say which axes its yaw is in.",
    "the gimbal's angles are not known: no vision position":
        "Have autopilot or gimbal send GIMBAL_DEVICE_ATTITUDE_STATUS; check the gimbal's plugs.",
    "the gimbal's angles fit the camera again": NOTHING,
    "the gimbal's angles are known again": NOTHING,
    "map tilted against the autopilot's attitude: begun anew":
        "Once after take-off: nothing to do. Again and again: the mount is stated wrong.",
    "the picture stands while the vehicle moves: map begun anew":
        "Land by other means; look for a cover, dirt on the lens, or a camera that is frozen.",
    "map resumed after restart": NOTHING,
    "located in the map of an earlier flight": NOTHING,
    "the map of an earlier flight is not used":
        "The flight goes on in its own map. See what is said of it; set or clear [map] use.",
    "the map of an earlier flight is not where satellites are":
        "Either it or the satellites are wrong: fly to no place on earth before that is clear.",
    "the map of an earlier flight was made with another camera":
        "Places are less exact in it. Make a map with this camera.",
    "the map of an earlier flight cannot be read":
        "companion map verify says what is wrong; set [map] use to another, or clear it.",
    "the map of an earlier flight is damaged":
        "What is whole is used. companion map verify says what is lost.",
    "old map not recognised: new map": "Climb or fly some metres, so that it gets its scale.",
    "the map cannot be kept for a restart in flight": "Make room on the disk.",
    "the disk takes no more of the map, which grows in memory":
        "Delete flights before the next: over new ground an hour takes some gigabytes.",
    "focal length looks wrong: calibrate the lens": "Calibrate the lens: Setup, Camera.",
    "camera and autopilot were found to disagree, corrected":
        "Put the angles that are said into the calibration, or into [mount].",
    "the autopilot's IMU is not used: no scale and no dead reckoning by it":
        "Without GPS, rangefinder or barometer there will be no position. See what is said of it.",
    "the autopilot's IMU is used again": NOTHING,
    "the autopilot's velocity contradicts its positions and is not used":
        "Check compass, and mount and lens of a flow sensor.",
    "the autopilot's velocity agrees with its positions again": NOTHING,
    "measured depths contradict the other scales: check baseline and calibration":
        "Calibrate both cameras anew, or the scale of the depth camera's depths.",
    "measured depths agree with the other scales again": NOTHING,
    "the ground passes too fast for the camera: tracking may fail":
        "Climb or slow down; a higher camera.rate_hz helps.",
    "too little contrast: tracking may fail":
        "More light, a clean lens, other ground; be ready to fly by other means.",
    "few points in view: tracking may fail":
        "Back to ground with structure; be ready to fly by other means.",
    "tracking is away from its limits again": NOTHING,
    "satellite positions jump and are not used": SPOOFED,
    "satellite positions drift away from vision and are not used": SPOOFED,
    "satellite height drifts away from vision and is not used": SPOOFED,
    "satellite positions stand still and are not used": SPOOFED,
    "satellite positions go another way than vision and are not used": SPOOFED,
    "no satellite positions any more": "Leave modes that fly by GPS. Look for what jams it.",
    "satellite positions are too inaccurate and are not used":
        "Leave modes that fly by GPS; give its antenna a free sky.",
    "satellite positions agree with vision again and are used": NOTHING,
    "vision failed after it had contradicted satellite positions: they are used": NOTHING,
    "the EKF's sources are switched to vision":
        "The vehicle flies without GPS (expert.gps.vision_set).",
    "the EKF's sources are switched to satellites": NOTHING,
    "the EKF's sources could not be switched":
        "Switch by hand. Only ArduPilot has source sets; see EK3_SRC2_POSXY and others.",
    "settings cannot be kept": "Make room on the disk; land before you rely on what was set.",
    "reset counter is not kept": "Make room on the disk; land before you rely on the position.",
    "dense map on another OpenCL device": "After the flight: look at that device's driver.",
    "dense map off: no OpenCL device": "Install an OpenCL driver (docs: OpenCL devices).",
    "the camera is not there": CABLE + " The step Camera in Set up lists the cameras found.",
    "the camera has gone": CABLE + " It is tried again all the time.",
    "the camera is back": NOTHING,
    "the camera is silent": CABLE + " It is opened anew.",
    "the camera is frozen": "It is opened anew. If it comes again: another camera or cable.",
    "pictures of another size are refused": "Another program has set another size: end it.",
    "pictures with wrong stamps are refused": "The driver stamps wrongly; another kernel may help.",
    "the camera does not do as asked": "Choose a size, rate or exposure that the camera can do.",
    "the camera's pictures have ended": "It is a file, and it is over.",
    "the camera's driver has a fault": "A bug of ours: please report what the journal has.",
    "autopilot found": NOTHING,
    "autopilot silent": CABLE + " Check the baud, and that TX and RX are crossed.",
    "autopilot heard again": NOTHING,
    "autopilot rebooted": "The position counts anew from here.",
    "another vehicle on the link": "Set expert.link.system_id to the vehicle that is ours.",
    "another companion on the link": "Switch one off, or set its feedback.mode to off.",
    "autopilot does not send a message": "See which one, and the rates in the autopilot.",
    "telemetry out of order": "The link mixes up its messages: use a cable.",
    "telemetry stamped wildly": "Such messages are left out. Update the autopilot's firmware.",
    "telemetry from the future": "Such messages are left out.",
    "telemetry late": "The link delays: raise its baud, or use a cable.",
    "telemetry that is not usable": "Impossible values are left out; see which sensor.",
    "damaged data on the autopilot's link":
        "A login console on the port, too high a baud, or too long a cable.",
    "a client of the router is refused": "It speaks as the autopilot or as us, or lacks the key.",
    "a client of the router sends more than the link takes": CLOSE_OTHERS,
    "a client of the router is too slow": CLOSE_OTHERS,
    "a client of the router sends damaged data": CLOSE_OTHERS,
    "more is asked of the companion over MAVLink than it answers": CLOSE_OTHERS,
    "a stage has died and is started again": "If it comes again: report what the journal has.",
    "a stage did not give its last results in time":
        "`companion replay` makes them of the recording.",
    "the disk is full: the flight is no longer recorded": "Delete flights.",
    "the recording cannot be written": "Check the disk: it is full, or broken.",
    "the folder of flights cannot be written": "Check the disk: it is full, or broken.",
    "the disk is too slow: parts of the flight are not recorded":
        "Use a faster disk, or recorder.codec = h264.",
    "an old flight was deleted": "Mark flights that must stay with Keep, or copy them away.",
    "an earlier recording was cut short": "It has been repaired; nothing to do.",
    "points were given up, as the disk does not take them": "Delete flights.",
    "no node elsewhere makes depth any more": "Look at the other machine, and the network to it.",
    "a node elsewhere makes the depth": NOTHING,
    "questions came over the network that cannot be read": "Another version is on the network.",
    "the autopilot is not asked for its IMU":
        "No scale by it and no dead reckoning. If the link is too slow: raise its baud.",
    "the autopilot's IMU is asked for less often": "The link is too slow: raise its baud.",
    "looks like a rolling shutter: set camera.readout_ms": "Set camera.readout_ms as is said.",
    "the rolling shutter looks slower or faster than camera.readout_ms":
        "Correct camera.readout_ms as is said.",
    "rolling shutter is undone by the rotation between images alone":
        "With the autopilot's IMU it is undone better: see its stream rates.",
    "the flight can be seen": NOTHING,
    "the viewer cannot be shown": "See what is said; nothing else depends on it.",
    "the viewer has gone": "It is opened again; nothing else depends on it.",
    "the viewer does not keep up": "It lacks some of what there is; nothing else depends on it.",
    "viewers cannot connect": "Another program has the port: change stream.listen.",
    "recordings that were cut short cannot be looked for now": "Check the disk.",
}  # fmt: skip
OTHER = "The journal has more: journalctl -u companion."
OF_REASON: Mapping[str, str] = {
    "no pose yet": "Nothing has been tracked yet. Take off the lens cover.",
    "initialising": "The map is being begun: move some metres sideways over structure.",
    "lost": "Nothing is recognised: too dark, too fast, or blank ground. Move back, slowly.",
    "no metric scale": "Climb or fly some metres, so that the scale is found.",
    "IMU being checked": "Leave it standing for ten seconds after power-on.",
    "position too uncertain": "Above expert.feedback.max_sigma_m: move, so that more is seen.",
    "scale too uncertain": "Fly some metres; start, stop and turn.",
    "quality too low": "Too little is recognised: more light, more structure, a sharper lens.",
    "tilt differs from the autopilot's": "The mount is stated wrong, or the camera is not fixed.",
    "poses come too late": "The computer has too much to do: depth.enabled = false, cooling.",
    "no frames": "No pictures come: see the camera.",
    "localisation begins anew": "Wait some seconds.",
    "waiting for proof": "Wait: poses must be good for expert.feedback.resume_after_s first.",
    "the autopilot is silent": "Nothing is heard of the autopilot: cable, baud.",
    "no autopilot attitude": "The autopilot sends no attitude: see its stream rates.",
    "attitude is not believed": "telemetry.use leaves out attitude.",
    "camera mount is not known": "Say how the camera sits on the vehicle: Setup, or [mount].",
    "no autopilot height": "The autopilot sends no height: see its stream rates.",
    "position reset": "Wait a second: poses must be good for a while first.",
    "no autopilot clock": "Wait some seconds: the clocks are being compared.",
    "another companion on the link": "Switch one of the two off.",
    "the link is too slow": "Raise the baud of the autopilot's port and of link.url.",
    "disk is slow": "Wait; then look at the disk.",
    "autopilot rebooted": "Wait some seconds.",
    "off": "feedback.mode is off: switch it on in Settings.",
    "switched off": "The ground station has switched it off.",
}
"""By the reasons of `companion.pilot_messages.REASONS`."""


def remedy(what: str) -> str:
    """Advice for a kind of warning."""
    return OF_WARNING.get(what, OTHER)
