"""Repair of a recording that was cut short, in place."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

from drivers.recording.growing_file import is_growing
from drivers.recording.mcap_file import McapFile
from drivers.recording.mcap_scan import Scan, scan, summary
from drivers.recording.mcap_writer import ending, note_record

NOTE = "repaired"
"""Metadata of a repair: the number of bytes cut off."""


def repair(path: Path, found: Scan) -> bool:
    """Truncate a file at the end of its valid data, and write the index; whether that was possible.

    Not while it is being written, where it may not be written, without free space, or where another
    process has repaired it. `found` is the scan of it. A repair that is interrupted leaves a file
    that can be repaired again.
    """
    try:
        fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.fstat(fd).st_size != found.n_bytes:
            return False
        note, index = note_record(NOTE, {"cut_bytes": str(n_cut_bytes(found))}, found.good_end)
        found.contents.metadata.append(index)
        tail = note + ending(found.contents, found.good_end + len(note))
        os.ftruncate(fd, found.good_end)
        os.pwrite(fd, tail, found.good_end)
        os.fsync(fd)
    except OSError:
        return False
    finally:
        os.close(fd)
    return True


def unfinished(path: Path) -> bool:
    """True if its writer is gone and has not ended it; reads the end of the file only.

    FlightError where it is no MCAP file.
    """
    with McapFile(path) as file:
        return file.end_of_data() is None and not is_growing(file.fd)


def in_place(path: Path, on_progress: Callable[[int], None] | None = None) -> int | None:
    """Repair a file; bytes cut off, None where that was impossible.

    `on_progress` takes the bytes read. FlightError where it is no MCAP file.
    """
    with McapFile(path) as file:
        found = scan(file, on_progress)
    return found.n_cut_bytes if found.whole or repair(path, found) else None


def n_cut_bytes(found: Scan) -> int:
    """Bytes cut off by an earlier repair, or to be cut off."""
    noted = found.metadata.get(NOTE, {}).get("cut_bytes", "0")
    return found.n_cut_bytes + (int(noted) if noted.isdigit() else 0)


def was_cut(found: Scan) -> bool:
    """True if its writer did not end it, repaired since or not."""
    return not found.whole or NOTE in found.metadata


def opened(path: Path) -> tuple[McapFile, Scan]:
    """A file and its content, repaired where it is cut short and that is possible.

    Of a whole file only its end is read: damage of a chunk shows when it is read. FlightError where
    it is no MCAP file.
    """
    file = McapFile(path)
    found = summary(file) or scan(file)
    if not found.whole and repair(path, found):
        file.close()
        file = McapFile(path)
        again = scan(file)
        again.n_lost_bytes = found.n_lost_bytes - found.n_cut_bytes
        again.n_lost_places = found.n_lost_places
        return file, again
    return file, found
