"""Login consoles in synthetic file systems of a Jetson and a Raspberry Pi."""

from __future__ import annotations

from pathlib import Path

from drivers.system.login_console import login_console_on, login_consoles


def want(root: Path, target: str, unit: str, folder: str = "etc/systemd/system") -> Path:
    link = root / folder / f"{target}.wants" / unit
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(f"/lib/systemd/system/{unit}")
    return link


def port(root: Path, name: str) -> None:
    (root / "dev").mkdir(exist_ok=True)
    (root / "dev" / name).touch()


def test_a_jetson_as_it_comes(tmp_path: Path) -> None:
    port(tmp_path, "ttyTHS1")
    link = want(tmp_path, "multi-user.target", "nvgetty.service")
    (console,) = login_consoles(tmp_path)
    assert console.port == "ttyTHS1"
    assert "systemctl disable --now nvgetty" in console.what
    link.unlink()
    assert login_consoles(tmp_path) == []


def test_masked_is_as_good_as_disabled(tmp_path: Path) -> None:
    port(tmp_path, "ttyTHS1")
    want(tmp_path, "multi-user.target", "nvgetty.service")
    (tmp_path / "etc/systemd/system/nvgetty.service").symlink_to("/dev/null")
    assert login_consoles(tmp_path) == []


def test_a_raspberry_pi_with_its_serial_console(tmp_path: Path) -> None:
    want(tmp_path, "getty.target", "serial-getty@ttyAMA0.service", "run/systemd/generator")
    want(tmp_path, "getty.target", "getty@tty1.service")  # of the screen
    active = tmp_path / "sys/class/tty/console/active"
    active.parent.mkdir(parents=True)
    active.write_text("ttyAMA10 tty0\n")
    found = {console.port: console.remedy for console in login_consoles(tmp_path)}
    assert sorted(found) == ["ttyAMA0", "ttyAMA10"]
    assert "serial-getty@ttyAMA0.service" in found["ttyAMA0"]
    assert "command line" in found["ttyAMA10"]


def test_a_port_is_known_by_where_its_name_leads(tmp_path: Path) -> None:
    want(tmp_path, "getty.target", "serial-getty@ttyAMA0.service")
    (tmp_path / "ttyAMA0").touch()
    (tmp_path / "serial0").symlink_to("ttyAMA0")
    assert login_console_on(str(tmp_path / "serial0"), tmp_path) is not None
    assert login_console_on("/dev/ttyACM0", tmp_path) is None
