"""Commands that take a recorded flight: replay, import, export."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion.app.cli.options import (
    add_flag,
    add_path,
    check_span,
    command,
    configuration,
    held_folder,
    json_option,
    names,
    seconds,
    shift,
    viewer,
    within,
)
from companion.app.progress import JsonProgress, progress_on
from companion.app.stopping import StopSignals
from companion.config import Config, MapConfig
from companion.config_file import load_config
from companion.errors import InputError
from companion.runtime.collection_pause import garbage_collection_paused

if TYPE_CHECKING:
    from companion.runtime.fork_server import ForkServer


def _with_telemetry(arguments: argparse.Namespace) -> Config:
    """The configuration, with the options about the log."""
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


def _replay(arguments: argparse.Namespace, signals: StopSignals) -> None:
    config = _with_telemetry(arguments)
    if arguments.map is not None:
        config = dataclasses.replace(config, map=MapConfig(use=str(arguments.map)))
    check_span(arguments.start, arguments.stop)
    if arguments.out.exists() and not arguments.out.is_dir():
        raise InputError(f"{arguments.out}: is a file; --out wants a folder")
    if config.export.formats:
        from companion.products.export.exports import check_formats

        check_formats(config.export)
    shown = JsonProgress(sys.stdout) if arguments.json else progress_on(sys.stderr)
    progress = signals.between_frames(shown)
    if arguments.as_flown:
        if arguments.paced or (arguments.start, arguments.stop) != (None, None):
            raise InputError(
                "--as-flown replays a whole flight, in the order in which it came: leave out "
                "--paced, --start and --stop"
            )
        from companion.app.replay.as_flown import replay_as_flown

        with held_folder(arguments.out):
            replay_as_flown(arguments.flight, arguments.out, config, progress, print)
        return
    with ExitStack() as stack:
        if not arguments.paced:
            start = stack.enter_context(_prepared_stages(config)).start
        with garbage_collection_paused():
            from companion.app.replay.replay_command import RecordedInput, replay
            from companion.telemetry import belief_in_words

            given = RecordedInput(arguments.flight, config, arguments.start, arguments.stop)
        for remark in given.log.remarks:
            print(f"telemetry: {remark}")
        belief = belief_in_words(config.telemetry.use)
        if belief:
            print(f"telemetry: {belief}")
        for fault in given.warnings:
            print(f"warning: {fault.what}: {fault.detail}")
        stack.enter_context(held_folder(arguments.out))
        if arguments.paced:
            from companion.app.replay.paced_replay import replay_paced

            replay_paced(given, arguments.out, config, arguments.viewer, progress, print)
        else:
            replay(given, arguments.out, config, arguments.viewer, progress, print, start)
        if config.export.formats:
            _export_into(arguments.out, arguments.out, config, arguments.flight)
    print(f"report: {arguments.out / 'report.html'}")


def _prepared_stages(config: Config) -> ForkServer:
    """Processes that import what dense map and results need, while this one makes its imports."""
    from companion.runtime.fork_server import ForkServer

    with garbage_collection_paused():
        import companion.runtime.stage_protocol  # noqa: F401 - with what all need
    server = ForkServer(copy=True)  # as long as there is one thread
    for name in ("results", "depth") if config.depth.enabled else ("results",):
        server.prepare(name)
    return server


def _demo(arguments: argparse.Namespace, signals: StopSignals) -> None:
    """The sample flight, as any other is replayed."""
    from companion.app.sample_flight import sample_flight

    arguments.flight = arguments.flight or sample_flight()
    print(f"flight: {arguments.flight}", flush=True)
    _replay(arguments, signals)


def _import(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.app.import_command import import_flight

    n = import_flight(
        arguments.source, arguments.out, _with_telemetry(arguments),
        signals.between_frames(progress_on(sys.stderr, "images")), print,
    )  # fmt: skip
    print(f"flight: {arguments.out}, {n} frames")


def _export(arguments: argparse.Namespace, signals: StopSignals) -> None:
    config = load_config(arguments.config, arguments.set)
    if arguments.formats is not None:
        export = dataclasses.replace(config.export, formats=names(arguments.formats.lower()))
        config = dataclasses.replace(config, export=export)
    if not config.export.formats:
        raise InputError("nothing to export: --as las,gpx,… says what")
    _export_into(arguments.run, arguments.out or arguments.run, config, arguments.flight)


def _film(arguments: argparse.Namespace, signals: StopSignals) -> None:
    from companion.app.film_command import film
    from companion.products.film.flight_film import FilmSize

    height = arguments.height
    size = FilmSize(round(height * 16 / 9), height, arguments.rate, arguments.seconds)
    progress = signals.between_frames(progress_on(sys.stderr, ""))
    config = load_config(arguments.config, arguments.set)
    n = film(arguments.run, arguments.flight, arguments.out, size, config, progress)
    print(f"film: {arguments.out}, {n} frames")


def _export_into(run: Path, out: Path, config: Config, flight: Path | None) -> None:
    from companion.app.run_pictures import pictures_of
    from companion.products.export.exports import export_run
    from companion.products.run_folder import read_run

    finished = read_run(run)
    pictures = None if flight is None else pictures_of(finished, flight, config)
    for path in export_run(finished, out, config.export, pictures):
        print(f"export: {path}")


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    for add in (_add_replay, _add_demo, _add_import, _add_export, _add_film):
        add(commands)


def _timing() -> argparse.ArgumentParser:
    """Options about the log of a flight."""
    options = argparse.ArgumentParser(add_help=False)
    add_path(options, "--log", "LOG", "telemetry log, if it is not beside FLIGHT")
    options.add_argument(
        "--offset", type=shift, metavar="S",
        help="seconds added to the log's times, instead of aligning them by rotation",
    )  # fmt: skip
    return options


def _how() -> argparse.ArgumentParser:
    """Options of a replay."""
    parents = [configuration(), _timing(), json_option()]
    options = argparse.ArgumentParser(add_help=False, parents=parents)
    options.add_argument("--start", type=seconds, metavar="S", help="begin at this second")
    options.add_argument("--stop", type=seconds, metavar="S", help="end before this second")
    options.add_argument(
        "--viewer", type=viewer, default="none", metavar="WHERE",
        help="show it live: none, web, native, or the rerun+http://… of a running viewer",
    )  # fmt: skip
    add_flag(options, "--paced", "in the flight's own time, dropping what a live run would drop")
    add_path(options, "--map", "MAP", "site map of an earlier flight to locate it in; sets map.use")
    add_flag(options, "--as-flown", "repeat a recording's decisions, and compare what was sent")
    return options


def _add_replay(commands: Any) -> None:
    replay = command(
        commands, "replay", _replay, parents=[_how()],
        help="turn a logged flight into a metric map",
        description="Track the camera of a logged flight, make its map and cloud, and write a "
        "report.",
    )  # fmt: skip
    add_path(
        replay, "flight", "FLIGHT",
        "a recording, a flight's folder, a folder with video or images, a video, photographs, a "
        "bag, or a data set (EuRoC, KITTI, TUM RGB-D)",
    )  # fmt: skip
    add_path(replay, "--out", "DIR", "folder for the results", required=True)


def _add_demo(commands: Any) -> None:
    demo = command(
        commands, "demo", _demo, parents=[_how()], help="replay the sample flight: a first look",
        description="Replay the sample flight that comes with the program, or another. It needs an "
        "OpenCL device for the dense map, and takes a minute or two.",
    )  # fmt: skip
    add_path(demo, "flight", "FLIGHT", "as for `replay`", nargs="?")
    add_path(
        demo, "--out", "DIR", "folder for the results (default: %(default)s)",
        default=Path("out/demo"),
    )  # fmt: skip


def _add_import(commands: Any) -> None:
    imported = command(
        commands, "import", _import, parents=[configuration(), _timing()],
        help="convert any flight to a flight folder or a recording",
        description="Read a flight of any format, and write it on one clock: a folder with "
        "pictures, times, calibration and telemetry, or a recording, FILE.mcap.",
    )  # fmt: skip
    add_path(imported, "source", "SOURCE", "as for `replay`")
    add_path(imported, "--out", "OUT", "a new folder, or FILE.mcap", required=True)


def _add_export(commands: Any) -> None:
    export = command(
        commands, "export", _export, parents=[configuration()],
        help="write a replay's results in other formats",
        description="Write clouds, rasters and paths for other programs, from the folder of a "
        "finished replay, each with a statement of its accuracy.",
    )  # fmt: skip
    add_path(export, "run", "RUN", "folder of the replay, its --out")
    export.add_argument(
        "--as", dest="formats", metavar="FORMATS",
        help="any of ply,pcd,las,laz,copc,dsm,ortho,mosaic,glb,mesh,textured,tiles,colmap,"
        "nerfstudio,tum,kitti,euroc,gpx,kml,geojson; see docs/formats.md",
    )  # fmt: skip
    add_path(
        export, "--flight", "FLIGHT",
        "the replayed flight, whose pictures mosaic, textured, colmap and nerfstudio need",
    )  # fmt: skip
    add_path(export, "--out", "DIR", "folder to write into (default: RUN)")


def _add_film(commands: Any) -> None:
    film = command(
        commands, "film", _film, parents=[configuration()],
        help="make a film of a flight",
        description="Make a film of path and cloud as they grow, beside the picture.",
    )  # fmt: skip
    add_path(film, "run", "RUN", "folder of the replay, its --out")
    add_path(film, "--out", "FILE", "a new .mp4 or .webp file", required=True)
    add_path(film, "--flight", "FLIGHT", "the replayed flight, for its pictures")
    for name, kind, default, unit, text in (
        ("--seconds", within(1, 600), 30.0, "S", "length, seconds (default: 30)"),
        ("--height", within(120, 2160, int), 720, "PX", "height, pixels (default: 720)"),
        ("--rate", within(1, 60, int), 25, "HZ", "frames per second (default: 25)"),
    ):
        film.add_argument(name, type=kind, default=default, metavar=unit, help=text)
