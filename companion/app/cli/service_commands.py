"""Commands that install the program as a service, and remove it."""

from __future__ import annotations

import argparse
from typing import Any

from companion.app.cli.options import add_flag, add_path, command
from companion.app.stopping import StopSignals


def _install(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.service.install import install

    install(
        arguments.config, _notify, user=arguments.user, venv=arguments.venv, now=arguments.now,
        dry_run=arguments.dry_run,
    )  # fmt: skip


def _uninstall(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.service.install import uninstall

    uninstall(_notify, user=arguments.user, purge=arguments.purge, dry_run=arguments.dry_run)


def _notify(text: str) -> None:
    print(text, flush=True)


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    either = argparse.ArgumentParser(add_help=False)
    add_flag(either, "--user", "your own service, without root; for the bench")
    add_flag(either, "--dry-run", "only print what would be done, step by step")
    install = command(
        commands, "install", _install, parents=[either],
        help="install the service, which starts with the computer",
        description="Create user, environment, configuration, systemd unit and device names. What "
        "exists already is left as it is, so the command can be repeated. If a step fails, those "
        "before it are undone.",
    )  # fmt: skip
    add_path(
        install, "--config", "FILE", "configuration of the service (default: the existing one)"
    )
    add_path(
        install, "--venv", "DIR",
        "create the environment there (default: the present one, or /opt/companion if a service "
        "cannot read that)",
    )  # fmt: skip
    add_flag(install, "--now", "start the service, too")
    uninstall = command(
        commands, "uninstall", _uninstall, parents=[either],
        help="remove the service; flights and configuration stay",
    )  # fmt: skip
    add_flag(uninstall, "--purge", "remove flights, configuration and user, too")
