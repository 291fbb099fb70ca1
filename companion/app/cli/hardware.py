"""Commands for connected hardware: camera, autopilot, OpenCL devices."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.app.cli.options import command, configuration, json_option
from companion.app.progress import JsonProgress, progress_on
from companion.app.stopping import StopSignals
from companion.config import Config
from companion.config_file import load_config
from companion.errors import InputError

if TYPE_CHECKING:
    from drivers.camera.camera_source import CameraSource

RUNNING_NICE = 15
"""Beside a running daemon, as its page."""


def _devices(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.devices_command import devices, opencl_devices

    if arguments.bench:
        from companion.app.computer_speed import computer_speed

        print(computer_speed(arguments.json))
        return 0
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
    if [arguments.live, arguments.running, arguments.source is not None].count(True) != 1:
        raise InputError(
            "wanted a video, a folder of images, --live or --running, and one of them only"
        )
    if arguments.name is None:
        raise InputError("--name is missing: a name for the camera, as in --name front")
    config = load_config(arguments.config, arguments.set)
    source = arguments.source
    if arguments.live:
        source = camera_source(config.camera)
    elif arguments.running:
        source = _running_camera(config)
    progress = JsonProgress(sys.stdout) if arguments.json else progress_on(sys.stderr, "views")
    report = calibrate(
        source, arguments.board, arguments.name, arguments.out, arguments.model,
        signals.between_frames(progress),
    )  # fmt: skip
    if arguments.json:
        print(json.dumps({"calibration": str(report.toml), "said": str(report)}))
    else:
        print(report)
    if arguments.source is not None:
        signals.take()
    return 0


def _running_camera(config: Config) -> CameraSource:
    """Camera that the running daemon has, to which this process gives way."""
    from drivers.recording.running_camera import RunningCamera
    from drivers.system.status_socket import found_socket_path

    _be_nice()
    return RunningCamera(found_socket_path(config.daemon.socket))


def _be_nice() -> None:
    """Take a low priority, unless whoever started this has given it one."""
    os.setpriority(os.PRIO_PROCESS, 0, max(os.getpriority(os.PRIO_PROCESS, 0), RUNNING_NICE))


def _mount(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.mount_command import mount_by_hand, mount_of_flight
    from drivers.system.status_socket import found_socket_path

    if arguments.running == (arguments.flight is not None):
        raise InputError("wanted a flight, or --running, and one of them only")
    config = load_config(arguments.config, arguments.set)
    progress = JsonProgress(sys.stdout) if arguments.json else progress_on(sys.stderr, "samples")
    progress = signals.between_frames(progress)
    if arguments.running:
        _be_nice()  # to the daemon, which sees the same pictures
        found = mount_by_hand(found_socket_path(config.daemon.socket), config, progress)
    else:
        found = mount_of_flight(arguments.flight, config, progress)
    print(json.dumps(dataclasses.asdict(found)) if arguments.json else found)
    return 0


def _doctor(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.doctor_command import doctor

    config = load_config(arguments.config, arguments.set)
    return doctor(
        config, write=arguments.write, yes=arguments.yes, only=arguments.only,
        as_json=arguments.json,
    )  # fmt: skip


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    for add in (_add_devices, _add_calibrate, _add_mount, _add_doctor):
        add(commands)


def _add_devices(commands: Any) -> None:
    devices = command(
        commands, "devices", _devices, parents=[json_option()],
        help="list cameras, serial ports and OpenCL devices",
        description="List what a configuration can name. OpenCL devices are tested and measured "
        "anew, and the result is kept for opencl.device = auto.",
    )  # fmt: skip
    devices.add_argument(
        "--opencl", action="store_true",
        help="only OpenCL devices; exit status 1 where none of them works",
    )  # fmt: skip
    devices.add_argument(
        "--bench", action="store_true",
        help="only measure how fast this computer is, what it can carry, and which profile fits",
    )  # fmt: skip
    devices.add_argument(
        "--verbose", action="store_true", help="with what drivers and their compilers say"
    )


def _add_calibrate(commands: Any) -> None:
    calibrate = command(
        commands, "calibrate", _calibrate, parents=[configuration(), json_option()],
        help="calibrate a camera by a board held before it",
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
        "--running", action="store_true", help="take them from the camera that a daemon has, now"
    )
    calibrate.add_argument(
        "--board", default="charuco:7x5:0.04:0.03:DICT_5X5_100", metavar="BOARD",
        help="charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY or chessboard:9x6:SQUARE_M, whose "
        "numbers are those of inner corners (default: %(default)s)",
    )  # fmt: skip
    calibrate.add_argument("--name", help="name of the camera, and of its file")
    calibrate.add_argument(
        "--out", type=Path, default=Path("config/cameras"), metavar="DIR",
        help="where to write (default: %(default)s)",
    )  # fmt: skip
    calibrate.add_argument(
        "--model", default="auto", choices=("auto", "radtan", "equidistant"),
        help="distortion model (default: whichever fits views best that it was not fitted to)",
    )  # fmt: skip
    calibrate.add_argument(
        "--print-board", type=Path, metavar="FILE", help="only write the board, .pdf or .png"
    )


def _add_mount(commands: Any) -> None:
    mount = command(
        commands, "mount", _mount, parents=[configuration(), json_option()],
        help="find how the camera sits on the vehicle, by turning both",
        description="Compare rotations of the camera with those of the autopilot, in a recorded "
        "flight or while the vehicle is turned by hand; prints the lines of [mount].",
    )  # fmt: skip
    mount.add_argument("flight", type=Path, nargs="?", metavar="FLIGHT", help="as for replay")
    mount.add_argument(
        "--running", action="store_true", help="of the running daemon, disarmed, while it is turned"
    )


def _add_doctor(commands: Any) -> None:
    doctor = command(
        commands, "doctor", _doctor, parents=[configuration(), json_option()],
        help="find the autopilot's parameters that keep it from using the pose",
        description="Read the autopilot's parameters over the configured link and name each that "
        "stands in the way. Exit status 1 where there is one.",
    )  # fmt: skip
    doctor.add_argument("--write", action="store_true", help="set these parameters, after asking")
    doctor.add_argument(
        "--only", action="append", default=[], metavar="NAME",
        help="with --write, set this parameter and no others; can be given again",
    )  # fmt: skip
    doctor.add_argument("--yes", action="store_true", help="with --write, do not ask")
