"""`companion support`: what a maintainer needs to help, in one file, said to whom it shows what."""

from __future__ import annotations

import io
import json
import platform
import subprocess
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from companion import __version__
from companion.app.doctor_command import doctor
from companion.app.flights_command import list_flights, show_flight, trim_flight
from companion.app.progress import Progress
from companion.config import Config
from companion.config.passwords import without_passwords
from companion.config_file import shown
from companion.errors import CompanionError, InputError
from companion.products.atomic_file import write_atomically
from drivers.recording.flights_folder import flown_in, recordings_in
from drivers.recording.recording_reader import with_pictures
from drivers.system.status_socket import ask_status, found_socket_path

JOURNAL_LINES = 2000
JOURNAL_WAIT_S = 20.0
MAX_RECORDING_MB = 200.0
"""A piece larger than this is left out: it must go through a mailer or an issue tracker."""
MB = 1e6
README = "README.txt"


@dataclass(frozen=True, slots=True)
class Part:
    """A file of the bundle: what it is, and what it shows of its owner; `missing` says why not."""

    name: str
    what: str
    shows: str
    data: bytes = b""
    missing: str = ""


def support(
    config: Config, flights: Path, out: Path, seconds: float, say: Callable[[str], None]
) -> int:
    """Write the bundle to the file `out`, and tell what is in it; the number of files.

    The last `seconds` of the newest recording are in it, 0 for none. What cannot be had is named
    with its reason. InputError where the file cannot be written.
    """
    parts = list(_parts(config, flights, seconds))
    text = _contents(parts)
    packed = io.BytesIO()
    there = [part for part in parts if not part.missing]
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as bundle:
        bundle.writestr(README, text)
        for part in there:
            # a recording is packed already
            stored = zipfile.ZIP_STORED if part.name.endswith(".mcap") else zipfile.ZIP_DEFLATED
            bundle.writestr(part.name, part.data, stored)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(out, packed.getvalue())
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from error
    say(text.rstrip())
    say(f"{out}: {len(packed.getvalue()) / MB:.1f} MB")
    return len(there) + 1


def _contents(parts: Sequence[Part]) -> str:
    lines = [
        f"What `companion support` of version {__version__} packed, for whoever helps with it.",
        "Whoever gets this file can read all of it: nothing in it is encrypted.",
        "",
    ]
    for part in parts:
        if part.missing:
            lines.append(f"{part.name}: not there: {part.missing}")
        else:
            size = len(part.data) / 1000
            lines.append(f"{part.name} ({size:,.0f} kB): {part.what}. Shows: {part.shows}.")
    lines += [
        "",
        "Passwords of URLs are made unreadable. Keys (MAVLink signing, pairing) are in no file.",
        "Not wanted: leave a file out with `zip -d FILE NAME`; pictures, with --seconds 0.",
    ]
    return "\n".join(lines) + "\n"


def _parts(config: Config, flights: Path, seconds: float) -> Iterator[Part]:
    yield Part("versions.txt", "versions of the program and of what it uses, and the computer",
               "make of computer and system", _versions())  # fmt: skip
    settings = json.dumps(shown(config), indent=1, ensure_ascii=False).encode()
    yield Part("settings.json", "the configuration in use",
               "addresses, names of devices and folders", settings)  # fmt: skip
    kept = config.control.keep
    yield _tried(
        Part("kept_parameters.toml", "what a ground station has set", "nothing else"),
        lambda: _file(Path(kept)) if kept else _none("expert.control.keep names no file"),
    )
    yield _tried(
        Part("parameters.txt", "what `companion doctor` says of the autopilot's parameters",
             "make and firmware of the autopilot"),
        lambda: _doctor(config),
    )  # fmt: skip
    yield _tried(
        Part("status.json", "health of the running daemon",
             "WHERE ON EARTH it flies, and where its flights lie"),
        lambda: json.dumps(ask_status(found_socket_path(config.daemon.socket)), indent=1).encode(),
    )  # fmt: skip
    yield _tried(
        Part("journal.txt", f"the last {JOURNAL_LINES} lines of the service",
             "times of flights, name of the computer"),
        _journal,
    )  # fmt: skip
    yield _tried(
        Part("flights.txt", "list of the recorded flights", "when they were, and how long"),
        lambda: list_flights(flights, False).encode(),
    )
    yield from _recording(flights, seconds)


def _recording(flights: Path, seconds: float) -> Iterator[Part]:
    piece = Part(
        "newest.mcap", f"the last {seconds:g} s of the newest recording",
        "PICTURES of the camera, and where on Earth it flew",
    )  # fmt: skip
    try:
        newest = [path for flight in flown_in(flights) for path in recordings_in(flight.path)]
    except CompanionError as error:
        newest, why = [], str(error)
    else:
        why = f"no recording in {flights}"
    if not newest:
        yield Part(piece.name, piece.what, piece.shows, missing=why)
        return
    yield _tried(
        Part("newest.txt", "what the newest recording holds", "when it was"),
        lambda: show_flight(newest[-1], False).encode(),
    )
    yield _tried(piece, lambda: _piece(newest[-1], seconds))


def _piece(path: Path, seconds: float) -> bytes:
    if not seconds:
        _none("--seconds 0")
    length_s = _length_s(path)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "newest.mcap"
        trim_flight(path, max(length_s - seconds, 0.0) or None, None, out, Progress())
        if out.stat().st_size > MAX_RECORDING_MB * MB:
            _none(f"{out.stat().st_size / MB:.0f} MB are too many: give fewer --seconds")
        return out.read_bytes()


def _length_s(path: Path) -> float:
    """Seconds from the first picture to the last."""
    recording = with_pictures(path)
    try:
        return (recording.pictures[-1].t_ns - recording.pictures[0].t_ns) * 1e-9
    finally:
        recording.close()


def _tried(part: Part, make: Callable[[], bytes]) -> Part:
    """The part with its data, or with the reason why it has none."""
    try:
        data = make()
    except (CompanionError, OSError, subprocess.SubprocessError) as error:
        return Part(part.name, part.what, part.shows, missing=str(error))
    return Part(part.name, part.what, part.shows, data)


def _none(why: str) -> bytes:
    raise InputError(why)


def _file(path: Path) -> bytes:
    return path.read_bytes()


def _doctor(config: Config) -> bytes:
    said = io.StringIO()
    doctor(config, out=said)
    return said.getvalue().encode()


def _journal() -> bytes:
    command = ["journalctl", "--unit", "companion", "--lines", str(JOURNAL_LINES), "--no-pager"]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=JOURNAL_WAIT_S, check=False
    )
    if done.returncode:
        _none((done.stderr.strip().splitlines() or ["journalctl failed"])[-1])
    if not done.stdout.strip() or done.stdout.startswith("-- No entries"):
        _none("the journal has no line of the service: is it run by hand?")
    return without_passwords(done.stdout).encode()


def _versions() -> bytes:
    libraries = sorted(
        {f"{each.metadata['Name']} {each.version}" for each in metadata.distributions()},
        key=str.lower,
    )
    lines = [
        f"companion {__version__}", f"python {platform.python_version()}", platform.platform(),
        *_of_file(Path("/etc/os-release"), "PRETTY_NAME="),
        *_of_file(Path("/proc/device-tree/model"), ""),
        *_of_file(Path("/proc/meminfo"), "MemTotal:"), "", *libraries,
    ]  # fmt: skip
    return ("\n".join(lines) + "\n").encode()


def _of_file(path: Path, begins: str) -> list[str]:
    """The first line with this beginning, where the file is there."""
    try:
        lines = path.read_text("utf-8", "replace").replace("\0", "").splitlines()
    except OSError:
        return []
    return [line.removeprefix(begins).strip() for line in lines if line.startswith(begins)][:1]
