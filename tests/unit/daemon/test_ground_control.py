"""Commands and parameters of the ground: permissions, kept settings, and the HEARTBEAT."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config, ControlConfig, DistributedConfig, FeedbackConfig, LinkConfig
from companion.config.setting_keys import value_of_key
from companion.config_file import to_toml
from companion.daemon.component_state import (
    ACTIVE,
    BOOT,
    CALIBRATING,
    CRITICAL,
    STANDBY,
    component_state,
)
from companion.daemon.control.flight_parameters import PARAMETERS, number_of, value_of
from companion.daemon.control.ground_control import CHANGES_AT_ONCE, TEXTS_AT_ONCE, GroundControl
from companion.daemon.control.kept_settings import kept_over
from companion.daemon.control.reload import FIXED_KEYS, FIXED_SECTIONS
from companion.daemon.control.tightening import may_change
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flights import Flights
from companion.errors import ConfigError
from companion.health import Health, SourceHealth, StageHealth
from companion.pilot_messages import position_lost
from companion.timing.clock import FlightClock
from drivers.mavlink.autopilot_link import AutopilotLink
from drivers.mavlink.ground.command_server import BUSY
from drivers.mavlink.ground.parameter_server import LONGEST_NAME, NOT_NOW, OUT_OF_RANGE, SET
from drivers.system.journal import Journal
from tests.support.autopilot.memory_port import MemoryPort


class Controlled:
    """A daemon of which only the configuration counts."""

    def __init__(self, config: Config) -> None:
        self.config, self.armed = config, False

    def take_over(self, config: Config) -> None:
        self.config = config

    def prepare(self) -> None:
        raise AssertionError("there is no flight")

    begin_flight = prepare


def control_of(config: Config) -> tuple[GroundControl, Controlled, MemoryPort]:
    daemon, port, clock, journal = Controlled(config), MemoryPort(), FlightClock(), Journal()
    link = AutopilotLink(LinkConfig(), port, clock, lambda _: None, lambda _: None)

    def never(*_: Any) -> Any:
        raise AssertionError

    dates = FlightDates(clock, lambda: None, lambda: True)
    flights = Flights(clock, journal, never, never, dates, never)
    return (
        GroundControl(daemon, link, clock, journal, flights, {}, {}, lambda _: None), daemon, port,
    )  # fmt: skip


def test_names_fit_and_keys_can_change_in_flight() -> None:
    assert all(0 < len(name) <= LONGEST_NAME and name.isascii() for name in PARAMETERS)
    for parameter in PARAMETERS.values():
        assert parameter.full_key.split(".")[-2] not in FIXED_SECTIONS
        assert parameter.full_key not in FIXED_KEYS - {"feedback.mode"}


@pytest.mark.parametrize("name", PARAMETERS)
def test_what_is_read_can_be_set(name: str) -> None:
    config, parameter = Config(), PARAMETERS[name]
    number = number_of(config, parameter)
    value = value_of(config, parameter, number)
    assert value == value_of_key(config, parameter.full_key)
    assert type(value) is type(value_of_key(config, parameter.full_key))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("FB_MODE", 4.0), ("FB_MODE", 0.5), ("FB_MODE", -1.0), ("MAP_DENSE", 2.0),
        ("FB_MIN_QUALITY", 20.5), ("FB_MIN_QUALITY", 0.0), ("FB_MAX_SIGMA_M", math.nan),
        ("FB_MAX_SIGMA_M", math.inf), ("STR_KBIT_S", -1.0), ("MAP_STRIDE", 1e30),
    ],
)  # fmt: skip
def test_values_that_a_file_could_not_have_are_refused(name: str, value: float) -> None:
    control, daemon, port = control_of(Config())
    assert control.set(name, value) == OUT_OF_RANGE
    assert daemon.config == Config()
    (text,) = port.of("STATUSTEXT")[:1]
    assert text.text == f"Companion: {name} refused: out of range"


def test_a_float_of_four_bytes_is_the_number_that_was_meant() -> None:
    control, daemon, _ = control_of(Config())
    assert control.set("MAP_VOXEL_M", 0.20000000298023224) == SET
    assert daemon.config.cloud.voxel_m == 0.2
    assert control.changed == {"cloud.voxel_m": 0.2}


def test_while_armed_poses_are_not_made_easier_to_believe() -> None:
    control, daemon, _ = control_of(Config())
    assert control.set("FB_MODE", 1.0) == SET
    daemon.armed = True
    looser = {
        "FB_MAX_SIGMA_M": 5.0, "FB_MIN_QUALITY": 5.0, "FB_MAX_GAP_MS": 300.0, "FB_RESUME_S": 0.5,
    }  # fmt: skip
    stricter = {
        "FB_MAX_SIGMA_M": 0.5, "FB_MIN_QUALITY": 50.0, "FB_MAX_GAP_MS": 100.0, "FB_RESUME_S": 2.0,
    }  # fmt: skip
    for name, value in looser.items():
        assert control.set(name, value) == NOT_NOW
    for name, value in stricter.items():
        assert control.set(name, value) == SET
        assert control.value(name) == value
    assert control.set("MAP_DENSE", 0.0) == SET


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name.startswith("FB_")])
def test_while_armed_no_parameter_makes_a_pose_easier_to_believe(name: str) -> None:
    """Every value that a ground station may try, both ways from where it stands."""
    control, daemon, _ = control_of(Config(feedback=FeedbackConfig(mode="odometry")))
    daemon.armed = True
    before = control.value(name)
    for value in (0.5 * before, before + 1.0, 2.0 * before, 0.0, 1.0, 2.0, 50.0, 200.0):
        now = value_of_key(daemon.config, PARAMETERS[name].full_key)
        outcome = control.set(name, value)
        after = value_of_key(daemon.config, PARAMETERS[name].full_key)
        assert may_change(PARAMETERS[name].full_key, now, after)
        assert outcome == SET or (after == now and control.value(name) != value)


def test_while_armed_feedback_can_be_switched_off_only() -> None:
    control, daemon, _ = control_of(Config())
    assert control.set("FB_MODE", 1.0) == SET
    daemon.armed = True
    assert control.set("FB_MODE", 2.0) == NOT_NOW
    assert control.set("FB_MODE", 1.0) == SET  # as it is
    assert control.set("FB_MODE", 0.0) == SET
    assert control.set("FB_MODE", 1.0) == NOT_NOW
    assert daemon.config.feedback.mode == "off"


def test_a_dense_map_that_another_machine_makes_is_not_ours_to_switch() -> None:
    elsewhere = DistributedConfig(enabled=True, stages=("tracking",))
    control, daemon, _ = control_of(Config(distributed=elsewhere))
    assert control.set("MAP_DENSE", 0.0) == NOT_NOW
    assert daemon.config.depth.enabled


def test_settings_that_flutter_are_held() -> None:
    control, _, _ = control_of(Config())
    results = [control.set("MAP_DENSE", float(n % 2)) for n in range(200)]
    assert CHANGES_AT_ONCE - 2 <= results.count(SET) / 2 <= CHANGES_AT_ONCE + 70
    assert NOT_NOW in results


def test_refusals_do_not_keep_back_what_a_pilot_has_to_know() -> None:
    control, _, port = control_of(Config())
    for _ in range(100):
        control.set("MAP_DENSE", 7.0)
    assert 1 <= len(port.of("STATUSTEXT")) <= TEXTS_AT_ONCE
    assert control._link.say(position_lost("lost"))


def test_without_a_flight_there_is_nothing_to_map() -> None:
    control, _, _ = control_of(Config())
    for outcome in (control._begin_new_map([0.0] * 7), control._take_snapshot([0.0] * 7)):
        assert getattr(outcome, "result", None) == BUSY


def loader(config: Config) -> Callable[[], Config]:
    return lambda: config


def test_what_the_ground_has_set_is_kept_if_the_configuration_says_so(tmp_path: Path) -> None:
    path = tmp_path / "kept.toml"
    config = Config(control=ControlConfig(keep=str(path)))
    assert kept_over(loader(config)) == (config, {})
    control, daemon, _ = control_of(config)
    control.set("FB_MODE", 2.0)
    control.set("MAP_DENSE", 0.0)
    control.set("STR_KBIT_S", 400.0)
    control.close(5.0)
    kept, changed = kept_over(loader(config))
    assert to_toml(kept) == to_toml(daemon.config)
    assert changed == {
        "feedback.mode": "vision_position", "depth.enabled": False,
        "expert.stream.budget_kbit_s": 400.0,
    }  # fmt: skip
    without, _, _ = control_of(Config())
    without.set("MAP_DENSE", 0.0)
    assert [each.name for each in tmp_path.iterdir()] == ["kept.toml"]


def test_a_kept_file_of_the_version_before_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "kept.toml"
    path.write_text("features.n_features = 700\nfeedback.mode = 'odometry'\n", "utf-8")
    kept, changed = kept_over(loader(Config(control=ControlConfig(keep=str(path)))))
    assert changed == {"expert.features.n_features": 700, "feedback.mode": "odometry"}
    assert (kept.features.n_features, kept.feedback.mode) == (700, "odometry")
    assert "features.n_features is now expert.features.n_features" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["link.url = 'x'", "expert.depth.stride = 99", "depth.strid = 1", "?"]
)
def test_a_kept_file_that_no_ground_has_written_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "kept.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"kept\.toml"):
        kept_over(loader(Config(control=ControlConfig(keep=str(path)))))


@pytest.mark.parametrize(
    ("camera", "flight", "tracker", "localisation", "state"),
    [
        ("missing", "", "waiting for the camera", True, BOOT),
        ("running", "", "waiting for the autopilot", True, STANDBY),
        ("running", "f", "starting", True, CALIBRATING),
        ("running", "f", "initialising", True, CALIBRATING),
        ("running", "f", "tracking", True, ACTIVE),
        ("running", "f", "dead reckoning", True, ACTIVE),
        ("running", "f", "lost", True, CRITICAL),
        ("running", "f", "tracking", False, CRITICAL),
        ("frozen", "f", "tracking", True, CRITICAL),
        ("driver fault", "f", "tracking", True, CRITICAL),
    ],
)
def test_the_heartbeat_says_how_it_is(
    camera: Any, flight: str, tracker: str, localisation: bool, state: int
) -> None:
    health = Health(
        0, sources=(SourceHealth("camera", camera),), flight=flight, tracker=tracker,
        stages=(StageHealth("localisation", alive=localisation),) if flight else (),
    )  # fmt: skip
    assert component_state(health) == state


async def test_it_runs_until_it_is_cancelled() -> None:
    control, _, _ = control_of(Config())
    task = asyncio.ensure_future(control.run())
    await asyncio.sleep(0.2)
    assert not task.done()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
