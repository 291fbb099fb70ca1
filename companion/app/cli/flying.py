"""Commands for a flight in progress: the daemon, its status, the viewer."""

from __future__ import annotations

import argparse
import sys
import threading
from pathlib import Path
from typing import Any

from companion.app.cli.options import (
    add_flag,
    add_path,
    command,
    configuration,
    json_option,
    names,
    viewer,
    within,
)
from companion.app.stopping import StopSignals
from companion.config import Config
from companion.config_file import load_config, to_toml
from companion.errors import InputError
from companion.runtime.collection_pause import garbage_collection_paused


def _run(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from drivers.system.heap import bound_heap

    bound_heap()
    from companion.daemon.nodes.node_config import with_stages
    from drivers.system.zenoh_bus import check_distributed

    def load() -> Config:
        config = load_config(arguments.config, arguments.set)
        return with_stages(config, arguments.stages, arguments.join)

    config = load()
    check_distributed(config.distributed)
    if "tracking" not in config.distributed.stages:
        from companion.daemon.nodes.depth_node import run_depth_node

        signals.defer()
        return run_depth_node(config, lambda: signals.received is not None)
    with garbage_collection_paused():
        import companion.daemon.shared_imports  # noqa: F401
    from companion.runtime.fork_server import ForkServer

    with ForkServer(copy=True) as server:  # before there are threads and what only the daemon needs
        server.prepare("localisation")  # whose imports take longest, while the daemon makes its own
        with garbage_collection_paused():
            from companion.daemon.daemon import run
            from companion.daemon.page_child import SettingsSource

        return run(load, server.start, SettingsSource(arguments.config, tuple(arguments.set)))


def _status(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.app.status_command import show_status
    from drivers.system.status_socket import found_socket_path

    setting = load_config(arguments.config, arguments.set).daemon.socket
    show_status(
        found_socket_path(setting), sys.stdout, as_json=arguments.json, watch=arguments.watch,
        stop=threading.Event(),
    )  # fmt: skip


def _page(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.app.page_command import show_page

    show_page(load_config(arguments.config, arguments.set), sys.stdout, arguments.new_codes)


def _view(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.view_command import view

    def notify(text: str) -> None:
        print(f"companion: {text}", file=sys.stderr, flush=True)

    where = "web" if arguments.web else arguments.viewer
    return view(arguments.host, where, arguments.bind, arguments.colours, notify)


def _support(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.app.support_command import support
    from companion.service.flights_meant import flights_meant, installed_services

    flights = arguments.flights
    if flights is None:
        flights = flights_meant(arguments.config, arguments.set, installed_services())
    config = load_config(arguments.config, arguments.set)
    support(config, flights, arguments.out, arguments.seconds, print)


def _check_config(arguments: argparse.Namespace, signals: StopSignals) -> None:
    if not arguments.migrate:
        config = load_config(arguments.config, arguments.set)
        _check_beyond(config)
        print(to_toml(config), end="")
        return
    from companion.app.migrate_command import migrate

    if arguments.config is None or arguments.set:
        raise InputError("--migrate wants --config FILE, and no --set")
    migrate(arguments.config, sys.stdout)


def _check_beyond(config: Config) -> None:
    """Check what the settings name: ConfigError for a link that cannot be, a warning for no file.

    The configuration may be for another computer, which has the files. FlightError for a
    calibration that is there and is none.
    """
    from drivers.camera.live_calibration import check_calibration
    from drivers.mavlink.wire.link_url import client_endpoint, link_endpoint

    if config.link.url:
        link_endpoint(config.link.url)
    for client in config.router.clients:
        client_endpoint(client)
    named = {"camera.calibration": config.camera.calibration, "map.use": config.map.use}
    for key, name in named.items():
        if name and not Path(name).exists():
            print(f"companion: warning: {key}: {name}: not there", file=sys.stderr)
    if Path(config.camera.calibration).is_file():
        check_calibration(config.camera, config.mount)


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    for add in (_add_run, _add_status, _add_support, _add_page, _add_view, _add_check_config):
        add(commands)


def _add_run(commands: Any) -> None:
    run = command(
        commands, "run", _run, parents=[configuration()],
        help="run the daemon on the drone, until stopped",
        description="Run the daemon on the drone. SIGTERM ends it; SIGHUP makes it read its "
        "configuration again. With --stages depth,cloud it is a node on another machine, which "
        "makes the dense map of a drone that runs --stages tracking.",
    )  # fmt: skip
    run.add_argument(
        "--stages", type=names, metavar="LIST",
        help="stages of this node, which joins others over Zenoh: tracking; depth,cloud; or all",
    )  # fmt: skip
    run.add_argument(
        "--join", action="append", default=[], metavar="ENDPOINT",
        help="node to join, as tcp/HOST:7447; can be repeated",
    )  # fmt: skip


def _add_status(commands: Any) -> None:
    status = command(
        commands, "status", _status, parents=[configuration(), json_option()],
        help="show the state of the running daemon",
    )  # fmt: skip
    add_flag(status, "--watch", "repeat every second, until Ctrl-C")


def _add_support(commands: Any) -> None:
    support = command(
        commands, "support", _support, parents=[configuration()],
        help="pack what a maintainer needs into one file",
        description="Pack versions, settings without passwords, health, journal, the list of "
        "flights and the end of the newest recording into one .zip file, and print what the file "
        "contains and reveals.",
    )  # fmt: skip
    add_path(
        support, "--out", "FILE", "file to write (default: %(default)s)",
        default=Path("companion-support.zip"),
    )  # fmt: skip
    add_path(support, "--flights", "DIR", "folder of all flights (default: as for `flights`)")
    support.add_argument(
        "--seconds", type=within(0, 300), default=10.0, metavar="S",
        help="length of the recording's end, with its pictures; 0 leaves it out (default: 10)",
    )  # fmt: skip


def _add_page(commands: Any) -> None:
    page = command(
        commands, "page", _page, parents=[configuration()],
        help="show the address and the codes of the drone's page",
        description="Show the address of the drone's page, which `companion run` serves at "
        "page.listen, and its two codes. A browser on another machine needs the first to look on, "
        "the second to change things.",
    )  # fmt: skip
    add_flag(page, "--new-codes", "draw new codes; paired devices must pair again")


def _add_view(commands: Any) -> None:
    view = command(
        commands, "view", _view, help="show a flight on the ground, live",
        description="Connect to a flying companion (its stream.listen) and show map, camera and "
        "status, until Ctrl-C. A link that is lost is opened again.",
    )  # fmt: skip
    view.add_argument(
        "host", nargs="?", default="127.0.0.1", metavar="HOST[:PORT]",
        help="address of the drone (default: %(default)s, port 9870)",
    )  # fmt: skip
    add_flag(view, "--web", "show it on a page for a browser, not in a window")
    view.add_argument(
        "--viewer", type=viewer, default="native", metavar="WHERE",
        help="native, web, or the rerun+http://… of a running viewer (default: %(default)s)",
    )  # fmt: skip
    view.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDRESS",
        help="address that serves the page; 0.0.0.0 for other machines (default: %(default)s)",
    )  # fmt: skip
    view.add_argument(
        "--colours", choices=("picture", "height", "confidence"), default="picture",
        help="meaning of the cloud's colours (default: %(default)s)",
    )  # fmt: skip


def _add_check_config(commands: Any) -> None:
    check = command(
        commands, "check-config", _check_config, parents=[configuration()],
        help="check a configuration, and print all of it",
        description="Check a configuration, and print all of it as TOML.",
    )  # fmt: skip
    add_flag(check, "--migrate", "write FILE with this version's keys; FILE.bak is the old file")
