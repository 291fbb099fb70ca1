"""Commands for the maps of sites."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from companion.app.cli.options import (
    add_path,
    amount,
    command,
    json_option,
    made_folder,
    made_folder_of,
)
from companion.app.stopping import StopSignals
from companion.errors import InputError

MAP = "a site map, or the folder of a run"
NEW_MAP = "a new site map"


def _map(arguments: argparse.Namespace, signals: StopSignals) -> int | None:
    """Show, verify, export, merge, prune or save; 1 where a map is damaged."""
    from companion.app.maps import map_command as maps

    if arguments.what in ("merge", "prune", "save"):
        made_folder_of(arguments.out)
    if arguments.what == "show":
        print(maps.show(arguments.map, arguments.json))
    elif arguments.what == "verify":
        verified = [maps.verify(path) for path in arguments.maps]
        print("\n".join(text for text, _ in verified))
        return 0 if all(whole for _, whole in verified) else 1
    elif arguments.what == "export":
        made_folder(arguments.out)
        for path in maps.export(arguments.map, arguments.out):
            print(path)
    elif arguments.what == "merge":
        if len(arguments.maps) < 2:
            raise InputError("merge wants two maps or more")
        print(maps.merge(arguments.maps, arguments.out, arguments.json))
    elif arguments.what == "prune":
        print(maps.prune(arguments.map, arguments.out, arguments.within))
        print(arguments.out)
    else:
        for each in maps.save(arguments.map, arguments.out).damaged:
            print(f"companion: {arguments.map}: {each} is damaged, and left out", file=sys.stderr)
        print(arguments.out)
    return None


def add_parsers(commands: Any) -> None:
    """Add the parsers of these commands."""
    of_map = command(
        commands, "map", _map, help="show, check, export, merge or thin maps of sites",
        description="Work with maps of sites: the site.map in the folder of a run or a flight.",
    )  # fmt: skip
    whats = of_map.add_subparsers(dest="what", required=True, metavar="WHAT")
    given = argparse.ArgumentParser(add_help=False)
    add_path(given, "map", "MAP", MAP)
    whats.add_parser(
        "show", parents=[given, json_option()],
        help="show its size, its flights, and how well it is georeferenced",
    )  # fmt: skip
    verified = whats.add_parser(
        "verify", help="check whether maps are intact; exit status 1 if one is not"
    )
    add_path(verified, "maps", "MAP", MAP, nargs="+")
    exported = whats.add_parser(
        "export", parents=[given], help="write points.ply, keyframes.tum and map.json"
    )
    add_path(exported, "--out", "DIR", "folder for them", required=True)
    merged = whats.add_parser(
        "merge",
        parents=[json_option()],
        help="merge maps of several flights over a site, and adjust them as one",
    )
    add_path(merged, "maps", "MAP", MAP, nargs="+")
    add_path(merged, "--out", "FILE", NEW_MAP, required=True)
    pruned = whats.add_parser("prune", parents=[given], help="leave out redundant keyframes")
    pruned.add_argument(
        "--within", type=amount, default=10.0, metavar="DEG",
        help="largest angle, seen from its points, to its neighbour (default: 10 degrees)",
    )  # fmt: skip
    add_path(pruned, "--out", "FILE", NEW_MAP, required=True)
    saved = whats.add_parser("save", parents=[given], help="copy the map of a run")
    add_path(saved, "--out", "FILE", NEW_MAP, required=True)
