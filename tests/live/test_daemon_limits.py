"""Missing prerequisites of the daemon, reload of its configuration, and its end.

Each of these needs a daemon of its own, most of them not for long.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path

import pytest

from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_wire import free_port
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import STOP_S, Flying, source
from tests.support.processes.program import refused
from tests.support.processes.strain import Strain

PATTERN = ("camera.source=pattern", "camera.width=160", "camera.height=120", "camera.rate_hz=5")
NO_DEPTH = "depth.enabled=false"


def assert_stops_soon(daemon: Daemon, strain: Strain) -> None:
    told_ns = time.monotonic_ns()
    took_s = daemon.stop()
    assert took_s < strain.allowed_s(STOP_S, told_ns)
    assert daemon.lines[-1].text == "companion: stopped"
    assert not daemon.said("Traceback")


def test_a_device_for_the_depth_that_there_is_not(tmp_path: Path) -> None:
    with Daemon(tmp_path, *PATTERN, "opencl.device=no such device") as daemon:
        run = daemon.ended(60)
    assert run.status == 2
    (line,) = [line for line in run.stderr.splitlines() if "companion: error: " in line]
    assert "no such device" in line and "opencl.device" in line


def test_a_wrong_calibration_is_told_before_there_is_a_camera(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("width = 640\nheight = 480\n")
    url = f"camera.url=http://127.0.0.1:{free_port()}/stream"
    settings = ("camera.source=network", url, f"camera.calibration={wrong}", NO_DEPTH)
    with Daemon(tmp_path, *settings) as daemon:
        assert "wrong.toml: the key fx is missing" in refused(daemon.ended(60))


@pytest.mark.parametrize("missing", ["camera", "autopilot"])
def test_a_device_that_stays_missing_ends_it(tmp_path: Path, missing: str) -> None:
    there = {
        "camera": ("camera.source=network", f"camera.url=http://127.0.0.1:{free_port()}/stream"),
        "autopilot": PATTERN,
    }[missing]
    settings = (*there, NO_DEPTH, "expert.daemon.missing_device_s=1.5")
    with FakeAutopilot("ardupilot", f"udpout:127.0.0.1:{free_port()}") as autopilot:
        url = autopilot.url if missing == "camera" else f"udpin:127.0.0.1:{free_port()}"
        with Daemon(tmp_path, *settings, f"link.url={url}") as daemon:
            run = daemon.ended(60)
    assert run.status == 1
    (line,) = [line for line in run.stderr.splitlines() if "companion: error: " in line]
    assert f"the {missing} has been" in line and "expert.daemon.missing_device_s" in line


def test_before_there_is_anything(tmp_path: Path) -> None:
    """It comes up without camera and autopilot, refuses a second one, and ends when told."""
    settings = (
        "camera.source=network", f"camera.url=http://127.0.0.1:{free_port()}/stream",
        f"link.url=udpin:127.0.0.1:{free_port()}", NO_DEPTH,
    )  # fmt: skip
    with Strain() as strain, Daemon(tmp_path, *settings) as daemon:
        health = daemon.until(
            lambda health: source(health, "camera")["state"] == "missing", "camera missing"
        )
        assert source(health, "autopilot")["state"] in ("missing", "opening")
        assert health["tracker"] == "waiting for the camera"
        with Daemon(tmp_path, *settings) as second:
            assert "another companion runs here already" in refused(second.ended(60))
        assert_stops_soon(daemon, strain)


def test_told_to_read_its_configuration_again(tmp_path: Path) -> None:
    """What can be taken over is, what cannot is named, and what is wrong changes nothing."""
    config = tmp_path / "companion.toml"
    config.write_text("[expert.feedback]\nmin_quality = 30\n")
    with Daemon(tmp_path, *PATTERN, NO_DEPTH, config=config) as daemon:
        daemon.until(lambda health: True, "it answers")
        for text, answer in (
            ("[expert.feedback]\nmin_quality = 40\n", "configuration read again"),
            ("[link]\nurl = 'udpin:127.0.0.1:9'\n", "these need a restart: link.url"),
            ("[expert.feedback]\nmin_quality = 4000\n", "configuration not taken over"),
            ("no table", "configuration not taken over"),
        ):
            config.write_text(text)
            sent_ns = time.monotonic_ns()
            daemon.send(signal.SIGHUP)
            line = daemon.line(answer, after_ns=sent_ns).text
            assert ("restart" in line) == ("restart" in answer)
        assert daemon.running
        config.unlink()
        sent_ns = time.monotonic_ns()
        daemon.send(signal.SIGHUP)
        assert "companion.toml" in daemon.line("not taken over", after_ns=sent_ns).text
        assert daemon.status()["tracker"]


def test_a_folder_that_cannot_be_written(tmp_path: Path) -> None:
    """The pose goes on without a recording; that there is none is told again and again."""
    (tmp_path / "a_file").write_text("")
    with Flying(tmp_path, f"daemon.flights={tmp_path}/a_file/flights") as flying:
        flying.until_source("autopilot", "running")
        flying.until_source("camera", "running")
        flying.take_off()
        assert "a_file" in flying.daemon.line("is started again: results: ").text
        flying.until_told(" restarted")
        went_on_ns = time.monotonic_ns()
        flying.until_stage("results", lambda found: found["n_restarted"] >= 2)
        flying.until_sending()
        flying.assert_went_on(went_on_ns)
        flying.assert_true_poses()
        flying.autopilot.disarm()
        flying.daemon.line("disarmed")
        flying.assert_stops()
        assert not flying.daemon.said("Traceback")


def test_a_disk_that_is_full(tmp_path: Path) -> None:
    """Nothing can be written any more in mid-flight; told to end while it tries to, it ends."""
    with Flying(tmp_path) as flying:
        flying.until_source("autopilot", "running")
        flying.until_source("camera", "running")
        flying.take_off()
        flying.until_stage("results", lambda found: found["detail"] != "starting")
        full_ns = flying.daemon.fill_disk_of("results")
        time.sleep(2.0)
        flying.assert_went_on(full_ns)
        disarmed_ns = time.monotonic_ns()
        flying.autopilot.disarm()
        flying.daemon.line("disarmed")
        flying.assert_stops()
        flying.daemon.line("results", after_ns=disarmed_ns)
        flying.assert_true_poses()
        assert not flying.daemon.said("Traceback")
