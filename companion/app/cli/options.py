"""Options that several commands share, and parsers of their values."""

from __future__ import annotations

import argparse
import fcntl
import math
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from companion.app.stopping import StopSignals
from companion.config.setting_keys import words_of
from companion.errors import InputError

PROFILE = "computer.profile"
Command = Callable[[argparse.Namespace, StopSignals], int | None]
"""Implementation of a command: arguments in, exit status out; None for 0, unless a stop came."""


def command(commands: Any, name: str, does: Command, **options: Any) -> argparse.ArgumentParser:
    """Add a command to the subparsers of the program, with options of its parser."""
    parser: argparse.ArgumentParser = commands.add_parser(name, **options)
    parser.set_defaults(does=does)
    return parser


def add_flag(parser: argparse.ArgumentParser, name: str, text: str) -> None:
    """Add an option without a value."""
    parser.add_argument(name, action="store_true", help=text)


def add_path(
    parser: argparse.ArgumentParser, name: str, metavar: str, text: str, **options: Any
) -> None:
    """Add an argument, or an option, that is a path."""
    parser.add_argument(name, type=Path, metavar=metavar, help=text, **options)


def configuration() -> argparse.ArgumentParser:
    """--config, --set and --profile, for `parents`."""
    options = argparse.ArgumentParser(add_help=False)
    add_path(options, "--config", "FILE", "configuration, a TOML file; see docs/settings.md")
    options.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE",
        help="set one key; overrides the file; can be repeated",
    )  # fmt: skip
    options.add_argument(
        "--profile", dest="set", action="append", type=profile, metavar="NAME",
        help=f"settings for a computer; the file overrides them: {', '.join(words_of(PROFILE))}",
    )  # fmt: skip
    return options


def profile(name: str) -> str:
    """`--set` that takes a profile."""
    if name not in words_of(PROFILE):
        raise argparse.ArgumentTypeError(
            f"wanted one of {', '.join(words_of(PROFILE))}, given is {name}"
        )
    return f"{PROFILE}={name}"


def json_option() -> argparse.ArgumentParser:
    """--json, for `parents`."""
    options = argparse.ArgumentParser(add_help=False)
    add_flag(options, "--json", "print JSON, for programs")
    return options


def made_folder(path: Path | None, wanted: str = "a folder") -> None:
    """Make the folder that --out names, before any work; InputError where it cannot be written."""
    if path is None:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        why = error.strerror or error
        raise InputError(f"{path}: cannot be written: {why}; --out wants {wanted}") from error


def made_folder_of(file: Path) -> None:
    """As `made_folder`, of the file that --out names."""
    if file.is_dir():
        raise InputError(f"{file}: is a folder; --out wants a file")
    made_folder(file.parent, "a file in a folder")


def check_span(start_s: float | None, stop_s: float | None) -> None:
    """InputError where --stop is not after --start."""
    if start_s is not None and stop_s is not None and stop_s <= start_s:
        raise InputError(f"--stop {stop_s:g} is not after --start {start_s:g}")


@contextmanager
def held_folder(path: Path) -> Iterator[None]:
    """Make the folder of --out, and hold it; InputError where another run writes into it.

    Two runs would leave the path of one beside the cloud of the other.
    """
    made_folder(path)
    folder = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError):  # a file system without locks
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"{path}: another run writes into it; wait for its end, or give another --out"
                ) from None
        yield
    finally:
        os.close(folder)


def names(text: str) -> tuple[str, ...]:
    """Comma-separated names."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def shift(text: str) -> float:
    """Seconds to add to a clock."""
    seconds = float(text)
    if not abs(seconds) <= 1e10:
        raise ValueError
    return seconds


def seconds(text: str) -> float:
    """Seconds since the first frame."""
    value = float(text)
    if not (math.isfinite(value) and value >= 0):
        raise argparse.ArgumentTypeError(f"wanted seconds since the first frame, given is {text}")
    return value


def at_least(low: int) -> Callable[[str], int]:
    """Parser of whole numbers from `low` on."""

    def parsed(text: str) -> int:
        value = int(text) if text.isascii() and text.isdigit() else low - 1
        if value < low:
            raise argparse.ArgumentTypeError(f"wanted a number from {low} on, given is {text}")
        return value

    return parsed


def within(low: float, high: float, kind: type[float] = float) -> Callable[[str], float]:
    """Parser of numbers from `low` to `high`; of `kind` int of whole ones."""

    def parsed(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"wanted {low:g} to {high:g}, given is {text}")
        return value

    return parsed


def amount(text: str) -> float:
    """A number, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"wanted a number from 0 on, given is {text}")
    return value


def frames(text: str) -> tuple[int | None, int | None]:
    """First and last frame, the last not included; None where open."""
    first, colon, beyond = text.partition(":")
    try:
        out = (int(first) if first else None, int(beyond) if beyond else None)
    except ValueError:
        colon = ""
    if not colon or (None not in out and out[1] <= out[0]):  # type: ignore[operator]
        raise argparse.ArgumentTypeError(f"wanted FIRST:BEYOND, given is {text}")
    return out


def depths(text: str) -> tuple[float, float]:
    """Least and greatest depth, metres."""
    near, _, far = text.partition(":")
    try:
        out = float(near), float(far)
    except ValueError:
        out = 0.0, 0.0
    if not (0 < out[0] < out[1] < math.inf):
        raise argparse.ArgumentTypeError(f"wanted NEAR:FAR in metres, given is {text}")
    return out


def viewer(text: str) -> str:
    """Viewer to use."""
    if text in ("none", "web", "native") or text.startswith(("rerun+http://", "rerun+https://")):
        return text
    raise argparse.ArgumentTypeError(
        f"wanted none, web, native or rerun+http://HOST:PORT/proxy, given is {text}"
    )
