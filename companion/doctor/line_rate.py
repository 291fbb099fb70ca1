"""Capacity of the serial line to an autopilot."""

from __future__ import annotations

from companion.config import FeedbackConfig, LinkConfig
from companion.doctor.imu_room import (
    BAUD_NAME,
    BITS_PER_BYTE,
    MAX_LOAD,
    USUAL_BAUDS,
    asked_bytes_per_s,
    imu_bytes_per_s,
    signature_bytes,
)
from companion.doctor.wanted import ARDUPILOT, PX4, Finding, Values

POSE_BYTES = {"odometry": 245, "vision_position": 129 + 69, "velocity": 245}
FLOW_BYTES = {"optical_flow": 46, "optical_flow_rad": 56}
OBSTACLES_HZ, OBSTACLES_BYTES, OBSTACLES_3D_BYTES = 10.0, 179, 15 * 37
"""A message of 72 sectors, or as many cells of space as a camera of 65 degrees shows."""
OTHER_BYTES_PER_S = 700.0
"""Our heartbeat, time synchronisation and status."""
FULL = 0.95
"""Utilisation by what we send beyond which it waits, ever longer, when the rest comes in bursts."""
LINE_PARAMETERS = {
    ARDUPILOT: tuple(f"SERIAL{n}_{what}" for n in range(1, 9) for what in ("BAUD", "PROTOCOL")),
    PX4: (
        *(f"MAV_{n}_{what}" for n in range(3) for what in ("CONFIG", "RATE")),
        "SER_TEL1_BAUD", "SER_TEL2_BAUD", "SER_TEL3_BAUD", "SER_TEL4_BAUD",
    ),
}  # fmt: skip
PX4_PORTS = {101: "TEL1", 102: "TEL2", 103: "TEL3", 104: "TEL4"}
ARDUPILOT_MAVLINK = (1, 2)


def line_parameters(firmware: str) -> tuple[str, ...]:
    """Parameters read by this check."""
    return LINE_PARAMETERS[firmware]


def sent_bytes_per_s(
    link: LinkConfig, feedback: FeedbackConfig, mode: str, camera_hz: float
) -> float:
    """Load by what we send, poses of this mode among it."""
    signature = signature_bytes(link)
    sent = OTHER_BYTES_PER_S
    if mode != "off":
        pose_hz = camera_hz * feedback.poses_per_frame(1.0 / camera_hz)
        sent += pose_hz * (POSE_BYTES[mode] + signature)
    if feedback.flow != "off":
        sent += camera_hz * (FLOW_BYTES[feedback.flow] + signature)
    if feedback.obstacle_distance:
        each = OBSTACLES_3D_BYTES if feedback.obstacles_3d else OBSTACLES_BYTES
        sent += OBSTACLES_HZ * (each + signature)
    return sent


def check_line(
    firmware: str, values: Values, link: LinkConfig, feedback: FeedbackConfig, mode: str,
    camera_hz: float, baud: int,
) -> list[Finding]:  # fmt: skip
    """Findings on the capacity of a serial line both ways, and PX4's own rate limit."""
    up = sent_bytes_per_s(link, feedback, mode, camera_hz)
    down = asked_bytes_per_s(link) + imu_bytes_per_s(link, baud / BITS_PER_BYTE, firmware)
    needed_baud = max(up, down) * BITS_PER_BYTE / MAX_LOAD
    findings = []
    ports = _ports_at(firmware, values, baud)
    if baud < needed_baud:
        enough = next((each for each in USUAL_BAUDS if each >= needed_baud), USUAL_BAUDS[-1])
        findings.append(
            Finding(
                ports[0] if len(ports) == 1 else BAUD_NAME[firmware], float(baud),
                f"{enough} or more, and the same in link.url",
                f"we send {up / 1000:.1f} kB/s and ask for {down / 1000:.1f} kB/s; this line "
                f"carries {baud / BITS_PER_BYTE / 1000:.1f} kB/s each way",
            )
        )  # fmt: skip
    if firmware == PX4:
        findings += _px4_rate(values, baud, down)
    return findings


def _ports_at(firmware: str, values: Values, baud: int) -> list[str]:
    """Parameters of the ports that speak MAVLink at a baud rate."""
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
            float(round(MAX_LOAD * baud / BITS_PER_BYTE)), True,
        )
    ]  # fmt: skip
