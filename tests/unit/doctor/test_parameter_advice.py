from __future__ import annotations

import re
from dataclasses import replace

import pytest

from companion.config import FeedbackConfig, GpsConfig, LandingConfig, LinkConfig
from companion.doctor.line_rate import check_line, line_parameters, sent_bytes_per_s
from companion.doctor.parameter_rules import RULES
from companion.doctor.pose_parameters import advise, names_to_read
from companion.doctor.wanted import FIRMWARES, Finding
from tests.support.autopilot import fake_parameters

NEW = {
    "ardupilot": {name: value for name, (value, _) in fake_parameters.ARDUPILOT.items()},
    "px4": {name: value for name, (value, _) in fake_parameters.PX4.items()},
}
FEEDBACK = FeedbackConfig()
ARDUPILOT_READY: dict[str, float] = {
    "VISO_TYPE": 1, "EK3_SRC1_POSXY": 6, "EK3_SRC1_VELXY": 6, "EK3_SRC1_VELZ": 6,
}  # fmt: skip
PX4_READY: dict[str, float] = {
    "EKF2_EV_CTRL": 7, "EKF2_HGT_REF": 3, "EKF2_EVP_NOISE": 0.05, "EKF2_EVV_NOISE": 0.05,
}  # fmt: skip
READY = {"ardupilot": ARDUPILOT_READY, "px4": PX4_READY}


def blocking(
    firmware: str, changed: dict[str, float], mode: str = "odometry",
    latency_ms: float | None = None, feedback: FeedbackConfig = FEEDBACK,
) -> dict[str, Finding]:  # fmt: skip
    values = {**NEW[firmware], **READY[firmware], **changed}
    findings = advise(firmware, values, feedback, mode, latency_ms)
    return {finding.name: finding for finding in findings if finding.blocking}


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_all_rules_apply_to_a_new_autopilot(firmware: str) -> None:
    findings = advise(firmware, NEW[firmware], FEEDBACK, "odometry")
    told = {f.name: f.set_to for f in findings if f.blocking}
    assert told == READY[firmware]
    assert blocking(firmware, {}) == {}


@pytest.mark.parametrize("firmware", FIRMWARES)
@pytest.mark.parametrize("mode", ["odometry", "vision_position", "velocity"])
def test_following_the_advice_leaves_none(firmware: str, mode: str) -> None:
    values = dict.fromkeys(names_to_read(firmware), 77.0)
    for _ in range(2):  # a compass is asked for once the heading comes from it
        for finding in advise(firmware, values, FEEDBACK, mode, 60.0):
            assert finding.set_to is not None
            values[finding.name] = finding.set_to
    assert advise(firmware, values, FEEDBACK, mode, 60.0) == []


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("VISO_TYPE", [1], [0, 2, 3]),
        ("EK3_SRC1_POSXY", [6], [0, 3]),
        ("EK3_SRC1_VELXY", [0, 6], [3, 5]),
        ("EK3_SRC1_POSZ", [1, 6], [3]),
        ("EK3_SRC1_YAW", [1, 6], [2, 3, 8]),
        ("VISO_POS_X", [0, 0.004], [0.1]),
        ("VISO_QUAL_MIN", [0, 20], [-1, 21]),
        ("VISO_SCALE", [1.0], [1.1]),
        ("AHRS_EKF_TYPE", [3], [2, 10]),
    ],
)
def test_values_of_ardupilot(name: str, good: list[float], bad: list[float]) -> None:
    assert not any(name in blocking("ardupilot", {name: value}) for value in good)
    assert all(name in blocking("ardupilot", {name: value}) for value in bad)


@pytest.mark.parametrize("mode", ["odometry", "vision_position"])
def test_viso_type_that_moves_our_pose_is_blocking(mode: str) -> None:
    found = blocking("ardupilot", {"VISO_TYPE": 3}, mode)["VISO_TYPE"]
    assert (found.wanted, found.set_to, found.reboot) == ("1", 1, True)
    assert "3 (VOXL) moves our pose to zero" in found.why


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("EKF2_EV_CTRL", [7, 15], [0, 1, 3, 8]),
        ("EKF2_HGT_REF", [0, 2, 3], [1]),
        ("EKF2_EV_DELAY", [0, 15], [50, 175]),
        ("EKF2_EV_NOISE_MD", [0], [1]),
        ("EKF2_EV_QMIN", [0, 20], [50]),
        ("EKF2_EVP_NOISE", [0.01, 0.05], [0.1]),
        ("COM_ARM_WO_GPS", [1, 2], [0]),
        ("SYS_MC_EST_GROUP", [2], [1, 3]),
    ],
)
def test_values_of_px4(name: str, good: list[float], bad: list[float]) -> None:
    assert not any(name in blocking("px4", {name: value}) for value in good)
    assert all(name in blocking("px4", {name: value}) for value in bad)


def test_bits_are_added_and_others_kept() -> None:
    assert blocking("px4", {"EKF2_EV_CTRL": 8})["EKF2_EV_CTRL"].set_to == 15
    assert blocking("px4", {"EKF2_EV_CTRL": 3}, mode="vision_position") == {}


def test_of_the_velocity_alone_nothing_else_is_asked_to_be_fused() -> None:
    px4: dict[str, float] = {"EKF2_EV_CTRL": 4, "EKF2_HGT_REF": 1, "COM_ARM_WO_GPS": 0}
    assert blocking("px4", px4, mode="velocity") == {}
    assert blocking("px4", {**px4, "EKF2_EV_CTRL": 0}, "velocity")["EKF2_EV_CTRL"].set_to == 4
    ardupilot: dict[str, float] = {"EK3_SRC1_POSXY": 3, "EK3_SRC1_VELXY": 6}
    assert blocking("ardupilot", ardupilot, mode="velocity") == {}
    assert "EK3_SRC1_VELXY" in blocking("ardupilot", {"EK3_SRC1_VELXY": 0}, mode="velocity")


def test_sensor_offset_may_be_that_of_the_imu() -> None:
    assert blocking("px4", {"EKF2_EV_POS_X": 0.1, "EKF2_IMU_POS_X": 0.1}) == {}
    assert blocking("px4", {"EKF2_EV_POS_X": 0.1})["EKF2_EV_POS_X"].set_to == 0
    assert blocking("ardupilot", {"VISO_POS_Z": 0, "INS_POS1_Z": 0.2})["VISO_POS_Z"].set_to == 0.2


def test_delay_is_checked_only_when_measured() -> None:
    (note,) = advise("ardupilot", {**NEW["ardupilot"], **ARDUPILOT_READY}, FEEDBACK, "odometry")
    assert (note.name, note.blocking, note.set_to) == ("VISO_DELAY_MS", False, None)
    assert blocking("ardupilot", {"VISO_DELAY_MS": 55}, latency_ms=48.4) == {}
    assert blocking("ardupilot", {}, latency_ms=48.4)["VISO_DELAY_MS"].set_to == 48
    assert blocking("ardupilot", {}, latency_ms=400)["VISO_DELAY_MS"].set_to == 250
    assert blocking("px4", {"EKF2_DELAY_MAX": 200}, latency_ms=60) == {}
    assert blocking("px4", {"EKF2_DELAY_MAX": 50}, latency_ms=60)["EKF2_DELAY_MAX"].set_to == 75


def test_firmware_without_vision_is_reported() -> None:
    for firmware, name in (("ardupilot", "VISO_TYPE"), ("px4", "EKF2_EV_CTRL")):
        values = {**NEW[firmware], **READY[firmware]}
        del values[name]
        found = {each.name: each for each in advise(firmware, values, FEEDBACK, "odometry")}
        assert found[name].value is found[name].set_to is None
        assert "built without" in found[name].why


def test_older_px4() -> None:
    values = {"EKF2_AID_MASK": 1.0, "EKF2_HGT_MODE": 1.0}
    found = {each.name: each.set_to for each in advise("px4", values, FEEDBACK, "odometry")}
    assert found == {"EKF2_AID_MASK": 1 | 8 | 256, "EKF2_HGT_MODE": 3}


def test_compass_and_proximity_are_required_where_used() -> None:
    assert "COMPASS_ENABLE" in blocking("ardupilot", {"COMPASS_ENABLE": 0})
    assert blocking("ardupilot", {"COMPASS_ENABLE": 0, "EK3_SRC1_YAW": 6}) == {}
    sending = FeedbackConfig(obstacle_distance=True)
    assert "PRX1_TYPE" in blocking("ardupilot", {"PRX1_TYPE": 0}, feedback=sending)
    late = blocking("ardupilot", {"PRX1_TYPE": 2, "PRX_FILT": 0.25}, feedback=sending)
    assert late["PRX_FILT"].set_to == 0
    assert blocking("ardupilot", {"PRX1_TYPE": 0, "PRX_FILT": 0.25}) == {}


def test_flow_needs_its_parameters_where_it_is_sent() -> None:
    flow = FeedbackConfig(flow="optical_flow")
    amiss = {"FLOW_TYPE": 0.0, "FLOW_ORIENT_YAW": 9000.0, "FLOW_OPTIONS": 1.0}
    found = blocking("ardupilot", amiss, feedback=flow)
    assert {name: found[name].set_to for name in amiss} == {
        "FLOW_TYPE": 5, "FLOW_ORIENT_YAW": 0, "FLOW_OPTIONS": 0,
    }  # fmt: skip
    assert blocking("ardupilot", amiss) == {}
    amiss = {"EKF2_OF_CTRL": 0.0, "SENS_FLOW_ROT": 6.0}
    found = blocking("px4", amiss, feedback=FeedbackConfig(flow="optical_flow_rad"))
    assert {name: found[name].set_to for name in amiss} == {"EKF2_OF_CTRL": 1, "SENS_FLOW_ROT": 0}
    assert blocking("px4", amiss, feedback=flow) == {}


def test_a_set_of_its_own_takes_the_pose_where_sources_are_switched() -> None:
    values = {**NEW["ardupilot"], **{f"EK3_SRC{n}_{each}": 0.0 for n in (1, 2)
              for each in ("POSXY", "VELXY", "VELZ", "POSZ", "YAW")}}  # fmt: skip
    values |= {"VISO_TYPE": 1, "EK3_SRC1_YAW": 1}
    gps = GpsConfig(switch_source=True)
    found = advise("ardupilot", values, FEEDBACK, "odometry", 60.0, gps)
    told = {each.name: each.set_to for each in found if each.name.startswith("EK3_SRC")}
    assert told == {"EK3_SRC1_POSXY": 3, "EK3_SRC2_POSXY": 6, "EK3_SRC2_POSZ": 1, "EK3_SRC2_YAW": 1}


def test_landing_needs_its_parameters_where_a_marker_is_set() -> None:
    values = {**NEW["ardupilot"], **ARDUPILOT_READY, "PLND_ENABLED": 0, "PLND_TYPE": 0,
              "PLND_ORIENT": 0, "PLND_CAM_POS_X": 0.1, "PLND_LAG": 0.02}  # fmt: skip
    assert all(
        "PLND" not in each.name for each in advise("ardupilot", values, FEEDBACK, "odometry")
    )
    marker = LandingConfig(marker="apriltag_36h11", size_m=0.5)
    found = advise("ardupilot", values, FEEDBACK, "odometry", 74.0, GpsConfig(), marker)
    told = {each.name: each.set_to for each in found if each.name.startswith("PLND")}
    assert told == {
        "PLND_ENABLED": 1, "PLND_TYPE": 1, "PLND_ORIENT": 25, "PLND_CAM_POS_X": 0,
        "PLND_LAG": 0.074,
    }  # fmt: skip


def test_a_place_on_earth_needs_a_slot_of_its_id() -> None:
    amiss = {"EKF2_AGP0_ID": 0.0, "EKF2_AGP0_CTRL": 2.0, "EKF2_AGP0_DELAY": 0.0}
    sending = FeedbackConfig(global_position="sensor")
    found = blocking("px4", amiss, latency_ms=70, feedback=sending)
    assert {name: found[name].set_to for name in amiss} == {
        "EKF2_AGP0_ID": 10, "EKF2_AGP0_CTRL": 3, "EKF2_AGP0_DELAY": 70,
    }  # fmt: skip
    assert blocking("px4", amiss, latency_ms=70) == {}


def test_slow_line_is_reported_by_port() -> None:
    link = LinkConfig(url="serial:/dev/ttyTHS1:57600")
    (slow,) = check_line("ardupilot", NEW["ardupilot"], link, FEEDBACK, "odometry", 30.0, 57600)
    assert (slow.name, slow.value) == ("SERIAL1_BAUD", 57600)
    assert slow.wanted.startswith("230400")
    assert check_line("ardupilot", NEW["ardupilot"], link, FEEDBACK, "odometry", 30.0, 921600) == []
    (slow,) = check_line("px4", {}, link, FEEDBACK, "odometry", 30.0, 57600)
    assert slow.name == "SER_…_BAUD"


def test_line_is_to_carry_all_that_is_sent() -> None:
    link = LinkConfig(url="serial:/dev/ttyTHS1:230400")
    more = replace(FEEDBACK, flow="optical_flow", obstacle_distance=True, obstacles_3d=True)
    for feedback, camera_hz, enough in ((FEEDBACK, 30.0, True), (FEEDBACK, 60.0, False),
                                        (more, 30.0, False)):  # fmt: skip
        found = check_line("ardupilot", {}, link, feedback, "odometry", camera_hz, 230400)
        assert (found == []) is enough


def test_poses_are_sent_by_whole_parts_of_a_frame() -> None:
    sent = [sent_bytes_per_s(LinkConfig(), FEEDBACK, "odometry", hz) for hz in (20.0, 30.0, 60.0)]
    assert sent == [700.0 + 245 * n for n in (40, 30, 60)]


def test_px4_rate_limit() -> None:
    link = LinkConfig(url="serial:/dev/ttyTHS1:921600", attitude_hz=100, imu_hz=200)
    values = {**NEW["px4"], "MAV_1_CONFIG": 102, "MAV_1_RATE": 1200}
    (slow,) = check_line("px4", values, link, FEEDBACK, "odometry", 30.0, 921600)
    assert (slow.name, slow.reboot) == ("MAV_1_RATE", True)
    values["MAV_1_RATE"] = 0
    assert check_line("px4", values, link, FEEDBACK, "odometry", 30.0, 921600) == []


def test_names_fit_a_parameter() -> None:
    for firmware in FIRMWARES:
        names = [*names_to_read(firmware), *line_parameters(firmware)]
        assert len(set(names)) == len(names)
        assert all(re.fullmatch(r"[A-Z][A-Z0-9_]{2,15}", name) for name in names)
        assert all(rule.why and rule.why[-1] not in ". " for rule in RULES[firmware])
