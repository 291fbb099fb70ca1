"""The command line: what was asked, handed on; what came of it, as an exit status.

0 done; 1 a fault; 2 bad input or usage; 130 and 143 stopped by Ctrl-C and SIGTERM. An error that
the program raises on purpose is one line; anything else is a bug and shows its traceback.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

from companion import __version__
from companion.config_file import load_config, to_toml
from companion.errors import CompanionError, InputError
from companion.progress import progress_on
from companion.stopping import StopSignals


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    arguments = _parser().parse_args(argv)
    with StopSignals() as signals:
        try:
            if arguments.command == "check-config":
                _check_config(arguments)
            else:
                _replay(arguments, signals)
                signals.take()
        except KeyboardInterrupt:
            print("companion: stopped", file=sys.stderr)
            return signals.exit_status
        except CompanionError as error:
            print(f"companion: error: {error}", file=sys.stderr)
            return 2 if isinstance(error, InputError) else 1
    return 0


def _replay(arguments: argparse.Namespace, signals: StopSignals) -> None:
    config = load_config(arguments.config, arguments.set)
    if None not in (arguments.start, arguments.stop) and arguments.stop <= arguments.start:
        raise InputError(f"--stop {arguments.stop:g} is not after --start {arguments.start:g}")
    if arguments.out.exists() and not arguments.out.is_dir():
        raise InputError(f"{arguments.out}: is a file; --out wants a folder")
    # Late, since the libraries behind it take a second to load, and --help needs none of them.
    from companion.replay import replay

    replay(
        arguments.flight,
        arguments.out,
        config,
        start_s=arguments.start,
        stop_s=arguments.stop,
        viewer=arguments.viewer,
        paced=arguments.paced,
        progress=signals.between_frames(progress_on(sys.stderr)),
    )
    print(f"report: {arguments.out / 'report.html'}")


def _check_config(arguments: argparse.Namespace) -> None:
    print(to_toml(load_config(arguments.config, arguments.set)), end="")


def _parser() -> argparse.ArgumentParser:
    configuration = argparse.ArgumentParser(add_help=False)
    configuration.add_argument(
        "--config", type=Path, metavar="FILE", help="TOML file; see config/companion.toml"
    )
    configuration.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE",
        help="set one key, over the file; can be given again",
    )  # fmt: skip

    parser = argparse.ArgumentParser(
        prog="companion",
        description="Visual SLAM and dense metric mapping for drones.",
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    replay = commands.add_parser(
        "replay", parents=[configuration], help="turn a logged flight into a metric map",
        description="Track the camera of a logged flight, reconstruct what it saw, report on it.",
    )  # fmt: skip
    replay.add_argument(
        "flight", type=Path, metavar="FLIGHT",
        help="folder of the flight: video or images, frames.csv, camera.json, telemetry log",
    )  # fmt: skip
    replay.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    replay.add_argument(
        "--start", type=_seconds, metavar="S", help="leave out what comes before this second"
    )
    replay.add_argument(
        "--stop", type=_seconds, metavar="S", help="leave out what comes from this second on"
    )
    replay.add_argument(
        "--viewer", type=_viewer, default="none", metavar="WHERE",
        help="show it live: none, web, native, or the rerun+http://… of a running viewer",
    )  # fmt: skip
    replay.add_argument(
        "--paced", action="store_true",
        help="in the flight's own time, dropping what a live run would drop",
    )  # fmt: skip

    commands.add_parser(
        "check-config", parents=[configuration], help="print the configuration that would be used",
        description="Check a configuration and print the whole of it as TOML.",
    )  # fmt: skip
    return parser


def _seconds(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"wanted seconds since the first frame, given is {text}")
    return value


def _viewer(text: str) -> str:
    if text in ("none", "web", "native") or text.startswith(("rerun+http://", "rerun+https://")):
        return text
    raise argparse.ArgumentTypeError(
        f"wanted none, web, native or rerun+http://HOST:PORT/proxy, given is {text}"
    )
