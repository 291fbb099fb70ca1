"""sd_notify on a real datagram socket; and the unit file, as systemd reads it."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.system.service_manager import ServiceManager
from drivers.system.status_socket import SERVICE_FOLDER
from tests.support.waiting import PATIENCE_S

UNIT = Path(__file__).parents[4] / "systemd/companion.service"


@pytest.fixture(params=["path", "abstract"])
def listener(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, socket.socket]]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        if request.param == "path":
            name = str(tmp_path / "notify")
            listening.bind(name)
        else:
            name = f"@companion-test-{os.getpid()}"
            listening.bind("\0" + name[1:])
        listening.settimeout(1)
        yield name, listening


def test_notices_arrive_as_systemd_reads_them(listener: tuple[str, socket.socket]) -> None:
    name, listening = listener
    manager = ServiceManager({"NOTIFY_SOCKET": name})
    manager.ready("tracking; feedback 30/s")
    manager.status("one\nREADY=0\nline")
    manager.alive()
    manager.stopping()
    manager.extend_timeout(1.5)
    heard = [listening.recv(4096).decode() for _ in range(5)]
    assert heard == [
        "READY=1\nSTATUS=tracking; feedback 30/s",
        "STATUS=one READY=0 line",
        "WATCHDOG=1",
        "STOPPING=1",
        "EXTEND_TIMEOUT_USEC=1500000",
    ]
    manager.close()
    manager.alive()  # says nothing, and does not fail
    assert manager.problem == ""


def test_reloading_bears_the_monotonic_time(listener: tuple[str, socket.socket]) -> None:
    name, listening = listener
    manager = ServiceManager({"NOTIFY_SOCKET": name})
    before_us = time.monotonic_ns() // 1000
    manager.reloading()
    first, second = listening.recv(4096).decode().split("\n")
    assert first == "RELOADING=1"
    key, value = second.split("=")
    assert key == "MONOTONIC_USEC"
    assert before_us <= int(value) <= time.monotonic_ns() // 1000
    manager.close()


@pytest.mark.real_time
def test_a_manager_that_does_not_read_neither_blocks_nor_raises(
    listener: tuple[str, socket.socket],
) -> None:
    name, _ = listener
    manager = ServiceManager({"NOTIFY_SOCKET": name})
    begun = time.monotonic()
    for _ in range(5000):
        manager.alive()
    assert time.monotonic() - begun < 1
    assert "cannot be told" in manager.problem
    manager.close()


def test_a_manager_that_is_gone_is_named(tmp_path: Path) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": str(tmp_path / "gone")})
    manager.ready()
    assert manager.problem == "the service manager cannot be told: No such file or directory"
    manager.close()


def test_without_a_manager_nothing_is_said() -> None:
    manager = ServiceManager({})
    manager.ready()
    manager.alive()
    assert manager.problem == ""


@pytest.mark.parametrize("address", ["vsock:2:1234", "relative", "/", "@"])
def test_an_address_of_another_kind_is_named(address: str) -> None:
    manager = ServiceManager({"NOTIFY_SOCKET": address})
    assert address in manager.problem


def settings() -> dict[str, str]:
    lines = (line for line in UNIT.read_text("utf-8").splitlines() if "=" in line)
    return dict(line.split("=", 1) for line in lines if not line.startswith("#"))


def test_unit_and_program_agree() -> None:
    unit = settings()
    assert unit["Type"] == "notify"
    assert unit["ExecReload"].endswith("-HUP $MAINPID")
    assert Path("/run", unit["RuntimeDirectory"]) == SERVICE_FOLDER
    assert unit["WorkingDirectory"] == f"/var/lib/{unit['StateDirectory']}"
    assert unit["StartLimitIntervalSec"] == "0"
    assert not {"After", "Wants", "Requires"} & unit.keys()  # the network above all


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_systemd_has_nothing_to_say_against_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / UNIT.name
    text = UNIT.read_text("utf-8")
    unit.write_text(text.replace("/opt/companion/bin/companion run", "/bin/true run"))
    verified = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert (verified.returncode, verified.stderr.strip()) == (0, "")


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_it_may_do_little() -> None:
    rated = subprocess.run(
        ["systemd-analyze", "security", "--no-pager", "--offline=true", str(UNIT)],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    if "unrecognized option" in rated.stderr:
        pytest.skip("this systemd rates no units that are not installed")
    level = rated.stdout.strip().splitlines()[-1].split(":")[1].split()[0]
    assert float(level) <= 3.0
