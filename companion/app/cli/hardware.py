"""Commands for connected hardware: camera, autopilot, OpenCL devices."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from companion.app.cli.options import Command, configuration, json_option
from companion.app.progress import progress_on
from companion.app.stopping import StopSignals
from companion.config_file import load_config
from companion.errors import InputError


def _devices(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.devices_command import devices, opencl_devices

    if not arguments.opencl:
        print(devices(arguments.json, arguments.verbose))
        return 0
    from companion.dense.opencl import WANT

    text, works = opencl_devices(arguments.json, arguments.verbose)
    print(text)
    if not works:
        print(f"companion: error: no OpenCL device that works: {WANT}", file=sys.stderr)
    return 0 if works else 1


def _calibrate(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.calibrate_command import calibrate, print_board
    from drivers.camera.camera_registry import camera_source

    if arguments.print_board is not None:
        paper = print_board(arguments.board, arguments.print_board)
        print(f"{arguments.print_board}: print it on {paper}, at 100 %")
        return 0
    if arguments.live == (arguments.source is not None):
        raise InputError("wanted a video, a folder of images, or --live, and one of them only")
    if arguments.name is None:
        raise InputError("--name is missing: a name for the camera, as in --name front")
    config = load_config(arguments.config, arguments.set)
    source = camera_source(config.camera) if arguments.live else arguments.source
    report = calibrate(
        source, arguments.board, arguments.name, arguments.out, arguments.model,
        signals.between_frames(progress_on(sys.stderr, "views")),
    )  # fmt: skip
    print(report)
    if not arguments.live:
        signals.take()
    return 0


def _doctor(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.doctor_command import doctor

    config = load_config(arguments.config, arguments.set)
    return doctor(
        config, write=arguments.write, yes=arguments.yes, only=arguments.only,
        as_json=arguments.json,
    )  # fmt: skip


COMMANDS: dict[str, Command] = {"devices": _devices, "calibrate": _calibrate, "doctor": _doctor}


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    devices = commands.add_parser(
        "devices", parents=[json_option()], help="list cameras, serial ports and OpenCL devices",
        description="List what a configuration can name. OpenCL devices are tested and measured "
        "anew, and the result is kept for opencl.device = auto.",
    )  # fmt: skip
    devices.add_argument(
        "--opencl", action="store_true",
        help="only OpenCL devices; exit status 1 where none of them works",
    )  # fmt: skip
    devices.add_argument(
        "--verbose", action="store_true", help="with what drivers and their compilers say"
    )

    calibrate = commands.add_parser(
        "calibrate", parents=[configuration()], help="calibrate a camera by a board held before it",
        description="Find a camera's focal length, centre and distortion from views of a board; "
        "writes OUT/NAME.toml, for camera.calibration, and a picture beside it.",
    )  # fmt: skip
    calibrate.add_argument(
        "source", type=Path, nargs="?", metavar="VIDEO|FOLDER", help="views of the board"
    )
    calibrate.add_argument(
        "--live", action="store_true", help="take the views from the configured camera, now"
    )
    calibrate.add_argument(
        "--board", default="charuco:7x5:0.04:0.03:DICT_5X5_100", metavar="BOARD",
        help="charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY or chessboard:9x6:SQUARE_M, whose "
        "numbers are those of inner corners (default: %(default)s)",
    )  # fmt: skip
    calibrate.add_argument("--name", help="what to call the camera")
    calibrate.add_argument(
        "--out", type=Path, default=Path("config/cameras"), metavar="DIR",
        help="where to write (default: %(default)s)",
    )  # fmt: skip
    calibrate.add_argument(
        "--model", default="auto", choices=("auto", "radtan", "equidistant"),
        help="of distortion (default: whichever fits views best that it was not fitted to)",
    )  # fmt: skip
    calibrate.add_argument(
        "--print-board", type=Path, metavar="FILE", help="only write the board, .pdf or .png"
    )

    doctor = commands.add_parser(
        "doctor", parents=[configuration(), json_option()],
        help="find the autopilot's parameters that keep it from using the pose",
        description="Read the autopilot's parameters over the configured link and name each that "
        "stands in the way. Exit status 1 where there is one.",
    )  # fmt: skip
    doctor.add_argument("--write", action="store_true", help="set them, after asking")
    doctor.add_argument(
        "--only", action="append", default=[], metavar="NAME",
        help="with --write, set this parameter and no others; can be given again",
    )  # fmt: skip
    doctor.add_argument("--yes", action="store_true", help="do not ask")
