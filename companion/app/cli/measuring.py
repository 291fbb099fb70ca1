"""Commands for depth from known poses, and for benchmarks against ground truth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from companion.app.cli.options import (
    Command,
    configuration,
    depths,
    frames,
    json_option,
    made_folder,
)
from companion.app.progress import progress_on
from companion.app.stopping import StopSignals
from companion.config_file import load_config


def _depth(arguments: argparse.Namespace, signals: StopSignals) -> int:
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
    signals.take()
    return 0


def _bench_slam(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.bench.bench_slam import bench_slam
    from companion.app.bench.slam_tables import as_json, table

    made_folder(arguments.out)
    rows = bench_slam(
        arguments.flights, load_config(arguments.config, arguments.set), arguments.out,
        faults=arguments.faults, above_m=arguments.above,
        progress=signals.between_frames(progress_on(sys.stderr)),
    )  # fmt: skip
    print(as_json(rows) if arguments.json else table(rows))
    return 0


def _bench_depth(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.app.bench.bench_depth import bench_depth
    from companion.app.bench.depth_tables import as_json, tables

    made_folder(arguments.out)
    bench = bench_depth(
        arguments.dataset, load_config(arguments.config, arguments.set), arguments.out,
        reference=arguments.reference, frames=arguments.frames, serial=arguments.serial,
        progress=signals.between_frames(progress_on(sys.stderr)),
    )  # fmt: skip
    print(as_json(bench) if arguments.json else tables(bench))
    return 0


BENCHES: dict[str, Command] = {"slam": _bench_slam, "depth": _bench_depth}


def _bench(arguments: argparse.Namespace, signals: StopSignals) -> int:
    return BENCHES[arguments.bench](arguments, signals)


COMMANDS: dict[str, Command] = {"depth": _depth, "bench": _bench}


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    depth = commands.add_parser(
        "depth", parents=[configuration()], help="dense depth from images with known poses",
        description="Reconstruct the depth of reference frames. DATASET is a folder in the layout "
        "of REMODE's test set or of TUM RGB-D, with poses.txt and K.txt, or a flight with "
        "trajectory.tum.",
    )  # fmt: skip
    depth.add_argument("dataset", type=Path, metavar="DATASET")
    depth.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the results"
    )
    depth.add_argument(
        "--reference", type=int, metavar="N",
        help="only this frame, from all others (default: a new one as the view moves on)",
    )  # fmt: skip
    depth.add_argument(
        "--frames", type=frames, default=(None, None), metavar="A:B",
        help="use frames from A up to, not including, B",
    )  # fmt: skip
    depth.add_argument(
        "--range", type=depths, metavar="NEAR:FAR",
        help="least and greatest depth that there can be, metres (default: found out)",
    )  # fmt: skip
    depth.add_argument("--device", metavar="NAME", help="the same as --set opencl.device=NAME")

    bench = commands.add_parser("bench", help="measure how good the results are, against truth")
    benches = bench.add_subparsers(dest="bench", required=True, metavar="WHAT")

    slam = benches.add_parser(
        "slam", parents=[configuration(), json_option()], help="errors of the camera's path",
        description="Track recorded flights that have truth/world_from_camera.tum, dense mapping "
        "left off; lengths are in metres, times in milliseconds.",
    )  # fmt: skip
    slam.add_argument("flights", type=Path, nargs="+", metavar="FLIGHT")
    slam.add_argument("--faults", action="store_true", help="each flight under each known fault")
    slam.add_argument(
        "--above", type=float, metavar="M", help="count only frames truly higher than this"
    )
    slam.add_argument(
        "--out", type=Path, metavar="DIR", help="write slam.json and pictures of the paths there"
    )

    dense = benches.add_parser(
        "depth", parents=[configuration(), json_option()], help="time and accuracy of dense depth",
        description="Reconstruct one reference of a data set with true depth, its range taken from "
        "the truth, and do the same with REMODE's filter on one core; then reconstruct all "
        "references as `companion depth` does, and measure those that have true depth.",
    )  # fmt: skip
    dense.add_argument("dataset", type=Path, metavar="DATASET")
    dense.add_argument("--reference", type=int, default=0, metavar="N", help="frame (default: 0)")
    dense.add_argument(
        "--frames", type=frames, default=(None, None), metavar="A:B",
        help="use frames from A up to, not including, B",
    )  # fmt: skip
    dense.add_argument(
        "--no-serial", dest="serial", action="store_false", help="leave out the serial reference"
    )
    dense.add_argument(
        "--out", type=Path, metavar="DIR", help="write depth_bench.json and a picture there"
    )
