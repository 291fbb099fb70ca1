"""The package on a booted Debian: what systemd makes of it, from installation to removal.

`make deb system-test`. It needs root, debootstrap, systemd-container (systemd-nspawn), Debian's
packages, 5 GB of disk, and some minutes; without these, and without a package, it is skipped. The
tests are one story, told in order. Not tried here: devices (there are none), and the real-time
policy, where root may not raise its own limits.
"""

from __future__ import annotations

import json
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.container import Container, lacking

REPOSITORY = Path(__file__).parents[2]
PACKAGES = sorted((REPOSITORY / "dist").glob("companion_*.deb"))
WHY_NOT = lacking() or ("" if PACKAGES else "needs dist/companion_*.deb: make deb")
CONFIG = """
[camera]
source = "file"
path = "/mnt/sample/survey"
calibration = "/mnt/sample/survey/camera.json"
repeat = true
[link]
url = "udpin:127.0.0.1:14550"
[daemon]
flight = "always"
[recorder]
least_free_mb = 100
"""
AUTOPILOT = """
[Service]
WorkingDirectory=/mnt
ExecStart=/opt/companion/bin/python -m tests.support.fake_autopilot --flight sample/survey \
  --url udpout:127.0.0.1:14550
Restart=always
StandardOutput=null
[Install]
WantedBy=multi-user.target
"""

pytestmark = [
    pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT),
    pytest.mark.timeout(1200),
]


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    package = PACKAGES[-1]
    needs = subprocess.run(
        ["dpkg-deb", "--field", str(package), "Depends"], check=True, capture_output=True, text=True
    ).stdout
    mnt = {"/mnt/sample": REPOSITORY / "sample", "/mnt/tests": REPOSITORY / "tests"}
    with Container(
        tmp_path_factory.mktemp("container"), platform.freedesktop_os_release()["VERSION_CODENAME"],
        tuple(name.strip() for name in needs.split(",")), kept=REPOSITORY / "build", mounts=mnt,
    ) as made:  # fmt: skip
        told("dpkg:", made.install(package).splitlines()[-1])
        (made.root / "etc/companion/companion.toml").write_text(CONFIG)
        autopilot = made.root / "etc/systemd/system/autopilot.service"
        autopilot.write_text(AUTOPILOT)
        wanted = made.root / "etc/systemd/system/multi-user.target.wants"
        (wanted / autopilot.name).symlink_to(f"/etc/systemd/system/{autopilot.name}")
        made.boot()
        yield made


def told(*words: object) -> None:
    print(time.strftime("%H:%M:%S"), *words, flush=True)


def status(container: Container) -> dict[str, Any]:
    said = container.run("companion", "status", "--json", check=False)
    document: dict[str, Any] = json.loads(said) if said.startswith("{") else {}
    return document


def shown(container: Container, name: str) -> str:
    said = container.run("systemctl", "show", "companion", "--property", name, "--value")
    return said.strip()


def until(such: Callable[[], Any], timeout_s: float, what: str) -> None:
    until_s = time.monotonic() + timeout_s
    while not such():
        assert time.monotonic() < until_s, f"not within {timeout_s:g} s: {what}"
        time.sleep(0.5)


def until_flying(container: Container, timeout_s: float = 240) -> dict[str, Any]:
    """Its status once it is active, tracks, and has camera and autopilot."""
    found: dict[str, Any] = {}

    def flies() -> bool:
        found.update(status(container))
        sources = [source["state"] == "running" for source in found.get("sources", ())]
        active = shown(container, "ActiveState") == "active"
        return active and all(sources) and found.get("tracker") in ("tracking", "coasting")

    try:
        until(flies, timeout_s, "a running service that tracks")
    except AssertionError:
        told(container.run("journalctl", "--unit=companion", "--no-pager", "--lines=40"))
        raise
    told("flies:", found["flight"], found["line"] if "line" in found else "")
    return found


def recordings(container: Container) -> list[str]:
    flights = container.root / "var/lib/companion/flights"
    return sorted(path.parent.name for path in flights.glob("*/flight.mcap"))


def assert_readable(container: Container, names: list[str]) -> None:
    """Every recording reads back, with its checksums, up to its last byte.

    Of a killed daemon's the end is missing, since systemd kills the rest of the service at once.
    """
    for name in names:
        folder = f"/var/lib/companion/flights/{name}"
        said = container.run("companion", "flights", "verify", folder, check=False).strip()
        told(said.partition("flights/")[2])
        cut = "cut short" in said and ", 0 bytes cannot be read" in said
        assert " whole " in said or cut, said


def test_unit_and_rules_are_well_formed(container: Container) -> None:
    assert container.run("systemd-analyze", "verify", "companion.service") == ""
    said = container.run("systemd-analyze", "security", "--no-pager", "companion.service")
    level = said.splitlines()[-1].split(":")[1].split()[0]
    told("exposure:", level)
    assert float(level) <= 3.0
    said = container.run("udevadm", "test", "/sys/class/mem/null", check=False)
    assert "99-companion.rules" in said
    assert "99-companion.rules:" not in said  # which is how it begins to tell of an error


def test_it_boots_into_the_running_service(container: Container) -> None:
    until_flying(container)
    assert shown(container, "User") == "companion"
    pid = shown(container, "MainPID")
    assert container.run("ps", "-o", "user=,ni=", "-p", pid).split() == ["compani+", "-10"]
    died = container.run(
        "journalctl", "--unit=companion", "--no-pager", "--grep=has died|linker", check=False
    )
    assert "died" not in died, died


def test_killed_it_comes_back(container: Container) -> None:
    before = recordings(container)
    time.sleep(5)  # something to lose
    container.run("kill", "-KILL", shown(container, "MainPID"))
    until(lambda: shown(container, "NRestarts") == "1", 30, "another start")
    until_flying(container)
    assert set(recordings(container)) > set(before)
    assert_readable(container, before)


def test_a_wedged_pose_loop_is_ended_by_the_watchdog(container: Container) -> None:
    before, n_before = recordings(container), int(shown(container, "NRestarts"))
    began_s = time.monotonic()
    while "Watchdog timeout" not in container.run("journalctl", "--unit=companion", "--no-pager"):
        assert time.monotonic() < began_s + 120
        container.run("pkill", "-STOP", "-f", "companion.stages.child localisation", check=False)
        time.sleep(0.2)
    told(f"watchdog after {time.monotonic() - began_s:.0f} s")
    until(lambda: int(shown(container, "NRestarts")) > n_before, 60, "another start")
    until_flying(container)
    assert_readable(container, before)


def test_it_and_its_recordings_survive_a_reboot(container: Container) -> None:
    before = recordings(container)
    container.reboot()
    until_flying(container)
    assert shown(container, "NRestarts") == "0"
    last = f"/var/lib/companion/flights/{before[-1]}"
    assert " whole " in container.run("companion", "flights", "verify", last)
    assert set(recordings(container)) > set(before)
    assert_readable(container, before)


def test_an_upgrade_keeps_the_configuration(container: Container) -> None:
    pid = shown(container, "MainPID")
    container.run("dpkg", "-i", f"/srv/{PACKAGES[-1].name}", timeout_s=900)
    until_flying(container)
    assert shown(container, "MainPID") != pid
    assert (container.root / "etc/companion/companion.toml").read_text() == CONFIG


def test_removed_it_leaves_what_is_the_owners_purged_nothing(container: Container) -> None:
    shutil.copytree(container.root / "opt/companion", container.root / "opt/own", symlinks=True)
    before = recordings(container)
    container.run("dpkg", "--remove", "companion")
    assert shown(container, "ActiveState") == "inactive"
    assert not (container.root / "opt/companion").exists()
    assert (container.root / "etc/companion/companion.toml").read_text() == CONFIG
    assert recordings(container) == before
    container.run("dpkg", "--purge", "companion")
    assert not (container.root / "etc/companion").exists()
    assert not (container.root / "var/lib/companion").exists()
    assert "companion:" not in (container.root / "etc/passwd").read_text()


def test_install_does_without_the_package(container: Container) -> None:
    """From an environment of its own, copied from the package's; a failure leaves nothing."""
    own, root = "/opt/own/bin/companion", container.root
    bin_folder = root / "opt/own/bin"
    for script in (bin_folder / "companion", root / "etc/systemd/system/autopilot.service"):
        script.write_text(script.read_text().replace("/opt/companion/", "/opt/own/"))
    (root / "usr/local/bin/companion").symlink_to(own)
    container.run("systemctl", "daemon-reload")
    container.run("systemctl", "restart", "autopilot")
    given, unit = root / "srv/own.toml", root / "etc/systemd/system/companion.service"
    given.write_text(CONFIG)
    rules = root / "etc/udev/rules.d/99-companion.rules"
    rules.mkdir()  # in the way
    said = container.run(own, "install", "--config", "/srv/own.toml", check=False)
    told(said.splitlines()[-1])
    assert "nothing is left of it" in said.splitlines()[-1]
    assert not unit.exists() and not (root / "etc/companion").exists()
    assert "companion:" not in (root / "etc/passwd").read_text()
    rules.rmdir()

    said = container.run(own, "install", "--config", "/srv/own.toml", "--now", "--dry-run")
    assert "would do: user companion" in said and not unit.exists()
    container.run(own, "install", "--config", "/srv/own.toml", "--now")
    assert f"ExecStart={own} run" in unit.read_text()
    until_flying(container)
    said = container.run(own, "install")
    assert {line for line in said.splitlines() if line.startswith("done:")} <= {
        "done: units read", "done: rules for devices read",
    }, said  # fmt: skip
    container.run(own, "uninstall")
    assert shown(container, "ActiveState") == "inactive" and not unit.exists()
    assert (root / "etc/companion/companion.toml").read_text() == CONFIG
    assert recordings(container)
    container.run(own, "uninstall", "--purge")
    assert not (root / "var/lib/companion").exists()
    assert "companion:" not in (root / "etc/passwd").read_text()
