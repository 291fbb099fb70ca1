"""What an autopilot's parameters must be for it to fly on our pose, and which of them are not.

A table for each firmware, and nothing else: no link, no writing. What is wanted follows from how we
send: the pose of the body, in metres, stamped at exposure, with covariances and a quality.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from companion.config import FeedbackConfig, LinkConfig

Values = Mapping[str, float]
ARDUPILOT, PX4 = "ardupilot", "px4"
FIRMWARES = (ARDUPILOT, PX4)

DELAY_TOLERANCE_MS = 15.0
MOST_VISO_DELAY_MS = 250.0
BUSY = 0.6
"""A line is not to be filled further than this, or stamps come late."""
BITS_PER_BYTE = 10
POSE_BYTES = {"odometry": 245, "vision_position": 129 + 69}
OTHER_BYTES_PER_S = 700.0
"""Heartbeat, time synchronisation and status of ours."""
ATTITUDE_BYTES, IMU_BYTES, POSITION_BYTES, HEIGHT_BYTES = 44, 41, 40 + 40 + 64, 28 + 51
USUAL_BAUDS = (115200, 230400, 460800, 921600, 1500000)


@dataclass(frozen=True, slots=True)
class Finding:
    """One parameter and what is said of it; `in_the_way`, or only to be known.

    `value` is None where the firmware has no such parameter, `set_to` where nothing can be set.
    """

    name: str
    value: float | None
    wanted: str
    why: str
    set_to: float | None = None
    reboot: bool = False
    in_the_way: bool = True


class Wanted(Protocol):
    """What a value must be."""

    def met_by(self, value: float) -> bool:
        """Whether a value will do."""

    def repaired(self, value: float) -> float:
        """The nearest that will do."""


@dataclass(frozen=True, slots=True)
class Among:
    """One of these; the first is the best."""

    values: tuple[float, ...]

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return any(abs(value - each) < 1e-6 for each in self.values)

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return self.values[0]

    def __str__(self) -> str:
        best, *others = (f"{each:g}" for each in self.values)
        return f"{best} (or {', '.join(others)})" if others else best


@dataclass(frozen=True, slots=True)
class Between:
    """From `least` to `most`."""

    least: float
    most: float

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return self.least - 1e-6 <= value <= self.most + 1e-6

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return min(max(value, self.least), self.most)

    def __str__(self) -> str:
        return f"{self.least:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class Bits:
    """All of these bits, whatever the others are."""

    mask: int
    words: str

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return int(value) & self.mask == self.mask

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return int(value) | self.mask

    def __str__(self) -> str:
        return f"bits {self.words}"


@dataclass(frozen=True, slots=True)
class Near:
    """A value, as nearly as matters."""

    value: float
    tolerance: float

    def met_by(self, value: float) -> bool:
        """See `Wanted`."""
        return abs(value - self.value) <= self.tolerance

    def repaired(self, value: float) -> float:
        """See `Wanted`."""
        return self.value

    def __str__(self) -> str:
        return f"{self.value:g}"


@dataclass(frozen=True, slots=True)
class Asked:
    """What the advice is for. `latency_ms`: from exposure to sending, None where not measured."""

    feedback: FeedbackConfig
    mode: str
    latency_ms: float | None


@dataclass(frozen=True, slots=True)
class Rule:
    """One row. `lacking` is what it means that a firmware has no such parameter; "" for nothing."""

    name: str
    wanted: Callable[[Asked, Values], Wanted | None]
    why: str
    reboot: bool = False
    lacking: str = ""


def _always(wanted: Wanted) -> Callable[[Asked, Values], Wanted]:
    return lambda asked, values: wanted


def _same_as(other: str) -> Callable[[Asked, Values], Wanted]:
    return lambda asked, values: Near(values.get(other, 0.0), 0.005)


def _quality(asked: Asked, values: Values) -> Wanted:
    return Between(0, asked.feedback.min_quality)


def _velocity(asked: Asked, values: Values) -> Wanted:
    return Among((6, 0))


def _needs_compass(asked: Asked, values: Values) -> Wanted | None:
    return Among((1,)) if values.get("EK3_SRC1_YAW") == 1 else None


def _viso_delay(asked: Asked, values: Values) -> Wanted | None:
    if asked.latency_ms is None:
        return None
    latency_ms = min(round(asked.latency_ms), MOST_VISO_DELAY_MS)
    return Near(latency_ms, DELAY_TOLERANCE_MS)


def _proximity(asked: Asked, values: Values) -> Wanted | None:
    return Among((2,)) if asked.feedback.obstacle_distance else None


def _fused(asked: Asked, values: Values) -> Wanted:
    if asked.mode == "odometry":
        return Bits(0b111, "0, 1 and 2 (horizontal position, vertical position, velocity)")
    return Bits(0b011, "0 and 1 (horizontal and vertical position)")


def _fused_before_1_14(asked: Asked, values: Values) -> Wanted:
    if asked.mode == "odometry":
        return Bits(8 | 256, "3 and 8 (vision position and velocity)")
    return Bits(8, "3 (vision position)")


def _delay_max(asked: Asked, values: Values) -> Wanted | None:
    if asked.latency_ms is None:
        return None
    return Between(round(asked.latency_ms + DELAY_TOLERANCE_MS), 1000)


OUR_BODY = (
    "the pose that we send is that of the body already, not the camera's: another offset would be "
    "taken off twice"
)

ARDUPILOT_RULES = (
    Rule(
        "VISO_TYPE", _always(Among((3, 1))), "0 takes no visual odometry at all, 2 ignores it for "
        "1 s after a reset; 3 follows our resets, 1 (MAVLink) will do",
        reboot=True,
        lacking="this firmware was built without visual odometry (HAL_VISUALODOM_ENABLED); boards "
        "with 1 MB of flash lack it",
    ),
    Rule("EK3_ENABLE", _always(Among((1,))), "only EKF3 takes a position from vision", reboot=True,
         lacking="only EKF3 takes a position from vision, and this firmware has none"),
    Rule("AHRS_EKF_TYPE", _always(Among((3,))), "the vehicle flies on what this EKF says"),
    Rule("EK3_SRC1_POSXY", _always(Among((6,))), "6 takes the horizontal position from our pose",
         lacking="ArduPilot before 4.1; it cannot be told to use vision beside a GPS"),
    Rule("EK3_SRC1_VELXY", _velocity, "6 takes the velocity that we send; 3 waits for a GPS"),
    Rule("EK3_SRC1_POSZ", _always(Among((1, 6))), "1 is the barometer, 6 our height; 3 waits for "
         "a GPS"),
    Rule("EK3_SRC1_VELZ", _velocity, "6 takes the vertical velocity that we send; 3 waits for a "
         "GPS"),
    Rule("EK3_SRC1_YAW", _always(Among((1, 6))), "1 is the compass, which is best, since our "
         "heading comes from the autopilot's own; 6 is ours"),
    Rule("COMPASS_ENABLE", _needs_compass, "EK3_SRC1_YAW takes the heading from the compass"),
    Rule("VISO_ORIENT", _always(Among((0,))), OUR_BODY),
    Rule("VISO_SCALE", _always(Near(1.0, 1e-3)), "our pose is in metres"),
    Rule("VISO_POS_X", _same_as("INS_POS1_X"), OUR_BODY),
    Rule("VISO_POS_Y", _same_as("INS_POS1_Y"), OUR_BODY),
    Rule("VISO_POS_Z", _same_as("INS_POS1_Z"), OUR_BODY),
    Rule("VISO_QUAL_MIN", _quality, "above feedback.min_quality our poses would be ignored; -1 "
         "would take lost ones"),
    Rule("VISO_DELAY_MS", _viso_delay, "the time from exposure to sending, as measured; ArduPilot "
         "counts from arrival"),
    Rule("PRX1_TYPE", _proximity, "2 takes OBSTACLE_DISTANCE, which feedback.obstacle_distance "
         "sends", reboot=True),
)  # fmt: skip

PX4_RULES = (
    Rule("SYS_MC_EST_GROUP", _always(Among((2,))), "only EKF2 takes our pose", reboot=True),
    Rule("EKF2_EN", _always(Among((1,))), "only EKF2 takes our pose", reboot=True),
    Rule("EKF2_EV_CTRL", _fused, "what is not enabled here is not fused; bit 3 (heading) may stay "
         "off, since our heading comes from the autopilot's own"),
    Rule("EKF2_AID_MASK", _fused_before_1_14, "what is not enabled here is not fused (PX4 before "
         "1.14)", reboot=True),
    Rule("EKF2_HGT_REF", _always(Among((3, 0, 2))), "3 is vision, 0 the barometer; 1 waits for a "
         "GPS", reboot=True),
    Rule("EKF2_HGT_MODE", _always(Among((3, 0, 2))), "3 is vision, 0 the barometer; 1 waits for a "
         "GPS (PX4 before 1.14)", reboot=True),
    Rule("EKF2_EV_DELAY", _always(Near(0, 20)), "our stamps are those of the exposure, in "
         "PX4's own clock: nothing is left to take off", reboot=True),
    Rule("EKF2_DELAY_MAX", _delay_max, "older poses than this are not fused; ours were measured "
         "to be that old", reboot=True),
    Rule("EKF2_EV_NOISE_MD", _always(Among((0,))), "1 would not use the uncertainty that we send"),
    Rule("EKF2_EV_QMIN", _quality, "above feedback.min_quality our poses would be ignored"),
    Rule("EKF2_EVP_NOISE", _always(Between(0.01, 1.0)), "the least uncertainty that a position "
         "is taken to have; above 1 m it hardly counts"),
    Rule("EKF2_EV_POS_X", _same_as("EKF2_IMU_POS_X"), OUR_BODY),
    Rule("EKF2_EV_POS_Y", _same_as("EKF2_IMU_POS_Y"), OUR_BODY),
    Rule("EKF2_EV_POS_Z", _same_as("EKF2_IMU_POS_Z"), OUR_BODY),
    Rule("COM_ARM_WO_GPS", _always(Among((1, 2))), "0 refuses to arm without a GPS fix"),
)  # fmt: skip

RULES = {ARDUPILOT: ARDUPILOT_RULES, PX4: PX4_RULES}
COMPARED = {
    ARDUPILOT: ("INS_POS1_X", "INS_POS1_Y", "INS_POS1_Z"),
    PX4: ("EKF2_IMU_POS_X", "EKF2_IMU_POS_Y", "EKF2_IMU_POS_Z"),
}
OF_LINES = {
    ARDUPILOT: tuple(f"SERIAL{n}_{what}" for n in range(1, 9) for what in ("BAUD", "PROTOCOL")),
    PX4: (
        *(f"MAV_{n}_{what}" for n in range(3) for what in ("CONFIG", "RATE")),
        "SER_TEL1_BAUD", "SER_TEL2_BAUD", "SER_TEL3_BAUD", "SER_TEL4_BAUD",
    ),
}  # fmt: skip
PX4_PORTS = {101: "TEL1", 102: "TEL2", 103: "TEL3", 104: "TEL4"}
ARDUPILOT_MAVLINK = (1, 2)
EITHER_OF = (("EKF2_EV_CTRL", "EKF2_AID_MASK"),)
"""One of each pair there must be: older firmware has the second."""


def names_to_read(firmware: str, line: bool = False) -> list[str]:
    """The parameters that advice for a firmware looks at; those of its serial ports as well."""
    names = [rule.name for rule in RULES[firmware]] + list(COMPARED[firmware])
    return names + list(OF_LINES[firmware]) if line else names


def advise(
    firmware: str,
    values: Values,
    feedback: FeedbackConfig,
    mode: str,
    latency_ms: float | None = None,
) -> list[Finding]:
    """What of an autopilot's parameters stands in the way of `mode`, in the order of the table.

    `values` holds what the autopilot has of `names_to_read`.
    """
    asked = Asked(feedback, mode, latency_ms)
    findings = []
    for rule in RULES[firmware]:
        value = values.get(rule.name)
        if value is None:
            if rule.lacking:
                findings.append(
                    Finding(rule.name, None, _text(rule, asked, values), rule.lacking)
                )
            continue
        wanted = rule.wanted(asked, values)
        if wanted is None or wanted.met_by(value):
            continue
        findings.append(
            Finding(
                rule.name, value, str(wanted), rule.why, wanted.repaired(value), rule.reboot
            )
        )  # fmt: skip
    if firmware == PX4 and not any(name in values for name in EITHER_OF[0]):
        findings.append(
            Finding(
                "EKF2_EV_CTRL", None, str(_fused(asked, values)),
                "this firmware was built without external vision in EKF2",
            )
        )  # fmt: skip
    if firmware == ARDUPILOT and latency_ms is None and "VISO_DELAY_MS" in values:
        findings.append(
            Finding(
                "VISO_DELAY_MS", values["VISO_DELAY_MS"], "the latency that is measured in flight",
                "`companion status` shows it; run doctor while the daemon runs to have it compared",
                in_the_way=False,
            )
        )  # fmt: skip
    return findings


def advise_on_line(
    firmware: str,
    values: Values,
    link: LinkConfig,
    feedback: FeedbackConfig,
    mode: str,
    baud: int,
) -> list[Finding]:
    """Whether a serial line carries both ways what is asked of it; PX4's own limit as well."""
    up = feedback.rate_hz * POSE_BYTES[mode] + OTHER_BYTES_PER_S
    down = (
        link.attitude_hz * ATTITUDE_BYTES
        + link.imu_hz * IMU_BYTES
        + link.position_hz * POSITION_BYTES
        + link.height_hz * HEIGHT_BYTES
        + OTHER_BYTES_PER_S
    )
    needed_baud = max(up, down) * BITS_PER_BYTE / BUSY
    findings = []
    ports = _ports_at(firmware, values, baud)
    if baud < needed_baud:
        enough = next((each for each in USUAL_BAUDS if each >= needed_baud), USUAL_BAUDS[-1])
        findings.append(
            Finding(
                ports[0] if len(ports) == 1 else _BAUD_NAME[firmware], float(baud),
                f"{enough} or more, and the same in link.url",
                f"we send {up / 1000:.1f} kB/s and ask for {down / 1000:.1f} kB/s; this line "
                f"carries {baud / BITS_PER_BYTE / 1000:.1f} kB/s each way",
            )
        )  # fmt: skip
    if firmware == PX4:
        findings += _px4_rate(values, baud, down)
    return findings


_BAUD_NAME = {ARDUPILOT: "SERIALn_BAUD", PX4: "SER_…_BAUD"}


def _text(rule: Rule, asked: Asked, values: Values) -> str:
    wanted = rule.wanted(asked, values)
    return "" if wanted is None else str(wanted)


def _ports_at(firmware: str, values: Values, baud: int) -> list[str]:
    """The parameters of the ports that speak MAVLink at a baud rate."""
    if firmware == PX4:
        return [
            f"SER_{port}_BAUD"
            for number, port in PX4_PORTS.items()
            if values.get(f"SER_{port}_BAUD") == baud
            and any(values.get(f"MAV_{n}_CONFIG") == number for n in range(3))
        ]
    return [
        f"SERIAL{n}_BAUD"
        for n in range(1, 9)
        if values.get(f"SERIAL{n}_PROTOCOL") in ARDUPILOT_MAVLINK
        and values.get(f"SERIAL{n}_BAUD") in (baud, baud // 1000)  # 57 stands for 57600
    ]


def _px4_rate(values: Values, baud: int, down: float) -> list[Finding]:
    ports = _ports_at(PX4, values, baud)
    if len(ports) != 1:
        return []
    number = next(n for n, port in PX4_PORTS.items() if f"SER_{port}_BAUD" == ports[0])
    instance = next(n for n in range(3) if values.get(f"MAV_{n}_CONFIG") == number)
    name = f"MAV_{instance}_RATE"
    value = values.get(name)
    half = baud / BITS_PER_BYTE / 2
    if value is None or (value or half) >= down:
        return []
    return [
        Finding(
            name, value, f"{down:.0f} or more",
            "bytes a second that PX4 sends here at most (0: half of the line); it slows all "
            "streams down to keep to it",
            float(round(BUSY * baud / BITS_PER_BYTE)), True,
        )
    ]  # fmt: skip
