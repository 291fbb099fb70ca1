"""Commands for the maps of sites."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from companion.app.cli.options import amount, command, json_option, made_folder
from companion.app.stopping import StopSignals
from companion.errors import InputError

MAP = "a site map, or the folder of a run"
NEW_MAP = "a new site map"


def _map(arguments: argparse.Namespace, signals: StopSignals) -> int | None:
    """Show, verify, export, merge, prune or save; 1 where a map is damaged."""
    from companion.app.maps import map_command as maps

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
        print("\n".join(maps.merge(arguments.maps, arguments.out)))
        print(arguments.out)
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
        commands, "map", _map, help="maps of sites that flights have left",
        description="Maps of sites: the site.map in the folder of a run or a flight.",
    )  # fmt: skip
    whats = of_map.add_subparsers(dest="what", required=True, metavar="WHAT")
    given = argparse.ArgumentParser(add_help=False)
    given.add_argument("map", type=Path, metavar="MAP", help=MAP)

    whats.add_parser(
        "show", parents=[given, json_option()],
        help="say what one is of, and how well it is georeferenced",
    )  # fmt: skip
    verified = whats.add_parser(
        "verify", help="check whether maps are whole; exit status 1 where one is not"
    )
    verified.add_argument("maps", type=Path, nargs="+", metavar="MAP", help=MAP)
    exported = whats.add_parser(
        "export", parents=[given], help="write points.ply, keyframes.tum and map.json"
    )
    exported.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for them")
    merged = whats.add_parser(
        "merge", help="make one map of those of several flights over a site, adjusted as one"
    )
    merged.add_argument("maps", type=Path, nargs="+", metavar="MAP", help=MAP)
    merged.add_argument("--out", type=Path, required=True, metavar="FILE", help=NEW_MAP)
    pruned = whats.add_parser(
        "prune", parents=[given], help="leave out keyframes that others make redundant"
    )
    pruned.add_argument(
        "--within", type=amount, default=3.0, metavar="DEG",
        help="largest angle, seen from its points, to one that stays, degrees (default: 3)",
    )  # fmt: skip
    pruned.add_argument("--out", type=Path, required=True, metavar="FILE", help=NEW_MAP)
    saved = whats.add_parser("save", parents=[given], help="keep the map of a run elsewhere")
    saved.add_argument("--out", type=Path, required=True, metavar="FILE", help=NEW_MAP)
