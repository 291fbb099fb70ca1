"""The command line: dispatch to a command, and its exit status.

0 done; 1 a fault; 2 bad input or usage; 130 and 143 stopped by Ctrl-C and SIGTERM; 141 nobody reads
its output any more, as behind `| head -1`. An error that the program raises on purpose is one line;
anything else is a bug and shows its traceback, that of a stage which was survived before the line
that says so.
"""

from __future__ import annotations

import argparse
import errno
import os
import select
import signal
import sys
import traceback
from collections.abc import Sequence
from typing import TextIO

from companion import __version__
from companion.app.cli import (
    flying,
    hardware,
    maps,
    measuring,
    recordings,
    replaying,
    service_commands,
)
from companion.app.stopping import StopSignals
from companion.errors import CompanionError, InputError, StageError

# In a command libraries are loaded late: they take a second, and --help needs none of them.
FAMILIES = (flying, replaying, recordings, maps, hardware, measuring, service_commands)
OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""Whatever file was to be written: no fault of the program, and the same for each command."""
READER_GONE = 128 + signal.SIGPIPE
"""As of a program that SIGPIPE ends."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status.

    No traceback where its output cannot be written, or nobody reads it.
    """
    try:
        try:
            return _run(argv)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # --help too, which leaves by SystemExit
    except BrokenPipeError:
        if not _readers_gone():
            raise
        return READER_GONE
    except OSError as error:
        why = _why_not_written()
        what = "its output" if why is not None else error.filename or "a file"
        if why is None and error.errno in OF_THE_DISK:
            why = error.strerror
        if why is None:
            raise
        print(f"companion: error: {what} cannot be written: {why}", file=sys.stderr)
        return 1


def _run(argv: Sequence[str] | None) -> int:
    arguments = command_parser().parse_args(argv)
    with StopSignals() as signals:
        try:
            status: int | None = arguments.does(arguments, signals)
            if status is None:
                signals.take()
            return status or 0
        except KeyboardInterrupt:
            print("companion: stopped", file=sys.stderr)
            return signals.exit_status
        except CompanionError as error:
            cause = error.__cause__ if isinstance(error, StageError) else None
            if cause is not None and not isinstance(cause, CompanionError | OSError):
                traceback.print_exception(cause, file=sys.stderr)
            print(f"companion: error: {error}", file=sys.stderr)
            return 2 if isinstance(error, InputError) else 1


def _readers_gone() -> bool:
    """Redirect standard output and error to the null device where their reader is gone; True if so.

    What is still buffered for it would fail once more when the interpreter ends.
    """
    gone = [each for each in (sys.stdout, sys.stderr) if each is not None and _reader_gone(each)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in gone:
        os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
    return bool(gone)


def _why_not_written() -> str | None:
    """The reason why standard output takes not even a line end; None where it does.

    What is still buffered goes nowhere then.
    """
    try:
        print(flush=True)
    except OSError as error:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        return error.strerror or str(error)
    return None


def _reader_gone(stream: TextIO) -> bool:
    try:
        poll = select.poll()
        poll.register(stream.fileno(), 0)  # POLLERR and POLLHUP are always reported
    except (OSError, ValueError):
        return False  # not a file, or closed
    return any(events & (select.POLLERR | select.POLLHUP) for _, events in poll.poll(0))


def command_parser() -> argparse.ArgumentParser:
    """Parser of the whole command line, with a parser for each command."""
    parser = argparse.ArgumentParser(
        prog="companion",
        description="Visual SLAM and dense metric mapping for drones.",
    )
    parser.add_argument("--version", action="version", version=f"companion {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for family in FAMILIES:
        family.add_parsers(commands)
    return parser
