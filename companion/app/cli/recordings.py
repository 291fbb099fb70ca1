"""Commands for recordings and finished runs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from companion.app.cli.options import (
    add_flag,
    add_path,
    amount,
    at_least,
    check_span,
    command,
    configuration,
    held_folder,
    json_option,
    made_folder,
    made_folder_of,
    seconds,
)
from companion.app.progress import Progress, progress_on
from companion.app.stopping import StopSignals
from companion.config_file import load_config
from companion.errors import InputError


def _flights(arguments: argparse.Namespace, signals: StopSignals) -> int | None:
    """List, show, trim, export, verify, repair or prune; or make a mission of one."""
    from companion.app import flights_command as flights
    from companion.service.flights_meant import flights_meant, installed_services

    folder = arguments.flights
    if folder is None:
        folder = flights_meant(arguments.config, arguments.set, installed_services())
    what = arguments.what
    megabytes = signals.between_frames(progress_on(sys.stderr, "", "MB"))
    if what == "list":
        print(flights.list_flights(folder, arguments.json))
    elif what == "show":
        path = flights.found_recording(arguments.flight, folder)
        print(flights.show_flight(path, arguments.json))
    elif what == "trim":
        check_span(arguments.start, arguments.stop)
        path = flights.found_recording(arguments.flight, folder)
        print(flights.trim_flight(path, arguments.start, arguments.stop, arguments.out, megabytes))
    elif what == "export":
        path = flights.found_recording(arguments.flight, folder)
        progress = signals.between_frames(progress_on(sys.stderr, ""))
        print(flights.export_flight(path, arguments.out, progress))
    elif what == "mission":
        from companion.app.flights_mission import mission

        made_folder_of(arguments.out)
        print(mission(
            arguments.flight, folder, arguments.out, arguments.within, arguments.back
        ))  # fmt: skip
    elif what == "verify":
        text, well = flights.verify_flights(
            flights.recordings_meant(arguments.flights_named, folder), megabytes
        )
        print(text)
        return 0 if well else 1
    elif what == "repair":
        if not arguments.flights_named:
            flights.correct_names(folder)
        paths = flights.recordings_meant(arguments.flights_named, folder)
        return _repair(paths, arguments.gently, megabytes)
    else:
        print(
            flights.prune_flights(
                folder, keep_newest=arguments.keep_newest, older_than_days=arguments.older_than,
                free_mb=arguments.free, dry_run=arguments.dry_run,
            )
        )  # fmt: skip
    return None


def _repair(paths: Sequence[Path], gently: bool, progress: Progress) -> int:
    from companion.app.flights_repair import repair_flights

    repaired = []
    for line, well in repair_flights(paths, progress, gently):
        print(line, flush=True)
        repaired.append(well)
    if not gently:
        n = f"{len(repaired)} of {len(paths)}"
        print(f"{n} recordings cut short, {sum(repaired)} repaired")
    return 0 if all(repaired) else 1


def _compare(arguments: argparse.Namespace, signals: StopSignals) -> int:
    """Compare two runs, 1 where a limit is not kept; or two maps."""
    made_folder(arguments.out)
    if arguments.maps:
        return _compare_maps(arguments)
    from companion.app.compare_command import beyond, compare, in_words

    found = compare(arguments.run_a, arguments.run_b, arguments.out)
    print(in_words(found))
    if arguments.out is not None:
        print(f"report: {arguments.out / 'compare.html'}")
    too_far = beyond(found, arguments.max_apart, arguments.max_cloud)
    for line in too_far:
        print(f"companion: {line}", file=sys.stderr)
    return 1 if too_far else 0


def _compare_maps(arguments: argparse.Namespace) -> int:
    from companion.app.maps.compare_maps import PAGE, changes_in_words, compare_maps

    if arguments.max_apart is not None or arguments.max_cloud is not None:
        raise InputError("--max-apart and --max-cloud are of two runs, not of --maps")
    found = compare_maps(arguments.run_a, arguments.run_b, arguments.out)
    print(changes_in_words(found))
    if arguments.out is not None:
        print(f"report: {arguments.out / PAGE}")
    return 0


def _batch(arguments: argparse.Namespace, signals: StopSignals) -> int:
    """Replay many; 1 where one has failed."""
    from companion.app.batch_command import INDEX, batch

    with held_folder(arguments.out):
        results, maps = batch(
            arguments.flights, arguments.out, load_config(arguments.config, arguments.set),
            scheduler=arguments.scheduler, n_workers=arguments.workers,
            progress=signals.between_frames(progress_on(sys.stderr, "", "flights")),
            merge=arguments.merge,
        )  # fmt: skip
    failed = [result for result in results if result.error]
    for result in failed:
        print(f"companion: {result.name}: {result.error}", file=sys.stderr)
    before = sum(result.done_before for result in results)
    plural = "" if len(results) == 1 else "s"
    print(f"{len(results)} flight{plural}, {before} done before, {len(failed)} failed")
    for each in maps:
        print(f"{arguments.out / each.name}: {', '.join(part.flight for part in each.flights)}")
        for why in each.refused:
            print(f"  stays apart: {why}")
    print(f"index: {arguments.out / INDEX}")
    signals.take()
    return 1 if failed else 0


def add_parsers(commands: Any) -> None:
    """Add them to the subparsers of the program."""
    for add in (_add_flights, _add_compare, _add_batch):
        add(commands)


def _add_compare(commands: Any) -> None:
    compare = command(
        commands, "compare", _compare,
        help="compare two runs of a flight, or two maps of a site",
        description="Compare the --out folders of two replays of one flight: poses, cloud, times. "
        "Exit status 1 if a given limit is exceeded. With --maps: find what is gone, new or moved "
        "at a site between two flights.",
    )  # fmt: skip
    add_path(compare, "run_a", "A", "folder of one replay, its --out")
    add_path(compare, "run_b", "B", "folder of the other")
    add_flag(compare, "--maps", "A and B are site maps of two flights over one site")
    add_path(compare, "--out", "DIR", "write a report with plots there")
    compare.add_argument(
        "--max-apart", type=amount, metavar="M",
        help="limit: RMS distance between their poses, metres",
    )  # fmt: skip
    compare.add_argument(
        "--max-cloud", type=amount, metavar="M",
        help="limit: distance to the other cloud that 95 %% of points keep, metres",
    )  # fmt: skip


def _add_batch(commands: Any) -> None:
    batch = command(
        commands, "batch", _batch, parents=[configuration()],
        help="replay many flights on many cores",
        description="Replay each flight into a folder of DIR, and write DIR/index.html with a row "
        "for each. Finished replays are not repeated. Exit status 1 if a flight failed.",
    )  # fmt: skip
    add_path(batch, "flights", "FLIGHT", "as for `replay`", nargs="+")
    add_path(batch, "--out", "DIR", "folder for the folders of the results", required=True)
    add_flag(batch, "--merge", "merge all maps into DIR/site.map; maps of another site stay apart")
    batch.add_argument(
        "--workers", type=at_least(1), metavar="N",
        help="replays at a time, each in a process (default: one per core)",
    )  # fmt: skip
    batch.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="a Dask cluster that sees the same files, as tcp://192.168.1.5:8786",
    )  # fmt: skip


def _add_flights(commands: Any) -> None:
    place = argparse.ArgumentParser(add_help=False, parents=[configuration()])
    add_path(
        place, "--flights", "DIR",
        "folder of all flights (default: daemon.flights of the given configuration, else that of "
        "the installed service, else ./flights)",
    )  # fmt: skip
    flights = command(commands, "flights", _flights, help="list, show or clean up recordings")
    does = flights.add_subparsers(dest="what", required=True, metavar="WHAT")

    does.add_parser("list", parents=[place, json_option()], help="list all flights")
    show = does.add_parser(
        "show", parents=[place, json_option()], help="show what a recording contains"
    )
    trim = does.add_parser("trim", parents=[place], help="write a part as a new recording")
    trim.add_argument("--start", type=seconds, metavar="S", help="from this second on")
    trim.add_argument("--stop", type=seconds, metavar="S", help="up to this second")
    add_path(trim, "--out", "FILE", "a new .mcap file", required=True)
    export = does.add_parser(
        "export", parents=[place], help="write a flight folder, for other programs",
        description="Write pictures as they were recorded, frames.csv, camera.json, config.toml "
        "and flight.tlog; telemetry.csv instead if no bytes of a link were recorded.",
    )  # fmt: skip
    add_path(export, "--out", "DIR", "a new folder", required=True)
    mission = does.add_parser(
        "mission", parents=[place], help="write its path, or the way back, as a mission",
        description="Write the path of a flight as waypoints for a ground station: FILE.plan for "
        "QGroundControl, FILE.waypoints for Mission Planner and MAVProxy. Heights are above sea "
        "level. Check the mission before it is flown: it does not avoid obstacles.",
    )  # fmt: skip
    add_path(mission, "--out", "FILE", "NAME.plan or NAME.waypoints", required=True)
    mission.add_argument(
        "--within", type=amount, default=0.5, metavar="M",
        help="leave out waypoints this near to the line between others, metres (default: 0.5)",
    )  # fmt: skip
    add_flag(mission, "--back", "the way back: from the end to the beginning")
    for parser in (show, trim, export):
        parser.add_argument("flight", metavar="FLIGHT", help="name, folder or file")
    mission.add_argument(
        "flight", metavar="FLIGHT", help="name or folder of a flight, or folder of a replay"
    )
    _add_upkeep(does, place)


def _add_upkeep(does: Any, place: argparse.ArgumentParser) -> None:
    verify = does.add_parser(
        "verify", parents=[place], help="check all checksums",
        description="Check all checksums of recordings, and change nothing. Exit status 1 if one "
        "is damaged or cut short.",
    )  # fmt: skip
    repair = does.add_parser(
        "repair", parents=[place], help="complete recordings that were cut short",
        description="Complete recordings that were cut short, in place. This also happens when one "
        "is opened, and after the daemon starts. Exit status 1 if one cannot be repaired.",
    )  # fmt: skip
    add_flag(repair, "--gently", "use only processor and disk time that nothing else wants")
    for parser in (verify, repair):
        parser.add_argument(
            "flights_named", metavar="FLIGHT", nargs="*", help="name, folder or file (default: all)"
        )
    prune = does.add_parser(
        "prune", parents=[place], help="delete the oldest flights",
        description="Delete finished flights with all their results, the oldest first. A flight "
        'whose folder contains a file named "keep" stays. If several conditions are given, all '
        "must hold.",
    )  # fmt: skip
    prune.add_argument("--keep-newest", type=at_least(0), metavar="N", help="keep the newest N")
    prune.add_argument(
        "--older-than", type=amount, metavar="DAYS", help="only flights older than this"
    )
    prune.add_argument(
        "--free", type=amount, metavar="MB", help="only until this many megabytes are free"
    )
    add_flag(prune, "--dry-run", "only print which flights would be deleted")
