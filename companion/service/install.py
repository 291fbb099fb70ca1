"""`companion install` and `companion uninstall`: a service of this computer, or of one user.

All checks come before the first step; steps already done are skipped, so that it can be run again
after an update.
"""

from __future__ import annotations

import grp
import os
import pwd
import shutil
from collections.abc import Callable
from pathlib import Path

from companion.config import Config
from companion.config_file import load_config
from companion.errors import InputError, InstallError
from companion.service.environment import (
    MARK,
    environment_made,
    present_environment,
    why_unfit,
)
from companion.service.install_paths import (
    ACCOUNT,
    GROUPS,
    OWN_ENVIRONMENT,
    PACKAGED_UNITS,
    RULES,
    SYSTEM,
    UNIT,
    Places,
    user_places,
)
from companion.service.shipped import clone, shipped, unit_for
from companion.service.steps import Step, carry_out, command, file_written, removed
from drivers.mavlink.wire.link_url import link_endpoint
from drivers.system.login_console import login_console_on, login_consoles

Notify = Callable[[str], None]


def install(
    config: Path | None, notify: Notify, *, user: bool, venv: Path | None, now: bool, dry_run: bool
) -> None:
    """Set the service up; InputError before any change, InstallError with all changes undone."""
    places = user_places() if user else SYSTEM
    _check_can_act(user, dry_run)
    settings = load_config(config or (places.config if places.config.exists() else None))
    steps = [] if user else _account()
    environment, more = _environment(user, venv)
    steps += more
    steps += _configuration(places, config)
    if not user:
        steps.append(_settings_of_service(places))
    steps.append(file_written(places.unit, unit_for(environment / "bin/companion", user).encode()))
    if places.rules is not None:
        steps.append(file_written(places.rules, shipped(RULES).encode()))
        steps += _rules_read()
    steps += _enabled(places, now)
    carry_out(steps, notify, dry_run)
    if not dry_run and settings.depth.enabled:
        _have_opencl_device(environment, notify)
    for remark in _remarks(settings, user):
        notify(f"note: {remark}")
    if not dry_run:
        systemctl = " ".join(places.systemctl)
        notify(f"edit {places.config}, then: {systemctl} restart companion" if not now else
             f"how it is: {systemctl} status companion, companion status")  # fmt: skip


def uninstall(notify: Notify, *, user: bool, purge: bool, dry_run: bool) -> None:
    """Remove the service; flights and configuration stay unless purged."""
    places = user_places() if user else SYSTEM
    _check_can_act(user, dry_run)
    steps = [*_stopped(places), _disabled(places), removed(places.unit)]
    if places.rules is not None:
        steps += [removed(places.rules), *_rules_read()]
    steps += _units_read(places)
    if not user and (OWN_ENVIRONMENT / MARK).exists():
        steps.append(removed(OWN_ENVIRONMENT))
    if purge:
        steps += [removed(folder) for folder in places.kept]
        if not user:
            steps.append(_no_account())
    carry_out(steps, notify, dry_run)
    if not purge:
        left = [str(folder) for folder in places.kept if folder.exists()]
        if left:
            notify(f"kept: {', '.join(left)}; --purge takes them away")


def _check_can_act(user: bool, dry_run: bool) -> None:
    if shutil.which("systemctl") is None:
        raise InputError("there is no systemd on this computer; companion run starts the daemon")
    if user and os.geteuid() == 0:
        raise InputError("--user is for a user's own service; as root leave it out")
    if user and not dry_run and not user_places().manager.exists():
        raise InputError("your service manager does not run; log in as yourself, not by su or sudo")
    if user:
        return
    if os.geteuid() != 0 and not dry_run:
        raise InputError("a service of the computer is root's: sudo companion …, or --user")
    for unit in PACKAGED_UNITS:
        if unit.exists():
            raise InputError(
                f"{unit} is there: companion came as a package, which has set the service up; "
                "apt remove companion takes it away"
            )


# -- steps ---------------------------------------------------------------------------------------


def _account() -> list[Step]:
    made: list[str] = []

    def missing() -> list[str]:
        names = {group.gr_name for group in grp.getgrall()}
        return [name for name in (*GROUPS, ACCOUNT) if name not in names]

    def make_groups() -> None:
        for name in missing():
            command("groupadd", "--system", name)
            made.append(name)

    def remove_groups() -> None:
        for name in {*made} - {*missing()}:  # that of a user goes with it
            command("groupdel", name)

    def make_user() -> None:
        command(
            "useradd", "--system", "--gid", ACCOUNT, "--home-dir", "/var/lib/companion",
            "--no-create-home", "--shell", "/usr/sbin/nologin", ACCOUNT,
        )  # fmt: skip

    return [
        Step(
            f"groups {', '.join(GROUPS)}, {ACCOUNT}", lambda: not missing(), make_groups,
            remove_groups,
        ),
        Step(
            f"user {ACCOUNT}", _has_account, make_user, lambda: command("userdel", ACCOUNT)
        ),
    ]  # fmt: skip


def _has_account() -> bool:
    return any(entry.pw_name == ACCOUNT for entry in pwd.getpwall())


def _no_account() -> Step:
    return Step(
        f"user {ACCOUNT} removed", lambda: not _has_account(), lambda: command("userdel", ACCOUNT)
    )


def _environment(user: bool, venv: Path | None) -> tuple[Path, list[Step]]:
    present = present_environment()
    if venv is None and (user or not why_unfit(present)):
        if not (present / "bin/companion").is_file():
            raise InputError(f"{present}/bin/companion is not there; --venv names an environment")
        return present, []
    folder = (venv or OWN_ENVIRONMENT).absolute()
    if folder == present:
        raise InputError(f"--venv {folder}: a service cannot use it: {why_unfit(present)}")
    return folder, environment_made(folder, "a user" if user else ACCOUNT)


def _configuration(places: Places, given: Path | None) -> list[Step]:
    if given is None:
        written = file_written(places.config, shipped("companion.toml").encode())
        return [Step(written.what, places.config.exists, written.do, written.undo)]
    content = given.read_bytes()
    steps = []
    if places.config.is_file() and places.config.read_bytes() != content:
        old = places.config.with_name(places.config.name + ".old")
        steps.append(file_written(old, places.config.read_bytes()))
    return [*steps, file_written(places.config, content)]


def _settings_of_service(places: Places) -> Step:
    """Step that lets the service write its settings, for its page."""
    paths = places.config.parent, places.config

    def is_done() -> bool:
        own = pwd.getpwnam(ACCOUNT).pw_uid if _has_account() else None
        return all(path.exists() and path.stat().st_uid == own for path in paths)

    def do() -> None:
        for path in paths:
            shutil.chown(path, ACCOUNT, ACCOUNT)

    return Step(f"{places.config.parent} is the service's", is_done, do)


def _have_opencl_device(environment: Path, notify: Notify) -> None:
    """Install a driver where no device works; without one the service makes no dense map."""
    source = clone()
    if source is None:
        return
    try:
        command("sh", source / "packaging/opencl.sh", environment)
    except InstallError as error:
        notify(f"note: {error}")


def _rules_read() -> list[Step]:
    """Step that reloads udev rules; None where udev does not run, as in an image."""

    def do() -> None:
        command("udevadm", "control", "--reload")
        command(
            "udevadm", "trigger", "--action=change",
            "--subsystem-match=tty", "--subsystem-match=video4linux",
        )  # fmt: skip

    running = Path("/run/udev/control").exists()
    return [Step("rules for devices read", lambda: False, do)] if running else []


def _units_read(places: Places) -> list[Step]:
    if not places.manager.exists():
        return []
    return [
        Step("units read", lambda: False, lambda: command(*places.systemctl, "daemon-reload"))
    ]  # fmt: skip


def _enabled(places: Places, now: bool) -> list[Step]:
    wants = list(places.unit.parent.glob(f"*.wants/{UNIT}"))
    steps = [
        *_units_read(places),
        Step(
            "service enabled", lambda: bool(wants),
            lambda: command(*places.systemctl, "enable", UNIT),
            lambda: command(*places.systemctl, "disable", UNIT),
        ),
    ]  # fmt: skip
    if now:
        steps.append(
            Step(
                "service started", lambda: False,
                lambda: command(*places.systemctl, "restart", "--no-block", UNIT),
            )
        )  # fmt: skip
    return steps


def _stopped(places: Places) -> list[Step]:
    if not places.manager.exists():
        return []
    return [
        Step(
            "service stopped", lambda: not places.unit.exists(),
            lambda: command(*places.systemctl, "stop", UNIT),
        )
    ]  # fmt: skip


def _disabled(places: Places) -> Step:
    return Step(
        "service disabled", lambda: not places.unit.exists(),
        lambda: command(*places.systemctl, "disable", UNIT),
    )  # fmt: skip


# -- what else there is to know ------------------------------------------------------------------


def _remarks(config: Config, user: bool) -> list[str]:
    where = link_endpoint(config.link.url) if config.link.url else None
    consoles = login_consoles() if where is None else [login_console_on(where.device)]
    out = [console.what for console in consoles if console is not None]
    for key, value in (
        ("camera.calibration", config.camera.calibration), ("camera.path", config.camera.path),
        ("link.signing_key_file", config.link.signing_key_file),
    ):  # fmt: skip
        if value and not Path(value).is_absolute():
            out.append(f"{key} = {value} is not a whole path; the service looks in its own folder")
        elif value and not user and Path(value).parts[1:2] in (("home",), ("root",)):
            out.append(f"{key} = {value} is hidden from the service; put it into /etc/companion")
    if user:
        name = pwd.getpwuid(os.getuid()).pw_name
        mine = {grp.getgrgid(number).gr_name for number in os.getgroups()}
        missing = [group for group in GROUPS if group not in mine]
        if missing:
            out.append(f"you are not in {', '.join(missing)}: sudo usermod -aG {missing[0]} {name}")
        if not Path("/var/lib/systemd/linger", name).exists():
            out.append(
                f"it starts when you log in; at power on: sudo loginctl enable-linger {name}"
            )
    return out
