"""The command line: what was asked, handed on; what came of it, as an exit status.

0 done; 1 a fault; 2 bad input or usage; 130 and 143 stopped by Ctrl-C and SIGTERM. An error that
the program raises on purpose is one line; anything else is a bug and shows its traceback.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

from companion import __version__, cli_recordings, cli_service
from companion.config import Config, ExportConfig
from companion.config_file import load_config, to_toml
from companion.errors import CompanionError, InputError
from companion.progress import progress_on
from companion.stopping import StopSignals


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    arguments = _parser().parse_args(argv)
    with StopSignals() as signals:
        try:
            return COMMANDS[arguments.command](arguments, signals)
        except KeyboardInterrupt:
            print("companion: stopped", file=sys.stderr)
            return signals.exit_status
        except CompanionError as error:
            print(f"companion: error: {error}", file=sys.stderr)
            return 2 if isinstance(error, InputError) else 1


# Libraries are loaded late: those behind a command take a second, and --help needs none of them.


def _run(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.live.nodes import with_stages

    def load() -> Config:
        config = load_config(arguments.config, arguments.set)
        return with_stages(config, arguments.stages, arguments.join)

    if "tracking" not in load().distributed.stages:
        from companion.live.depth_node import run_depth_node

        signals.defer()
        return run_depth_node(load(), lambda: signals.received is not None)
    from companion.live.daemon import run

    return run(load)


def _with_telemetry(arguments: argparse.Namespace) -> Config:
    """The configuration, with what the options say of the log."""
    config = load_config(arguments.config, arguments.set)
    telemetry = config.telemetry
    if arguments.log is not None:
        telemetry = dataclasses.replace(telemetry, log=str(arguments.log))
    if arguments.offset is not None:
        # a log without absolute time counts from the first picture then
        telemetry = dataclasses.replace(
            telemetry, offset_s=arguments.offset, align="never", starts_with_video=True
        )
    return dataclasses.replace(config, telemetry=telemetry)


def _replay(arguments: argparse.Namespace, signals: StopSignals) -> int:
    config = _with_telemetry(arguments)
    if None not in (arguments.start, arguments.stop) and arguments.stop <= arguments.start:
        raise InputError(f"--stop {arguments.stop:g} is not after --start {arguments.start:g}")
    if arguments.out.exists() and not arguments.out.is_dir():
        raise InputError(f"{arguments.out}: is a file; --out wants a folder")
    if config.export.formats:
        from companion.output.exports import check_formats

        check_formats(config.export)
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
        told=print,
    )
    if config.export.formats:
        _export_into(arguments.out, arguments.out, config.export)
    print(f"report: {arguments.out / 'report.html'}")
    signals.take()
    return 0


def _import(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.import_command import import_flight

    n = import_flight(
        arguments.source, arguments.out, _with_telemetry(arguments),
        signals.between_frames(progress_on(sys.stderr, "images")), print,
    )  # fmt: skip
    print(f"flight: {arguments.out}, {n} frames")
    signals.take()
    return 0


def _export(arguments: argparse.Namespace, signals: StopSignals) -> int:
    settings = load_config(arguments.config, arguments.set).export
    if arguments.formats is not None:
        settings = dataclasses.replace(settings, formats=_formats(arguments.formats))
    if not settings.formats:
        raise InputError("nothing to export: --as las,gpx,… says what")
    _export_into(arguments.run, arguments.out or arguments.run, settings)
    return 0


def _stages(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _formats(text: str) -> tuple[str, ...]:
    return tuple(name.strip().lower() for name in text.split(",") if name.strip())


def _export_into(run: Path, out: Path, settings: ExportConfig) -> None:
    from companion.output.exports import export_run
    from companion.output.run_folder import read_run

    for path in export_run(read_run(run), out, settings):
        print(f"export: {path}")


def _status(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.status import show_status
    from drivers.status_socket import found_socket_path

    setting = load_config(arguments.config, arguments.set).daemon.socket
    show_status(
        found_socket_path(setting), sys.stdout, as_json=arguments.json, watch=arguments.watch,
        stop=threading.Event(),
    )  # fmt: skip
    return 0


def _view(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.view import view

    def told(text: str) -> None:
        print(f"companion: {text}", file=sys.stderr, flush=True)

    where = "web" if arguments.web else arguments.viewer
    return view(arguments.host, where, arguments.bind, arguments.colours, told)


def _devices(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.devices import devices

    print(devices(arguments.json))
    return 0


def _doctor(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.doctor import doctor

    config = load_config(arguments.config, arguments.set)
    return doctor(config, write=arguments.write, yes=arguments.yes, as_json=arguments.json)


def _calibrate(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.calibrate import calibrate, print_board
    from drivers.camera_source import camera_source

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


def _bench_slam(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.bench_slam import bench_slam
    from companion.output.slam_bench import as_json, table

    rows = bench_slam(
        arguments.flights, load_config(arguments.config, arguments.set), arguments.out,
        faults=arguments.faults, above_m=arguments.above,
        progress=signals.between_frames(progress_on(sys.stderr)),
    )  # fmt: skip
    print(as_json(rows) if arguments.json else table(rows))
    return 0


def _bench_depth(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.bench_depth import bench_depth
    from companion.output.depth_bench import as_json, tables

    bench = bench_depth(
        arguments.dataset, load_config(arguments.config, arguments.set), arguments.out,
        reference=arguments.reference, frames=arguments.frames, serial=arguments.serial,
        progress=signals.between_frames(progress_on(sys.stderr)),
    )  # fmt: skip
    print(as_json(bench) if arguments.json else tables(bench))
    return 0


BENCHES: dict[str, Callable[[argparse.Namespace, StopSignals], int]] = {
    "slam": _bench_slam,
    "depth": _bench_depth,
}


def _depth(arguments: argparse.Namespace, signals: StopSignals) -> int:
    from companion.depth_command import Wanted, reconstruct

    sets = list(arguments.set)
    if arguments.device is not None:
        sets.append(f"opencl.device={arguments.device}")
    wanted = Wanted(arguments.reference, arguments.frames, arguments.range)
    maps = reconstruct(
        arguments.dataset, arguments.out, load_config(arguments.config, sets), wanted,
        signals.between_frames(progress_on(sys.stderr)),
    )  # fmt: skip
    print(f"{len(maps)} depth maps and cloud.ply: {arguments.out}")
    signals.take()
    return 0


def _bench(arguments: argparse.Namespace, signals: StopSignals) -> int:
    return BENCHES[arguments.bench](arguments, signals)


def _check_config(arguments: argparse.Namespace, signals: StopSignals) -> int:
    print(to_toml(load_config(arguments.config, arguments.set)), end="")
    return 0


COMMANDS: dict[str, Callable[[argparse.Namespace, StopSignals], int]] = {
    "run": _run,
    "replay": _replay,
    "import": _import,
    "export": _export,
    "status": _status,
    "view": _view,
    "devices": _devices,
    "calibrate": _calibrate,
    "doctor": _doctor,
    "depth": _depth,
    "bench": _bench,
    "check-config": _check_config,
    **cli_recordings.COMMANDS,
    **cli_service.COMMANDS,
}


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

    run = commands.add_parser(
        "run", parents=[configuration], help="fly: camera, autopilot, map and pose, until stopped",
        description="The daemon on the drone. SIGTERM ends it, SIGHUP has it read its "
        "configuration again. With --stages depth,cloud it is a node on another machine, which "
        "makes the map of a drone that runs --stages tracking.",
    )  # fmt: skip
    run.add_argument(
        "--stages", type=_stages, metavar="LIST",
        help="what runs here, joined with other nodes over Zenoh: tracking, or depth,cloud, or all",
    )  # fmt: skip
    run.add_argument(
        "--join", action="append", default=[], metavar="ENDPOINT",
        help="a node to join, as tcp/HOST:7447; can be given again",
    )  # fmt: skip

    timing = argparse.ArgumentParser(add_help=False)
    timing.add_argument(
        "--log", type=Path, metavar="LOG", help="telemetry log, where it does not lie beside FLIGHT"
    )
    timing.add_argument(
        "--offset", type=_shift, metavar="S",
        help="seconds added to the log's times, instead of finding them by rotation",
    )  # fmt: skip

    replay = commands.add_parser(
        "replay", parents=[configuration, timing], help="turn a logged flight into a metric map",
        description="Track the camera of a logged flight, reconstruct what it saw, report on it.",
    )  # fmt: skip
    replay.add_argument(
        "flight", type=Path, metavar="FLIGHT",
        help="a folder with video or images, a video, or a data set (EuRoC, KITTI, TUM RGB-D)",
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

    imported = commands.add_parser(
        "import", parents=[configuration, timing],
        help="write any flight as a flight folder or a recording",
        description="Read a flight of any format and write it, all on one clock: as a folder with "
        "pictures, times, calibration and telemetry, or as FILE.mcap, a recording.",
    )  # fmt: skip
    imported.add_argument("source", type=Path, metavar="SOURCE", help="as FLIGHT of replay")
    imported.add_argument(
        "--out", type=Path, required=True, metavar="OUT", help="a new folder, or FILE.mcap"
    )

    export = commands.add_parser(
        "export", parents=[configuration], help="write a replay's results in other formats",
        description="Clouds, rasters and paths for other programs, from the folder of a finished "
        "replay, with a statement of accuracy beside each.",
    )  # fmt: skip
    export.add_argument("run", type=Path, metavar="RUN", help="what --out of the replay was")
    export.add_argument(
        "--as", dest="formats", metavar="FORMATS",
        help="any of ply,pcd,las,laz,dsm,ortho,tum,kitti,euroc,gpx,kml,geojson; see [export]",
    )  # fmt: skip
    export.add_argument("--out", type=Path, metavar="DIR", help="folder for them (default: RUN)")

    as_json = argparse.ArgumentParser(add_help=False)
    as_json.add_argument("--json", action="store_true", help="as JSON, for programs")

    status = commands.add_parser(
        "status", parents=[configuration, as_json], help="ask the running daemon how it is"
    )
    status.add_argument("--watch", action="store_true", help="again every second, until Ctrl-C")

    view = commands.add_parser(
        "view", help="watch a flight on the ground, over whatever link there is",
        description="Connect to a companion that flies (its stream.listen) and show the map, the "
        "camera and how all is, until Ctrl-C; the link may come and go.",
    )  # fmt: skip
    view.add_argument(
        "host", nargs="?", default="127.0.0.1", metavar="HOST[:PORT]",
        help="the drone's address (default: %(default)s, port 9870)",
    )  # fmt: skip
    view.add_argument("--web", action="store_true", help="on a page for a browser, not in a window")
    view.add_argument(
        "--viewer", type=_viewer, default="native", metavar="WHERE",
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

    commands.add_parser(
        "devices", parents=[as_json], help="list cameras, serial ports and OpenCL devices"
    )

    calibrate = commands.add_parser(
        "calibrate", parents=[configuration], help="calibrate a camera by a board held before it",
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
        "doctor", parents=[configuration, as_json],
        help="find the autopilot's parameters that keep it from using the pose",
        description="Read the autopilot's parameters over the configured link and name each that "
        "stands in the way. Exit status 1 where there is one.",
    )  # fmt: skip
    doctor.add_argument("--write", action="store_true", help="set them, after asking")
    doctor.add_argument("--yes", action="store_true", help="do not ask")

    depth = commands.add_parser(
        "depth", parents=[configuration], help="dense depth from images with known poses",
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
        "--frames", type=_frames, default=(None, None), metavar="A:B",
        help="use frames from A up to, not including, B",
    )  # fmt: skip
    depth.add_argument(
        "--range", type=_depths, metavar="NEAR:FAR",
        help="least and greatest depth that there can be, metres (default: found out)",
    )  # fmt: skip
    depth.add_argument("--device", metavar="NAME", help="the same as --set opencl.device=NAME")

    bench = commands.add_parser("bench", help="measure how good the results are, against truth")
    benches = bench.add_subparsers(dest="bench", required=True, metavar="WHAT")

    slam = benches.add_parser(
        "slam", parents=[configuration, as_json], help="errors of the camera's path",
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

    cli_recordings.add_parsers(commands, configuration, _seconds)
    cli_service.add_parsers(commands)
    dense = benches.add_parser(
        "depth", parents=[configuration, as_json], help="time and accuracy of dense depth",
        description="Reconstruct one reference of a data set with true depth, its range taken from "
        "the truth, and do the same with REMODE's filter on one core.",
    )  # fmt: skip
    dense.add_argument("dataset", type=Path, metavar="DATASET")
    dense.add_argument("--reference", type=int, default=0, metavar="N", help="frame (default: 0)")
    dense.add_argument(
        "--frames", type=_frames, default=(None, None), metavar="A:B",
        help="use frames from A up to, not including, B",
    )  # fmt: skip
    dense.add_argument(
        "--no-serial", dest="serial", action="store_false", help="leave out the serial reference"
    )
    dense.add_argument(
        "--out", type=Path, metavar="DIR", help="write depth_bench.json and a picture there"
    )

    commands.add_parser(
        "check-config", parents=[configuration], help="print the configuration that would be used",
        description="Check a configuration and print the whole of it as TOML.",
    )  # fmt: skip
    return parser


def _shift(text: str) -> float:
    seconds = float(text)
    if not abs(seconds) <= 1e10:
        raise ValueError
    return seconds


def _seconds(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"wanted seconds since the first frame, given is {text}")
    return value


def _frames(text: str) -> tuple[int | None, int | None]:
    first, colon, beyond = text.partition(":")
    try:
        out = (int(first) if first else None, int(beyond) if beyond else None)
    except ValueError:
        colon = ""
    if not colon or (None not in out and out[1] <= out[0]):  # type: ignore[operator]
        raise argparse.ArgumentTypeError(f"wanted FIRST:BEYOND, given is {text}")
    return out


def _depths(text: str) -> tuple[float, float]:
    near, _, far = text.partition(":")
    try:
        out = float(near), float(far)
    except ValueError:
        out = 0.0, 0.0
    if not (0 < out[0] < out[1] < math.inf):
        raise argparse.ArgumentTypeError(f"wanted NEAR:FAR in metres, given is {text}")
    return out


def _viewer(text: str) -> str:
    if text in ("none", "web", "native") or text.startswith(("rerun+http://", "rerun+https://")):
        return text
    raise argparse.ArgumentTypeError(
        f"wanted none, web, native or rerun+http://HOST:PORT/proxy, given is {text}"
    )
