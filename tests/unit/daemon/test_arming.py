"""Changes held until disarming: over a crash of the daemon, and false disarming."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.config import Config, FeedbackConfig
from companion.config.setting_keys import with_values
from companion.daemon.control import armed_settings, arming
from companion.daemon.control.armed_settings import FILE, read_settings
from companion.daemon.control.arming import CERTAIN_S, Arming
from companion.daemon.control.tightening import WHILE_ARMED
from companion.products.newest_file import NewestFile

READ = Config(feedback=FeedbackConfig(mode="odometry"))
OFF = {"feedback.mode": "off"}


class Autopilot:
    """When it was started, as far as its clock tells, and whether it is heard."""

    def __init__(self) -> None:
        self.boot_s: float | None = 100.0
        self.heard = True

    def arming(self, flights: Path, read: Config = READ) -> tuple[Arming, NewestFile]:
        """A daemon that begins."""
        failed: list[str] = []
        file = NewestFile(flights / FILE, failed.append)
        before, _ = read_settings(flights, read)
        return Arming(file, before, lambda: self.boot_s, lambda: self.heard), file


@pytest.fixture
def autopilot() -> Autopilot:
    return Autopilot()


def in_flight(
    autopilot: Autopilot, flights: Path, by_ground: dict[str, Any], config: Config | None = None
) -> None:
    """A daemon that armed at 1000 s, was told this by the ground, and was killed."""
    flown, file = autopilot.arming(flights)
    assert not flown.take(False, 900.0) and not flown.take(True, 1000.0)
    flown.hold(READ, {}, 1000.0)
    flown.hold(config or with_values(READ, by_ground), by_ground, 1001.0)
    assert file.wait(60)
    file.close(0.0)


def test_off_stays_off_over_a_crash_until_disarming(autopilot: Autopilot, tmp_path: Path) -> None:
    in_flight(autopilot, tmp_path, OFF)
    after, file = autopilot.arming(tmp_path)
    assert after.armed  # as it was last known
    found = after.resume(READ)
    assert found.config.feedback.mode == "off"
    assert (found.by_ground, found.waiting) == (OFF, {"feedback.mode": "odometry"})
    assert not after.take(True, 1010.0)
    after.hold(found.config, found.by_ground, 1010.0)
    assert not after.step(1500.0)
    assert not after.take(False, 2000.0)
    assert not after.step(2000.0 + CERTAIN_S / 2)
    assert after.step(2000.0 + CERTAIN_S)
    assert after.let_go() == {"feedback.mode": "odometry"}
    assert file.wait(60) and not (tmp_path / FILE).exists()
    file.close(0.0)


def test_limits_made_stricter_stay_and_looser_ones_wait(
    autopilot: Autopilot, tmp_path: Path
) -> None:
    in_flight(autopilot, tmp_path, {"expert.feedback.max_sigma_m": 0.5})
    loosened = with_values(
        READ, {"expert.feedback.min_quality": 5, "expert.feedback.max_gap_ms": 100.0}
    )
    after, file = autopilot.arming(tmp_path, loosened)
    found = after.resume(loosened)
    assert found.config == with_values(
        READ, {"expert.feedback.max_sigma_m": 0.5, "expert.feedback.max_gap_ms": 100.0}
    )
    assert found.waiting == {"expert.feedback.min_quality": 5}
    file.close(0.0)


def test_what_the_ground_had_switched_on_goes_on(autopilot: Autopilot, tmp_path: Path) -> None:
    configured = Config()
    on = {"feedback.mode": "odometry"}
    in_flight(autopilot, tmp_path, on, with_values(configured, on))
    after, file = autopilot.arming(tmp_path, configured)
    found = after.resume(configured)
    assert (found.config.feedback.mode, found.waiting) == ("odometry", {})
    file.close(0.0)


def test_a_silent_link_disarms_nobody(autopilot: Autopilot, tmp_path: Path) -> None:
    in_flight(autopilot, tmp_path, OFF)
    after, file = autopilot.arming(tmp_path)
    after.take(True, 1010.0)
    autopilot.heard = False
    assert after.armed and not after.step(9000.0)
    autopilot.heard = True
    after.take(False, 9001.0)
    autopilot.heard = False  # its word was the last that was heard
    assert not after.step(9010.0)
    file.close(0.0)


def test_an_autopilot_that_starts_anew_in_the_air_disarms_nobody(
    autopilot: Autopilot, tmp_path: Path
) -> None:
    in_flight(autopilot, tmp_path, OFF)
    after, file = autopilot.arming(tmp_path)
    after.take(True, 1010.0)
    after.take(False, 1200.0)  # says the new start of it
    autopilot.boot_s = None
    assert not after.step(1205.0)  # whose clock is not known yet
    autopilot.boot_s = 1198.0
    assert not after.step(1210.0)
    file.wait(60)
    file.close(0.0)
    again, other = autopilot.arming(tmp_path)  # and our own next start does not either
    assert again.resume(READ).config.feedback.mode == "off"
    again.take(False, 1220.0)
    assert not again.step(1230.0)
    again.take(True, 1300.0)
    again.hold(with_values(READ, OFF), OFF, 1300.0)
    again.take(False, 1400.0)  # the first disarming that is one
    assert again.step(1400.0 + CERTAIN_S)
    other.close(0.0)


def test_disarmed_while_no_daemon_ran(autopilot: Autopilot, tmp_path: Path) -> None:
    in_flight(autopilot, tmp_path, OFF)
    after, file = autopilot.arming(tmp_path)
    assert after.resume(READ).config.feedback.mode == "off"  # until that is known
    after.take(False, 1300.0)
    autopilot.boot_s = 101.0  # the same, with its clock's drift
    assert after.step(1300.0 + CERTAIN_S)
    file.close(0.0)


def test_all_was_without_power(
    autopilot: Autopilot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    in_flight(autopilot, tmp_path, OFF)
    monkeypatch.setattr(armed_settings, "computer_boot", lambda: "another start")
    monkeypatch.setattr(arming, "computer_boot", lambda: "another start")
    after, file = autopilot.arming(tmp_path)
    assert after.resume(READ).config.feedback.mode == "off"
    autopilot.boot_s = 3.0
    after.take(False, 10.0)
    assert after.step(10.0 + CERTAIN_S)
    file.close(0.0)


def test_disarmed_and_armed_again_at_once(autopilot: Autopilot, tmp_path: Path) -> None:
    in_flight(autopilot, tmp_path, OFF)
    after, file = autopilot.arming(tmp_path)
    after.take(True, 1010.0)
    after.take(False, 1100.0)
    assert after.take(True, 1101.0)  # let go first
    file.close(0.0)


@pytest.mark.parametrize(
    "data", [b"", b"{", b"[]", b'{"values": {"feedback.mode": 3}, "by_ground": {}}']
)
def test_a_file_that_a_power_cut_has_damaged_sends_nothing(tmp_path: Path, data: bytes) -> None:
    (tmp_path / FILE).write_bytes(data)
    before, why = read_settings(tmp_path, READ)
    assert before is not None and FILE in why
    file = NewestFile(tmp_path / FILE, lambda _: None)
    began = Arming(file, before, lambda: 5.0, lambda: True)
    assert began.resume(READ).config == with_values(READ, OFF)
    began.take(False, 10.0)  # on the ground it is over at once
    assert began.step(10.0 + CERTAIN_S)
    file.close(0.0)


def test_limits_held_by_the_version_before_count_by_their_keys_now(
    autopilot: Autopilot, tmp_path: Path
) -> None:
    strict = {"expert.georeference.max_sigma_scale": 0.05, "expert.tracking.min_inliers": 30}
    in_flight(autopilot, tmp_path, strict)
    now = (tmp_path / FILE).read_text("ascii")
    assert "expert.tracking.min_inliers" in now
    (tmp_path / FILE).write_text(now.replace("expert.", ""), "ascii")
    after, file = autopilot.arming(tmp_path)
    found = after.resume(READ)
    assert (found.config, found.by_ground) == (with_values(READ, strict), strict)
    file.close(0.0)


def test_where_there_can_be_no_file_nothing_is_held(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert read_settings(tmp_path / "file" / "flights", READ) == (None, "")


def test_what_is_written_is_read_back_and_a_full_disk_is_reported(
    autopilot: Autopilot, tmp_path: Path
) -> None:
    in_flight(autopilot, tmp_path, OFF)
    assert read_settings(tmp_path, READ)[1] == ""
    assert set(json.loads((tmp_path / FILE).read_bytes())["values"]) == set(WHILE_ARMED)
    (tmp_path / "file").write_text("")
    failed: list[str] = []
    file = NewestFile(tmp_path / "file" / "below" / FILE, failed.append)
    file.put(b"{}")
    assert file.wait(60)
    assert FILE in failed[0]
    file.close(0.0)


def test_nothing_is_left_of_a_daemon_that_ended_disarmed(tmp_path: Path) -> None:
    assert read_settings(tmp_path, READ) == (None, "")
