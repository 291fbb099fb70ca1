from __future__ import annotations

import asyncio
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.app.doctor_command import doctor
from companion.config import Config, FeedbackConfig, LinkConfig, RouterConfig
from companion.errors import ConfigError, InputError, SourceError
from companion.timing.clock import FlightClock
from drivers.mavlink.wire.pymavlink_port import PymavlinkPort
from drivers.system.status_socket import StatusSocket
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_wire import free_port
from tests.support.processes.strain import within


@pytest.fixture
def config(tmp_path: Path) -> Config:
    config = Config()
    return replace(
        config,
        daemon=replace(config.daemon, socket=str(tmp_path / "status.sock")),
        feedback=FeedbackConfig(mode="odometry"),
    )


def examine(config: Config, url: str, **options: Any) -> tuple[int, str]:
    out = io.StringIO()
    config = replace(config, link=replace(config.link, url=url))
    return doctor(config, out=out, **options), out.getvalue()


def quick_autopilot(firmware: str, url: str, **options: Any) -> FakeAutopilot:
    autopilot = FakeAutopilot(firmware, url, **options)
    autopilot.rates_hz["HEARTBEAT"] = 20.0
    return autopilot


def never(question: str) -> bool:
    raise AssertionError(question)


@pytest.mark.parametrize(
    ("firmware", "names"),
    [
        ("ardupilot", ["VISO_TYPE", "EK3_SRC1_POSXY", "EK3_SRC1_VELXY", "EK3_SRC1_VELZ"]),
        ("px4", ["EKF2_EV_CTRL", "EKF2_HGT_REF", "EKF2_EVP_NOISE", "EKF2_EVV_NOISE"]),
    ],
)
def test_names_sets_and_finds_nothing_more(config: Config, firmware: str, names: list[str]) -> None:
    with quick_autopilot(firmware, "udpin:127.0.0.1:0") as autopilot:
        status, text = examine(config, autopilot.url, ask=never)
        assert status == 1
        assert all(f"\n  {name}" in text for name in names)
        assert f"\n{len(names)} parameters stand in the way" in text
        assert not autopilot.of("PARAM_SET")

        status, text = examine(config, autopilot.url, write=True, ask=lambda question: True)
        assert status == 0
        assert text.count("read back") == len(names)
        assert "Reboot the autopilot, for" in text
        assert {each.message.param_id for each in autopilot.of("PARAM_SET")} == set(names)
        assert set(names) <= set(autopilot.parameters.stored), "lost with the power"

        document = json.loads(examine(config, autopilot.url, as_json=True)[1])
        assert document["in_the_way"] == []
        assert document["vehicle"]["firmware"] == firmware
        assert document["n_examined"] > 10


def test_who_says_no_has_nothing_set(config: Config) -> None:
    asked: list[str] = []

    def refuse(question: str) -> bool:
        asked.append(question)
        return False

    with quick_autopilot("px4", "udpin:127.0.0.1:0") as autopilot:
        status, _ = examine(config, autopilot.url, write=True, ask=refuse)
        assert (status, asked) == (1, ["Set 4 parameters of PX4, system 1? [y/N] "])
        assert not autopilot.of("PARAM_SET")


def test_as_json(config: Config) -> None:
    with quick_autopilot("px4", "udpin:127.0.0.1:0") as autopilot:
        autopilot.parameters["EKF2_EV_POS_X"] = 0.25
        status, text = examine(config, autopilot.url, as_json=True, write=True, yes=True)
        document = json.loads(text)
        assert (status, document["reboot_needed"], document["refused"]) == (0, True, [])
        assert {"name": "EKF2_EV_POS_X", "from": 0.25, "to": 0.0, "reboot": False} in document[
            "written"
        ]
        assert autopilot.parameters["EKF2_EV_CTRL"] == 7


def test_integers_of_px4_keep_their_bits(config: Config) -> None:
    with quick_autopilot("px4", "udpin:127.0.0.1:0") as autopilot:
        # minus one is no number when it is taken for a float
        autopilot.parameters["EKF2_EV_QMIN"] = -1
        _, text = examine(config, autopilot.url, as_json=True)
        (found,) = [
            each for each in json.loads(text)["in_the_way"] if each["name"] == "EKF2_EV_QMIN"
        ]
        assert found["value"] == -1


def test_what_the_autopilot_keeps_is_said(config: Config) -> None:
    with quick_autopilot("ardupilot", "udpin:127.0.0.1:0") as autopilot:
        autopilot.parameters.refused.add("VISO_TYPE")
        status, text = examine(config, autopilot.url, write=True, yes=True)
        assert status == 1
        assert "not set: VISO_TYPE: the autopilot keeps 0, 1 was set" in text
        assert autopilot.parameters["EK3_SRC1_POSXY"] == 6


def test_a_type_set_to_3_before_is_set_to_1(config: Config) -> None:
    with quick_autopilot("ardupilot", "udpin:127.0.0.1:0") as autopilot:
        autopilot.parameters["VISO_TYPE"] = 3
        status, text = examine(config, autopilot.url, write=True, yes=True)
        assert status == 0
        assert "VISO_TYPE: 3 -> 1, read back" in text
        assert autopilot.parameters["VISO_TYPE"] == 1


def test_lost_packets_are_asked_for_again(config: Config) -> None:
    with quick_autopilot("px4", "udpin:127.0.0.1:0", loss=0.15, seed=3) as autopilot:
        status, _ = examine(config, autopilot.url, write=True, yes=True)
        autopilot.loss = 0.0
        assert status == 0
        assert autopilot.parameters["EKF2_HGT_REF"] == 3


def test_nothing_is_set_in_flight(config: Config) -> None:
    with quick_autopilot("px4", "udpin:127.0.0.1:0") as autopilot:
        autopilot.arm()
        with pytest.raises(SourceError, match="is armed; nothing is set in flight"):
            examine(config, autopilot.url, write=True, yes=True)
        assert not autopilot.of("PARAM_SET")


def test_mode_off_is_examined_for_odometry(config: Config) -> None:
    config = replace(config, feedback=FeedbackConfig(mode="off"))
    with quick_autopilot("px4", "udpin:127.0.0.1:0") as autopilot:
        status, text = examine(config, autopilot.url)
        assert status == 1
        assert "feedback.mode is off; examined for odometry" in text


def test_slow_serial_line(config: Config, tmp_path: Path) -> None:
    with quick_autopilot("ardupilot", f"pty:{tmp_path / 'tty'}") as autopilot:
        url = autopilot.url.rsplit(":", 1)[0] + ":57600"
        status, text = examine(config, url)
        assert status == 1
        assert "SERIAL1_BAUD    is 57600, wanted 230400 or more" in text
        assert "\nno IMU will be asked for: 57600 baud have no room for it; set SERIAL" in text
        autopilot.parameters["SCHED_LOOP_RATE"] = 50
        _, text = examine(config, autopilot.url)
        assert "\nIMU: HIGHRES_IMU at 100 Hz will be asked for" in text
        assert "SCHED_LOOP_RATE is 50, wanted 63 or more" in text


def test_it_says_nothing_but_that_it_is_there(config: Config) -> None:
    with quick_autopilot("px4", "udpin:127.0.0.1:0") as autopilot:
        examine(config, autopilot.url)
        assert {each.kind for each in autopilot.received} == {"HEARTBEAT", "PARAM_REQUEST_READ"}
        assert {(each.system, each.component) for each in autopilot.received} == {
            (1, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        }


def test_beside_a_daemon_it_goes_through_its_router(config: Config, tmp_path: Path) -> None:
    link, place = free_port(), free_port()
    config = replace(
        config,
        link=LinkConfig(url=f"udpin:127.0.0.1:{link}"),
        router=RouterConfig((f"tcpin:0.0.0.0:{place}",)),
    )

    async def run() -> tuple[int, str]:
        port = PymavlinkPort(config.link, config.router, FlightClock())
        source = {"name": "autopilot", "detail": "ArduPilot, system 1, IMU 99 of 100 Hz"}
        document = {"feedback": {"latency_p50_ms": 48.2}, "sources": [source]}
        daemon = StatusSocket(tmp_path / "status.sock", lambda: document, lambda text: None)
        await daemon.start()
        running = asyncio.ensure_future(port.run(lambda message, t_ns: None))
        try:
            return await asyncio.to_thread(examine, config, config.link.url)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            await daemon.stop()

    with quick_autopilot("ardupilot", f"udpout:127.0.0.1:{link}") as autopilot:
        autopilot.parameters["VISO_TYPE"] = 1
        status, text = asyncio.run(run())
    assert status == 1
    assert f"by tcp:127.0.0.1:{place}" in text
    assert "VISO_DELAY_MS   is 10, wanted 48" in text
    assert "the daemon hears ArduPilot, system 1, IMU 99 of 100 Hz\n" in text


async def test_link_held_by_a_daemon_without_a_router(config: Config, tmp_path: Path) -> None:
    daemon = StatusSocket(tmp_path / "status.sock", dict, lambda text: None)
    await daemon.start()
    try:
        with pytest.raises(SourceError, match=r'router.clients = \["tcpin::5760"\]'):
            await asyncio.to_thread(examine, config, "serial:/dev/ttyACM0:115200")
    finally:
        await daemon.stop()


def test_no_autopilot(config: Config, tmp_path: Path) -> None:
    with (
        within(4.0),
        pytest.raises(SourceError, match="tty: not there; is the autopilot plugged in"),
    ):
        examine(config, f"serial:{tmp_path / 'tty'}:115200")


def test_usage(config: Config) -> None:
    with pytest.raises(ConfigError, match="is empty; it says where"):
        doctor(config)
    with pytest.raises(InputError, match="add --yes"):
        doctor(config, write=True, as_json=True)
