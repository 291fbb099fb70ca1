"""Commands that install the program as a service, and remove it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from companion.app.cli.options import command
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
    either.add_argument(
        "--user", action="store_true", help="a service of yours, without root; for the bench"
    )
    either.add_argument(
        "--dry-run", action="store_true", help="only say what would be done, step by step"
    )
    install = command(
        commands, "install", _install, parents=[either],
        help="have it start with the computer, by systemd",
        description="Set up user, environment, configuration, unit and names of devices. What is "
        "there already is left as it is, so that it can be run again; if a step fails, those "
        "before it are undone.",
    )  # fmt: skip
    install.add_argument(
        "--config", type=Path, metavar="FILE",
        help="the service's configuration; without it the one that is there is kept",
    )  # fmt: skip
    install.add_argument(
        "--venv", type=Path, metavar="DIR",
        help="make the environment there (default: the present one, or /opt/companion where a "
        "service cannot read that)",
    )  # fmt: skip
    install.add_argument("--now", action="store_true", help="start it, too")
    uninstall = command(
        commands, "uninstall", _uninstall, parents=[either],
        help="take the service away; flights and configuration stay",
    )  # fmt: skip
    uninstall.add_argument(
        "--purge", action="store_true", help="take flights, configuration and user away, too"
    )
