"""Errors against truth: `python -m tests.bench.accuracy slam FLIGHT…`, or `depth DATASET`.

`slam` tracks recorded flights that have truth/world_from_camera.tum, dense mapping left off;
lengths are in metres, times in milliseconds. `depth` reconstructs one reference of a data set with
true depth, its range taken from the truth, and does the same with REMODE's filter on one core; then
all references as `companion depth` does, and measures those that have true depth.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from companion.app.cli.options import configuration, frames, json_option, made_folder
from companion.app.progress import progress_on
from companion.config_file import load_config
from tests.bench.accuracy import depth_tables, slam_tables
from tests.bench.accuracy.bench_depth import bench_depth
from tests.bench.accuracy.bench_slam import bench_slam


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.accuracy", description=__doc__)
    common = argparse.ArgumentParser(add_help=False, parents=[configuration(), json_option()])
    common.add_argument(
        "--out", type=Path, metavar="DIR", help="write the figures, and pictures, there"
    )
    benches = parser.add_subparsers(dest="bench", required=True, metavar="WHAT")
    slam = benches.add_parser("slam", parents=[common], help="errors of the camera's path")
    slam.add_argument("flights", type=Path, nargs="+", metavar="FLIGHT")
    slam.add_argument("--faults", action="store_true", help="each flight under each known fault")
    slam.add_argument(
        "--above", type=float, metavar="M", help="count only frames truly higher than this"
    )
    dense = benches.add_parser("depth", parents=[common], help="time and accuracy of dense depth")
    dense.add_argument("dataset", type=Path, metavar="DATASET")
    dense.add_argument("--reference", type=int, default=0, metavar="N", help="frame (default: 0)")
    dense.add_argument(
        "--frames", type=frames, default=(None, None), metavar="A:B",
        help="use frames from A up to, not including, B",
    )  # fmt: skip
    dense.add_argument(
        "--no-serial", dest="serial", action="store_false", help="leave out the serial reference"
    )
    given = parser.parse_args(argv)
    made_folder(given.out)
    config, progress = load_config(given.config, given.set), progress_on(sys.stderr)
    if given.bench == "slam":
        rows = bench_slam(
            given.flights, config, given.out,
            faults=given.faults, above_m=given.above, progress=progress,
        )  # fmt: skip
        print(slam_tables.as_json(rows) if given.json else slam_tables.table(rows))
    else:
        found = bench_depth(
            given.dataset, config, given.out, reference=given.reference, frames=given.frames,
            serial=given.serial, progress=progress,
        )  # fmt: skip
        print(depth_tables.as_json(found) if given.json else depth_tables.tables(found))


if __name__ == "__main__":
    main()
