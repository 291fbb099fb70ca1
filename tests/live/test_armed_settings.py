"""Settings held while armed survive a daemon that is killed in the air, and SIGHUP."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.ground_station import GroundStation
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import Flying

FILE = ".armed.json"


@contextmanager
def begun_again(flying: Flying) -> Iterator[Daemon]:
    """The daemon is killed, and started as the service manager would."""
    before = flying.daemon
    before.send(signal.SIGKILL)
    before._running.wait(60)
    again = Daemon(before.folder)
    again._command = before._command
    with again as flying.daemon:
        yield again


def test_what_the_ground_has_switched_off_stays_off(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    clients = f'router.clients=["tcpin:127.0.0.1:{port}"]'
    with Flying(tmp_path, clients, "recorder.enabled=false") as flying:
        flying.until_source("camera", "running")
        flying.until_source("autopilot", "running")
        flying.autopilot.arm()
        flying.daemon.until(lambda health: health["flight"], "armed")
        with GroundStation(port) as ground:
            ground.heard("HEARTBEAT")
            assert ground.set("FB_MODE", 0.0) == 0.0
        flying.daemon.until(lambda _: (flying.daemon.flights / FILE).exists(), "written")
        killed_ns = time.monotonic_ns()
        with begun_again(flying) as daemon:
            daemon.line("feedback.mode = off (by the ground)")
            known = daemon.until(lambda health: health["quality"] > 20 and health["scale"])
            assert known["feedback"]["mode"] == "off"
            assert known["set_by_ground"] == {"feedback.mode": "off"}
            flying.autopilot.unplug()
            flying.until_source("autopilot", "silent")
            flying.autopilot.plug()
            flying.until_source("autopilot", "running")
            rebooted_ns = time.monotonic_ns()
            flying.autopilot.reboot()  # in the air, which is no disarming
            daemon.line("autopilot rebooted", after_ns=rebooted_ns)
            time.sleep(4.0)  # what is waited for is that nothing happens
            assert daemon.status()["feedback"]["mode"] == "off"
            flying.autopilot.arm()
            daemon.line("companion: armed", after_ns=rebooted_ns)
            assert daemon.status()["flight"] == known["flight"], "the flight goes on"
            assert not [t for t in flying.poses.came_s if t > killed_ns * 1e-9]
            flying.autopilot.disarm()
            daemon.until(
                lambda health: health["feedback"]["mode"] == "odometry"
                and health["set_by_ground"] == {}, "let go",
            )  # fmt: skip
            daemon.until(lambda _: not (daemon.flights / FILE).exists(), "no longer held")
            assert not daemon.said("Traceback")


def test_limits_wait_for_disarming(tmp_path: Path) -> None:
    """Of a configuration that is read again, and of one that a killed daemon finds changed."""
    config = tmp_path / "my.toml"
    config.write_text("[expert.feedback]\nmin_quality = 30\nmax_sigma_m = 1.0\nmax_jump_m = 1.0\n")
    port = free_port(socket.SOCK_STREAM)
    settings = (f'router.clients=["tcpin:127.0.0.1:{port}"]', "recorder.enabled=false")
    with Flying(tmp_path, *settings, start=False) as flying:
        flying.daemon._command += ["--config", str(config)]
        flying.start()
        flying.until_source("camera", "running")
        flying.until_source("autopilot", "running")
        flying.autopilot.arm()
        flying.daemon.until(lambda health: health["flight"], "armed")
        config.write_text(
            "[expert.feedback]\nmin_quality = 5\nmax_sigma_m = 0.5\nmax_jump_m = 9.0\n"
        )
        flying.daemon.send(signal.SIGHUP)
        line = flying.daemon.line("looser and wait for disarming").text
        assert "expert.feedback.min_quality" in line and "expert.feedback.max_jump_m" in line
        assert "max_sigma_m" not in line
        flying.until_told("limits", flying.daemon.started_ns)

        def limits() -> tuple[float, float, float]:
            with GroundStation(port) as ground:
                ground.heard("HEARTBEAT")
                found = ground.parameters()
            return found["FB_MIN_QUALITY"], found["FB_MAX_SIGMA_M"], found["FB_MAX_JUMP_M"]

        assert limits() == (30.0, 0.5, 1.0)
        with begun_again(flying) as daemon:
            daemon.until(lambda health: health["flight"], "armed")
            assert limits() == (30.0, 0.5, 1.0)
            flying.autopilot.disarm()
            daemon.line("held changes take effect")
            assert limits() == (5.0, 0.5, 9.0)
            assert not daemon.said("Traceback")
