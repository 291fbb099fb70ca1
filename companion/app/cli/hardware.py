"""Commands for connected hardware: camera, autopilot, OpenCL devices."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.app.cli.options import add_flag, add_path, command, configuration, json_option
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
        description="List the devices that a configuration can name. OpenCL devices are tested "
        "and measured, and the result is kept for opencl.device = auto.",
    )  # fmt: skip
    add_flag(devices, "--opencl", "list OpenCL devices only; exit status 1 if none works")
    add_flag(
        devices, "--bench", "only measure this computer's speed, and name the profile that fits"
    )
    add_flag(devices, "--verbose", "show the messages of drivers and their compilers, too")


def _add_calibrate(commands: Any) -> None:
    calibrate = command(
        commands, "calibrate", _calibrate, parents=[configuration(), json_option()],
        help="calibrate a camera with a board",
        description="Find a camera's focal length, centre and distortion from views of a board. "
        "Writes OUT/NAME.toml, for camera.calibration, and a picture beside it.",
    )  # fmt: skip
    add_path(calibrate, "source", "VIDEO|FOLDER", "views of the board", nargs="?")
    add_flag(calibrate, "--live", "take the views now, from the configured camera")
    add_flag(calibrate, "--running", "take the views now, from the camera of the running daemon")
    calibrate.add_argument(
        "--board", default="charuco:7x5:0.04:0.03:DICT_5X5_100", metavar="BOARD",
        help="charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY, or chessboard:9x6:SQUARE_M with "
        "the numbers of inner corners (default: %(default)s)",
    )  # fmt: skip
    calibrate.add_argument("--name", help="name of the camera, and of its file")
    add_path(
        calibrate, "--out", "DIR", "folder to write into (default: %(default)s)",
        default=Path("config/cameras"),
    )  # fmt: skip
    calibrate.add_argument(
        "--model", default="auto", choices=("auto", "radtan", "equidistant"),
        help="distortion model (default: the one that best fits views left out of its fit)",
    )  # fmt: skip
    add_path(calibrate, "--print-board", "FILE", "only write the board to print, .pdf or .png")


def _add_mount(commands: Any) -> None:
    mount = command(
        commands, "mount", _mount, parents=[configuration(), json_option()],
        help="find the camera's mount from rotations of the vehicle",
        description="Compare rotations of the camera with those of the autopilot, in a recorded "
        "flight or while the vehicle is turned by hand, and print the lines of [mount].",
    )  # fmt: skip
    add_path(mount, "flight", "FLIGHT", "as for `replay`", nargs="?")
    add_flag(mount, "--running", "use the running daemon, disarmed, while you turn the vehicle")


def _add_doctor(commands: Any) -> None:
    doctor = command(
        commands, "doctor", _doctor, parents=[configuration(), json_option()],
        help="find parameters that keep the autopilot from using the pose",
        description="Read the autopilot's parameters over the configured link, and name each one "
        "that keeps it from using the pose. Exit status 1 if there are any.",
    )  # fmt: skip
    add_flag(doctor, "--write", "set these parameters, after asking")
    doctor.add_argument(
        "--only", action="append", default=[], metavar="NAME",
        help="with --write, set this parameter and no others; can be repeated",
    )  # fmt: skip
    add_flag(doctor, "--yes", "with --write, do not ask")
