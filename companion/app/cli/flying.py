"""Commands for a flight in progress: the daemon, its status, the viewer."""

from __future__ import annotations

import argparse
import sys
import threading
from pathlib import Path
from typing import Any

from companion.app.cli.options import command, configuration, json_option, names, viewer, within
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
        help="fly: camera, autopilot, map and pose, until stopped",
        description="The daemon on the drone. SIGTERM ends it, SIGHUP has it read its "
        "configuration again. With --stages depth,cloud it is a node on another machine, which "
        "makes the map of a drone that runs --stages tracking.",
    )  # fmt: skip
    run.add_argument(
        "--stages", type=names, metavar="LIST",
        help="what runs here, joined with other nodes over Zenoh: tracking, or depth,cloud, or all",
    )  # fmt: skip
    run.add_argument(
        "--join", action="append", default=[], metavar="ENDPOINT",
        help="a node to join, as tcp/HOST:7447; can be given again",
    )  # fmt: skip


def _add_status(commands: Any) -> None:
    status = command(
        commands, "status", _status, parents=[configuration(), json_option()],
        help="ask the running daemon how it is",
    )  # fmt: skip
    status.add_argument("--watch", action="store_true", help="again every second until Ctrl-C")


def _add_support(commands: Any) -> None:
    support = command(
        commands, "support", _support, parents=[configuration()],
        help="pack what a maintainer needs to help into one file",
        description="Pack versions, settings without passwords, health, journal, list of "
        "flights and the end of the newest recording into one .zip. Say what is in it, and what "
        "that shows.",
    )  # fmt: skip
    support.add_argument(
        "--out", type=Path, default=Path("companion-support.zip"), metavar="FILE",
        help="what to write (default: %(default)s)",
    )  # fmt: skip
    support.add_argument(
        "--flights", type=Path, metavar="DIR",
        help="folder of all flights (default: as for flights)",
    )  # fmt: skip
    support.add_argument(
        "--seconds", type=within(0, 300), default=10.0, metavar="S",
        help="seconds of the newest recording, with its pictures; 0 for none (default: 10)",
    )  # fmt: skip


def _add_page(commands: Any) -> None:
    page = command(
        commands, "page", _page, parents=[configuration()],
        help="show where the drone's page is, and the codes that pair a device with it",
        description="Show where the drone's page is, which `companion run` serves at page.listen. "
        "A browser on another machine needs one of the codes: the first to look on, the second to "
        "change things.",
    )  # fmt: skip
    page.add_argument(
        "--new-codes", action="store_true", help="draw other codes: every paired device is out"
    )


def _add_view(commands: Any) -> None:
    view = command(
        commands, "view", _view, help="watch a flight on the ground, over whatever link there is",
        description="Connect to a companion that flies (its stream.listen) and show the map, the "
        "camera and how all is, until Ctrl-C; the link may come and go.",
    )  # fmt: skip
    view.add_argument(
        "host", nargs="?", default="127.0.0.1", metavar="HOST[:PORT]",
        help="the drone's address (default: %(default)s, port 9870)",
    )  # fmt: skip
    view.add_argument("--web", action="store_true", help="on a page for a browser, not in a window")
    view.add_argument(
        "--viewer", type=viewer, default="native", metavar="WHERE",
        help="native, web, or the rerun+http://… of a running viewer (default: %(default)s)",
    )  # fmt: skip
    view.add_argument(
        "--bind", default="127.0.0.1", metavar="ADDRESS",
        help="where the page is served; 0.0.0.0 for other machines too (default: %(default)s)",
    )  # fmt: skip
    view.add_argument(
        "--colours", choices=("picture", "height", "confidence"), default="picture",
        help="what the colours of the cloud tell (default: %(default)s)",
    )  # fmt: skip


def _add_check_config(commands: Any) -> None:
    check = command(
        commands, "check-config", _check_config, parents=[configuration()],
        help="print the configuration that would be used",
        description="Check a configuration and print the whole of it as TOML.",
    )  # fmt: skip
    check.add_argument(
        "--migrate", action="store_true",
        help="write FILE anew with the keys of this version; it stays beside that as FILE.bak",
    )  # fmt: skip
