"""The package on a booted Debian, from installation to removal.

`make deb system-test`. It needs root, debootstrap, systemd-container (systemd-nspawn), Debian's
packages, 5 GB of disk, and some minutes; without these, and without a package, it is skipped. The
tests are one story, told in order. Not tried here: devices (there are none), and the real-time
policy, where root may not raise its own limits.
"""

from __future__ import annotations

import platform
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.processes.booted_service import BootedService, told
from tests.support.processes.container import Container, lacking
from tests.support.waiting import until

REPOSITORY = Path(__file__).parents[2]
PACKAGES = sorted((REPOSITORY / "dist").glob("companion_*.deb"))
WHY_NOT = lacking() or ("" if PACKAGES else "needs dist/companion_*.deb: make deb")
CONFIG = """
[camera]
source = "file"
path = "/mnt/sample/survey"
calibration = "/mnt/sample/survey/camera.json"
[expert.camera]
repeat = true
[link]
url = "udpin:127.0.0.1:14550"
[daemon]
flight = "always"
[expert.recorder]
least_free_mb = 100
"""
AUTOPILOT = """
[Service]
WorkingDirectory=/mnt
ExecStart=/opt/companion/bin/python -m tests.support.autopilot.fake_autopilot \
  --flight sample/survey --url udpout:127.0.0.1:14550
Restart=always
StandardOutput=null
[Install]
WantedBy=multi-user.target
"""

pytestmark = [
    pytest.mark.continues,
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
        tuple(name.split("|")[0].strip() for name in needs.split(",")), kept=REPOSITORY / "build",
        mounts=mnt,
    ) as made:  # fmt: skip
        told("dpkg:", made.install(package).splitlines()[-1])
        (made.root / "etc/companion/companion.toml").write_text(CONFIG)
        autopilot = made.root / "etc/systemd/system/autopilot.service"
        autopilot.write_text(AUTOPILOT)
        wanted = made.root / "etc/systemd/system/multi-user.target.wants"
        (wanted / autopilot.name).symlink_to(f"/etc/systemd/system/{autopilot.name}")
        made.boot()
        yield made


@pytest.fixture
def service(container: Container) -> BootedService:
    return BootedService(container)


def recordings(container: Container) -> list[str]:
    flights = container.root / "var/lib/companion/flights"
    return sorted(path.parent.name for path in flights.glob("*/flight.mcap"))


def assert_readable(container: Container, names: list[str]) -> None:
    """Every recording reads back, with its checksums, up to its last byte.

    Of a killed daemon's the end is missing, since systemd kills the rest of the service at once.
    """
    for name in names:
        said = verified(container, name)
        told(said.partition("flights/")[2])
        cut = "cut short" in said and ", 0 bytes cannot be read" in said
        assert " whole " in said or " repaired " in said or cut, said


def verified(container: Container, name: str) -> str:
    """What verify says of a recording, by its name in the folder that it finds by itself."""
    return container.run("companion", "flights", "verify", name, check=False).strip()


def test_unit_and_rules_are_well_formed(container: Container) -> None:
    assert container.run("systemd-analyze", "verify", "companion.service") == ""
    said = container.run("systemd-analyze", "security", "--no-pager", "companion.service")
    level = said.splitlines()[-1].split(":")[1].split()[0]
    told("exposure:", level)
    assert float(level) <= 3.0
    said = container.run("udevadm", "test", "/sys/class/mem/null", check=False)
    assert "99-companion.rules" in said
    assert "99-companion.rules:" not in said  # which is how it begins to tell of an error


def test_it_boots_into_the_running_service(container: Container, service: BootedService) -> None:
    service.until_flying()
    assert service.shown("User") == "companion"
    pid = service.shown("MainPID")
    assert container.run("ps", "-o", "user=,ni=", "-p", pid).split() == ["compani+", "-10"]
    died = container.run(
        "journalctl", "--unit=companion", "--no-pager", "--grep=has died|linker", check=False
    )
    assert "died" not in died, died
    assert "look on" in container.run("companion", "page"), "the codes of the page"


def test_killed_it_comes_back(container: Container, service: BootedService) -> None:
    before = recordings(container)
    time.sleep(5)  # something to lose
    container.run("kill", "-KILL", service.shown("MainPID"))
    until(lambda: service.shown("NRestarts") == "1", "another start")
    service.until_flying()
    assert set(recordings(container)) > set(before)
    assert_readable(container, before)


def test_what_was_cut_short_is_repaired_unless_armed(
    container: Container, service: BootedService
) -> None:
    n_before = int(service.shown("NRestarts"))
    # all its processes, as a power cut; systemd may complain of one that was quicker
    service.systemctl("kill", "--signal=KILL", "companion", check=False)
    until(lambda: int(service.shown("NRestarts")) > n_before, "another start")
    service.until_flying()
    names = recordings(container)[:-1]
    assert "cut short" in verified(container, names[-1])

    def all_well() -> bool:
        return not any("cut short" in verified(container, name) for name in names)

    container.run("systemctl", "stop", "autopilot")
    try:
        service.systemctl("restart", "companion")
        until(all_well, "no recording that is cut short")
    finally:  # all tests after this one fly as well
        container.run("systemctl", "start", "autopilot")
    assert_readable(container, names)
    said = service.run("journalctl", "--unit=companion", "--no-pager", "--lines=200")
    assert "an earlier recording was cut short: " in said and ": repaired, " in said
    service.until_flying()


def test_a_wedged_pose_loop_is_ended_by_the_watchdog(
    container: Container, service: BootedService
) -> None:
    before, n_before = recordings(container), int(service.shown("NRestarts"))
    began_s = time.monotonic()
    while "Watchdog timeout" not in container.run("journalctl", "--unit=companion", "--no-pager"):
        assert time.monotonic() < began_s + 120
        container.run("pkill", "-STOP", "-x", "localisation", check=False)
        time.sleep(0.2)
    told(f"watchdog after {time.monotonic() - began_s:.0f} s")
    until(lambda: int(service.shown("NRestarts")) > n_before, "another start")
    service.until_flying()
    assert_readable(container, before)


def test_it_and_its_recordings_survive_a_reboot(
    container: Container, service: BootedService
) -> None:
    before = recordings(container)
    container.reboot()
    service.until_flying()
    assert service.shown("NRestarts") == "0"
    assert " whole " in verified(container, before[-1])
    assert "in /var/lib/companion/flights," in container.run("companion", "flights", "list")
    assert set(recordings(container)) > set(before)
    assert_readable(container, before)


def test_an_upgrade_keeps_the_configuration(container: Container, service: BootedService) -> None:
    pid = service.shown("MainPID")
    container.run("dpkg", "-i", f"/srv/{PACKAGES[-1].name}", timeout_s=900)
    service.until_flying()
    assert service.shown("MainPID") != pid
    assert (container.root / "etc/companion/companion.toml").read_text() == CONFIG


def test_the_version_before_comes_back(container: Container, service: BootedService) -> None:
    """By one command, and by itself where the updated one does not get ready."""
    before, pid = recordings(container), service.shown("MainPID")
    assert "is in place" in container.run("companion-back", "--armed")
    until(lambda: service.shown("MainPID") not in (pid, "0"), "another start")
    service.until_flying()
    program = container.root / "opt/companion/bin/companion"
    program.rename(program.with_name("gone"))
    container.run("systemctl", "restart", "companion", check=False)
    said = container.run("env", "PROOF_S=5", "companion-back", "--unless-ready")
    assert "the version before comes back" in said and "is in place" in said
    service.until_flying()
    assert (container.root / "etc/companion/companion.toml").read_text() == CONFIG
    assert set(before) <= set(recordings(container))


def test_removed_it_leaves_what_is_the_owners_purged_nothing(
    container: Container, service: BootedService
) -> None:
    shutil.copytree(container.root / "opt/companion", container.root / "opt/own", symlinks=True)
    before = recordings(container)
    container.run("dpkg", "--remove", "companion")
    assert service.shown("ActiveState") == "inactive"
    assert not (container.root / "opt/companion").exists()
    assert (container.root / "etc/companion/companion.toml").read_text() == CONFIG
    assert recordings(container) == before
    container.run("dpkg", "--purge", "companion")
    assert not (container.root / "etc/companion").exists()
    assert not (container.root / "var/lib/companion").exists()
    assert "companion:" not in (container.root / "etc/passwd").read_text()


def test_install_does_without_the_package(container: Container, service: BootedService) -> None:
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
    service.until_flying()
    said = container.run(own, "install")
    assert {line for line in said.splitlines() if line.startswith("done:")} <= {
        "done: units read", "done: rules for devices read",
    }, said  # fmt: skip
    container.run(own, "uninstall")
    assert service.shown("ActiveState") == "inactive" and not unit.exists()
    assert (root / "etc/companion/companion.toml").read_text() == CONFIG
    assert recordings(container)
    container.run(own, "uninstall", "--purge")
    assert not (root / "var/lib/companion").exists()
    assert "companion:" not in (root / "etc/passwd").read_text()


def test_a_user_installs_one_of_his_own(container: Container) -> None:
    """Without root, but for what keeps his services running while he is not logged in."""
    root, home = container.root, container.root / "home/pilot"
    container.run("useradd", "--create-home", "pilot")
    container.run("loginctl", "enable-linger", "pilot")
    own, service = "/opt/own/bin/companion", BootedService(container, "pilot")
    until(lambda: service.systemctl("is-system-running", check=False).strip() in ("running",
          "degraded"), "the user's service manager")  # fmt: skip
    said = service.run(own, "install", "--user", "--config", "/srv/own.toml", "--now")
    told(said.splitlines()[-1])
    unit = home / ".config/systemd/user/companion.service"
    assert service.run("systemd-analyze", "--user", "verify", f"/{unit.relative_to(root)}") == ""
    assert f"ExecStart={own} run" in unit.read_text()
    service.until_flying()
    time.sleep(5)
    service.run("kill", "-KILL", service.shown("MainPID"))
    until(lambda: service.shown("NRestarts") == "1", "another start")
    service.until_flying()
    said = service.run("companion", "flights", "list")
    told(said)
    assert "2 recordings in /home/pilot/.local/state/companion/flights," in said
    said = service.run(own, "install", "--user")
    assert {line for line in said.splitlines() if line.startswith("done:")} <= {"done: units read"}
    service.run(own, "uninstall", "--user")
    assert service.shown("ActiveState") == "inactive" and not unit.exists()
    assert (home / ".config/companion/companion.toml").read_text() == CONFIG
    service.run(own, "uninstall", "--user", "--purge")
    assert not (home / ".local/state/companion").exists()
