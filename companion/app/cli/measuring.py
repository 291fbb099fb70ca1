"""Command for dense depth from known poses."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from companion.app.cli.options import (
    add_path,
    command,
    configuration,
    depths,
    frames,
    made_folder,
)
from companion.app.progress import progress_on
from companion.app.stopping import StopSignals
from companion.config_file import load_config


def _depth(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.app.depth_command import Wanted, reconstruct

    sets = list(arguments.set)
    if arguments.device is not None:
        sets.append(f"opencl.device={arguments.device}")
    wanted = Wanted(arguments.reference, arguments.frames, arguments.range)
    made_folder(arguments.out)
    maps = reconstruct(
        arguments.dataset, arguments.out, load_config(arguments.config, sets), wanted,
        signals.between_frames(progress_on(sys.stderr)),
    )  # fmt: skip
    plural = "" if len(maps) == 1 else "s"
    print(f"{len(maps)} depth map{plural} and cloud.ply: {arguments.out}")


def add_parsers(commands: Any) -> None:
    """Add it to the subparsers of the program."""
    depth = command(
        commands, "depth", _depth, parents=[configuration()],
        help="make dense depth from images with known poses",
        description="Reconstruct the depth of reference frames. DATASET is a flight's folder with "
        "trajectory.tum in it, or a data set with ground truth.",
    )  # fmt: skip
    add_path(depth, "dataset", "DATASET", "its folder")
    add_path(depth, "--out", "DIR", "folder for the results", required=True)
    depth.add_argument(
        "--reference", type=int, metavar="N",
        help="only this frame, from all others (default: another one whenever the view moves on)",
    )  # fmt: skip
    depth.add_argument(
        "--frames", type=frames, default=(None, None), metavar="A:B",
        help="use frames from A up to, not including, B",
    )  # fmt: skip
    depth.add_argument(
        "--range", type=depths, metavar="NEAR:FAR",
        help="least and greatest depth, metres (default: estimated)",
    )  # fmt: skip
    depth.add_argument("--device", metavar="NAME", help="short for --set opencl.device=NAME")
