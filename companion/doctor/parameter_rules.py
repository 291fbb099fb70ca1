"""Parameter rules per firmware, for the pose as we send it.

That is the pose of the body, in metres, stamped at exposure, with covariances and a quality.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from companion.config import FeedbackConfig, GpsConfig, LandingConfig
from companion.doctor.wanted import ARDUPILOT, PX4, Between, Bits, Near, OneOf, Values, Wanted

DELAY_TOLERANCE_MS = 15.0
MAX_VISO_DELAY_MS = 250.0
LEAST_LAG_S, MOST_LAG_S = 0.02, 0.25
"""Range of PLND_LAG."""
SOURCE_SETS = 1, 2, 3
LEAST_NOISE = 0.05
"""Metres, and m/s: as much as a pose states over known ground."""
VELOCITY = "velocity"
"""Mode that sends no position."""


@dataclass(frozen=True, slots=True)
class Context:
    """Context of the rules. `latency_ms`: from exposure to sending, None where not measured."""

    feedback: FeedbackConfig
    mode: str
    latency_ms: float | None
    gps: GpsConfig = field(default_factory=GpsConfig)
    landing: LandingConfig = field(default_factory=LandingConfig)

    @property
    def vision_set(self) -> int:
        """Source set of ArduPilot's EKF that takes our pose."""
        return self.gps.vision_set if self.gps.switch_source else 1

    def takes_position(self, number: int) -> bool:
        """True if the source set of that number takes our position."""
        return self.vision_set == number and self.mode != VELOCITY


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule. `lacking` is the consequence of a missing parameter; "" for none."""

    name: str
    wanted: Callable[[Context, Values], Wanted | None]
    why: str
    reboot: bool = False
    lacking: str = ""


def _always(wanted: Wanted) -> Callable[[Context, Values], Wanted]:
    return lambda context, values: wanted


def _same_as(other: str) -> Callable[[Context, Values], Wanted]:
    return lambda context, values: Near(values.get(other, 0.0), 0.005)


def _quality(context: Context, values: Values) -> Wanted:
    return Between(0, context.feedback.min_quality)


def _needs_compass(context: Context, values: Values) -> Wanted | None:
    compass = values.get(f"EK3_SRC{context.vision_set}_YAW") == 1
    return OneOf((1,)) if compass else None


def _viso_delay(context: Context, values: Values) -> Wanted | None:
    if context.latency_ms is None:
        return None
    latency_ms = min(round(context.latency_ms), MAX_VISO_DELAY_MS)
    return Near(latency_ms, DELAY_TOLERANCE_MS)


def _for_obstacles(wanted: Wanted) -> Callable[[Context, Values], Wanted | None]:
    """The condition where obstacles are sent."""
    return lambda context, values: wanted if context.feedback.obstacle_distance else None


def _from_pose(number: int, wanted: Wanted) -> Callable[[Context, Values], Wanted | None]:
    """The condition where the source set of that number takes our pose, position and all."""
    return lambda context, values: wanted if context.takes_position(number) else None


def _velocity(number: int) -> Callable[[Context, Values], Wanted | None]:
    """Our velocity, which alone must be taken where nothing else is sent."""

    def wanted(context: Context, values: Values) -> Wanted | None:
        if context.vision_set != number:
            return None
        return OneOf((6,)) if context.mode == VELOCITY else OneOf((6, 0))

    return wanted


def _position(number: int) -> Callable[[Context, Values], Wanted | None]:
    """Our position, or that of satellites in the set that the EKF is switched back to."""

    def wanted(context: Context, values: Values) -> Wanted | None:
        if context.takes_position(number):
            return OneOf((6,))
        back = context.gps.switch_source and context.gps.satellites_set == number
        return OneOf((3,)) if back else None

    return wanted


def _landing(wanted: Wanted) -> Callable[[Context, Values], Wanted | None]:
    """The condition where a marker is looked for."""
    return lambda context, values: wanted if context.landing.marker != "off" else None


def _landing_lag(context: Context, values: Values) -> Wanted | None:
    if context.landing.marker == "off" or context.latency_ms is None:
        return None
    lag_s = min(max(1e-3 * context.latency_ms, LEAST_LAG_S), MOST_LAG_S)
    return Near(round(lag_s, 3), 1e-3 * DELAY_TOLERANCE_MS)


def _for_flow(message: str, wanted: Wanted) -> Callable[[Context, Values], Wanted | None]:
    """The condition where that message of optical flow is sent."""
    return lambda context, values: wanted if context.feedback.flow == message else None


def _for_place(wanted: Wanted) -> Callable[[Context, Values], Wanted | None]:
    """The condition where the place on earth is sent as one more sensor."""
    return lambda context, values: wanted if context.feedback.global_position == "sensor" else None


def _place_delay(context: Context, values: Values) -> Wanted | None:
    if context.feedback.global_position != "sensor" or context.latency_ms is None:
        return None
    return Near(round(context.latency_ms), DELAY_TOLERANCE_MS)


def fused(context: Context, values: Values) -> Wanted:
    """Pose components that EKF2 is to fuse."""
    if context.mode == VELOCITY:
        return Bits(0b100, "2 (velocity)")
    if context.mode == "odometry":
        return Bits(0b111, "0, 1 and 2 (horizontal position, vertical position, velocity)")
    return Bits(0b011, "0 and 1 (horizontal and vertical position)")


def _least_noise(but: str) -> Callable[[Context, Values], Wanted | None]:
    """The condition on what a measurement is taken to be off by at least, but in one mode."""
    return lambda context, values: Between(0.01, LEAST_NOISE) if context.mode != but else None


def _height(context: Context, values: Values) -> Wanted | None:
    return OneOf((3, 0, 2)) if context.mode != VELOCITY else None


def _without_gps(context: Context, values: Values) -> Wanted | None:
    return OneOf((1, 2)) if context.mode != VELOCITY else None


def _fused_before_1_14(context: Context, values: Values) -> Wanted:
    if context.mode == VELOCITY:
        return Bits(256, "8 (vision velocity)")
    if context.mode == "odometry":
        return Bits(8 | 256, "3 and 8 (vision position and velocity)")
    return Bits(8, "3 (vision position)")


def _delay_max(context: Context, values: Values) -> Wanted | None:
    if context.latency_ms is None:
        return None
    return Between(round(context.latency_ms + DELAY_TOLERANCE_MS), 1000)


OUR_BODY = (
    "the pose that we send is that of the body already, not the camera's: another offset would be "
    "taken off twice"
)

FLOW_IN_BODY = "our flow is about the body's axes, whatever way the camera looks"


def _source_set(number: int) -> tuple[Rule, ...]:
    """Rules of one of the source sets of ArduPilot's EKF."""
    name = f"EK3_SRC{number}_"
    return (
        Rule(name + "POSXY", _position(number), "6 takes the horizontal position from our pose, 3 "
             "from satellites, which gps.switch_source goes back to",
             lacking="ArduPilot before 4.1; it cannot be told to use vision beside a GPS"
             if number == 1 else ""),
        Rule(name + "VELXY", _velocity(number), "6 takes the velocity that we "
             "send; 3 waits for a GPS"),
        Rule(name + "POSZ", _from_pose(number, OneOf((1, 6))), "1 is the barometer, 6 our height; "
             "3 waits for a GPS"),
        Rule(name + "VELZ", _from_pose(number, OneOf((6, 0))), "6 takes the vertical velocity that "
             "we send; 3 waits for a GPS"),
        Rule(name + "YAW", _from_pose(number, OneOf((1, 6))), "1 is the compass, which is best, "
             "since our heading comes from the autopilot's own; 6 is ours"),
    )  # fmt: skip


OUR_TARGET = "the marker that we send is told from the body, whatever way the camera looks"

ARDUPILOT_RULES = (
    Rule(
        "VISO_TYPE", _always(OneOf((1,))), "1 (MAVLink) takes our pose as it is; 0 takes none, 2 "
        "ignores it for 1 s after a reset, and 3 (VOXL) moves our pose to zero by resets of its "
        "own: flown in ArduPilot's simulator, vehicles jumped by metres or fell with it",
        reboot=True,
        lacking="this firmware was built without visual odometry (HAL_VISUALODOM_ENABLED); boards "
        "with 1 MB of flash lack it",
    ),
    Rule("EK3_ENABLE", _always(OneOf((1,))), "only EKF3 takes a position from vision", reboot=True,
         lacking="only EKF3 takes a position from vision, and this firmware has none"),
    Rule("AHRS_EKF_TYPE", _always(OneOf((3,))), "the vehicle flies on what this EKF says"),
    *(rule for number in SOURCE_SETS for rule in _source_set(number)),
    Rule("COMPASS_ENABLE", _needs_compass, "EK3_SRC1_YAW takes the heading from the compass"),
    Rule("VISO_ORIENT", _always(OneOf((0,))), OUR_BODY),
    Rule("VISO_SCALE", _always(Near(1.0, 1e-3)), "our pose is in metres"),
    Rule("VISO_POS_X", _same_as("INS_POS1_X"), OUR_BODY),
    Rule("VISO_POS_Y", _same_as("INS_POS1_Y"), OUR_BODY),
    Rule("VISO_POS_Z", _same_as("INS_POS1_Z"), OUR_BODY),
    Rule("VISO_QUAL_MIN", _quality, "above expert.feedback.min_quality our poses would be ignored; "
         "-1 would take lost ones"),
    Rule("VISO_DELAY_MS", _viso_delay, "the time from exposure to sending, as measured; ArduPilot "
         "counts from arrival"),
    Rule("PRX1_TYPE", _for_obstacles(OneOf((2,))), "2 takes OBSTACLE_DISTANCE, which "
         "feedback.obstacle_distance sends", reboot=True),
    Rule("PRX_FILT", _for_obstacles(OneOf((0,))), "the low pass of 0.25 Hz makes distances 0.6 s "
         "late: 2 m at 3 m/s; ours are of the newest image, 0 takes them as they are"),
    Rule("PLND_ENABLED", _landing(OneOf((1,))), "1 lands on the marker that we send",
         reboot=True),
    Rule("PLND_TYPE", _landing(OneOf((1,))), "1 (MAVLink) takes LANDING_TARGET", reboot=True),
    Rule("PLND_ORIENT", _landing(OneOf((25,))), OUR_TARGET, reboot=True),
    Rule("PLND_YAW_ALIGN", _landing(OneOf((0,))), OUR_TARGET),
    Rule("PLND_CAM_POS_X", _landing(Near(0.0, 0.005)), OUR_TARGET),
    Rule("PLND_CAM_POS_Y", _landing(Near(0.0, 0.005)), OUR_TARGET),
    Rule("PLND_CAM_POS_Z", _landing(Near(0.0, 0.005)), OUR_TARGET),
    Rule("PLND_LAG", _landing_lag, "the time from exposure to sending, as measured: the vehicle's "
         "own motion since then is taken off by it", reboot=True),
    Rule("FLOW_TYPE", _for_flow("optical_flow", OneOf((5,))), "5 (MAVLink) takes OPTICAL_FLOW, "
         "which feedback.flow sends", reboot=True),
    Rule("FLOW_ORIENT_YAW", _for_flow("optical_flow", OneOf((0,))), FLOW_IN_BODY),
    Rule("FLOW_OPTIONS", _for_flow("optical_flow", OneOf((0,))), "the body's rotation is in our "
         "flow; 1 (stabilised) would take it for motion"),
)  # fmt: skip

PX4_RULES = (
    Rule("SYS_MC_EST_GROUP", _always(OneOf((2,))), "only EKF2 takes our pose", reboot=True),
    Rule("EKF2_EN", _always(OneOf((1,))), "only EKF2 takes our pose", reboot=True),
    Rule("EKF2_EV_CTRL", fused, "what is not enabled here is not fused; bit 3 (heading) may stay "
         "off, since our heading comes from the autopilot's own"),
    Rule("EKF2_AID_MASK", _fused_before_1_14, "what is not enabled here is not fused (PX4 before "
         "1.14)", reboot=True),
    Rule("EKF2_HGT_REF", _height, "3 is vision, 0 the barometer; 1 waits for a "
         "GPS", reboot=True),
    Rule("EKF2_HGT_MODE", _height, "3 is vision, 0 the barometer; 1 waits for a "
         "GPS (PX4 before 1.14)", reboot=True),
    Rule("EKF2_EV_DELAY", _always(Near(0, 20)), "our stamps are those of the exposure, in "
         "PX4's own clock: nothing is left to take off", reboot=True),
    Rule("EKF2_DELAY_MAX", _delay_max, "older poses than this are not fused; ours were measured "
         "to be that old", reboot=True),
    Rule("EKF2_EV_NOISE_MD", _always(OneOf((0,))), "1 would not use the uncertainty that we send"),
    Rule("EKF2_EV_QMIN", _quality, "above expert.feedback.min_quality our poses would be ignored"),
    Rule("EKF2_EVP_NOISE", _least_noise(VELOCITY), "the least uncertainty that a position is taken "
         "to have: over known ground ours states less than the 0.1 m that PX4 begins with"),
    Rule("EKF2_EVV_NOISE", _least_noise("vision_position"), "the same of a velocity"),
    Rule("EKF2_EV_POS_X", _same_as("EKF2_IMU_POS_X"), OUR_BODY),
    Rule("EKF2_EV_POS_Y", _same_as("EKF2_IMU_POS_Y"), OUR_BODY),
    Rule("EKF2_EV_POS_Z", _same_as("EKF2_IMU_POS_Z"), OUR_BODY),
    Rule("EKF2_OF_CTRL", _for_flow("optical_flow_rad", OneOf((1,))), "1 fuses OPTICAL_FLOW_RAD, "
         "which feedback.flow sends"),
    Rule("SENS_FLOW_ROT", _for_flow("optical_flow_rad", OneOf((0,))), FLOW_IN_BODY),
    Rule("EKF2_AGP0_ID", _for_place(OneOf((10,))), "the id of the places on earth that "
         "feedback.global_position sends; a sensor of another id has its own slot"),
    Rule("EKF2_AGP0_CTRL", _for_place(Bits(0b01, "0 (horizontal position)")), "without it "
         "the place on earth that we send is not fused"),
    Rule("EKF2_AGP0_DELAY", _place_delay, "the time from exposure to sending, as measured; PX4 "
         "stamps a place on earth when it comes", reboot=True),
    Rule("COM_ARM_WO_GPS", _without_gps, "0 refuses to arm without a GPS fix"),
)  # fmt: skip

RULES = {ARDUPILOT: ARDUPILOT_RULES, PX4: PX4_RULES}
COMPARED = {
    ARDUPILOT: ("INS_POS1_X", "INS_POS1_Y", "INS_POS1_Z"),
    PX4: ("EKF2_IMU_POS_X", "EKF2_IMU_POS_Y", "EKF2_IMU_POS_Z"),
}
EITHER_OF = (("EKF2_EV_CTRL", "EKF2_AID_MASK"),)
"""One of each pair must exist: older firmware has the second."""
