"""companion batch: replays many flights on many cores or machines, with one page about all.

Each flight is a task of Dask, which runs it in a process of its own. What is done already, with the
same files and settings, is not done again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2

from companion import __version__
from companion.app.maps.merged_maps import Pair, merge_flights, merge_pair
from companion.app.progress import Progress
from companion.app.replay.replay_command import RecordedInput, replay
from companion.config import CameraConfig, Config
from companion.config_file import shown
from companion.errors import CompanionError, InputError
from companion.messages import Frame
from companion.products.atomic_file import write_atomically
from companion.products.report.batch_page import BatchResult, MergedMap, batch_page
from drivers.open_flight import open_flight

THUMBNAIL_PX, THUMBNAIL_QUALITY = 240, 80
DONE, INDEX, REPORT, THUMBNAIL = "batch.json", "index.html", "report.json", "thumbnail.jpg"
CONNECT = "10s"
"""Longest wait for a scheduler that is asked for."""
MOST_FILES = 1000
"""Files of a flight's folder checked for changes; a flight of images has its list besides."""


def batch(
    flights: Sequence[Path], out: Path, config: Config, *, scheduler: str | None,
    n_workers: int | None, progress: Progress, merge: bool = False,
) -> tuple[list[BatchResult], list[MergedMap]]:  # fmt: skip
    """Replay all flights into folders of `out`, and write index.html there.

    With `merge` their site maps become one, or several where they show no common place.
    `scheduler` is the address of a Dask cluster that sees the same files, else processes of this
    machine do it. InputError where Dask is not there.
    """
    out.mkdir(parents=True, exist_ok=True)
    results: dict[str, BatchResult] = {}
    todo: dict[str, tuple[Path, str]] = {}
    for name, flight in _named(flights).items():
        mark = _mark(flight, config)
        report = _done(out / name, mark)
        if report is not None:
            results[name] = BatchResult(name, flight, "", report, done_before=True)
        else:
            todo[name] = flight, mark
    names = [*_named(flights)]

    maps: list[MergedMap] = []

    def write_index() -> list[BatchResult]:
        known = [results[name] for name in names if name in results]
        pictures = {each.name: _bytes(out / each.name / THUMBNAIL) for each in known}
        write_atomically(out / INDEX, batch_page(known, pictures, maps))
        return known

    progress.start(len(names))
    progress.update(len(results), "done", 0)
    if todo or merge:
        with _cluster(scheduler, n_workers or max(len(todo), len(names) // 2, 1)) as client:
            write_index()
            for result in _replayed(client, out, todo, config):
                results[result.name] = result
                progress.update(len(results), "done", 0)
                write_index()
            if merge:
                good = [name for name in names if not results[name].error]
                maps = merge_flights(good, out.absolute(), partial(_merged_pairs, client))
    progress.finish()
    return write_index(), maps


def replay_one(name: str, flight: Path, out: Path, config: Config, mark: str) -> BatchResult:
    """One Dask task. An error of the flight ends that flight only."""
    folder = out / name
    for left in (DONE, REPORT):  # of a replay with other settings
        (folder / left).unlink(missing_ok=True)
    try:
        given = RecordedInput(flight, config)
        replay(given, folder, config, "none", Progress(), lambda remark: None)
        write_atomically(folder / THUMBNAIL, thumbnail(flight, config.camera))
    except (CompanionError, OSError) as error:
        return BatchResult(name, flight, str(error), _object(folder / REPORT) or {})
    except Exception as error:  # a bug that one flight brings out must not cost the others
        return BatchResult(name, flight, f"{type(error).__name__}: {error}", {})
    write_atomically(folder / DONE, json.dumps({"mark": mark}).encode())
    return BatchResult(name, flight, "", _object(folder / REPORT) or {})


@contextmanager
def _cluster(scheduler: str | None, n_wanted: int) -> Iterator[Any]:
    try:
        import distributed
    except ImportError as error:
        raise InputError("companion batch needs Dask: pip install '.[batch]' in a clone") from error
    dask: Any = distributed  # whose calls carry no types
    if scheduler is not None:
        try:
            client = dask.Client(scheduler, timeout=CONNECT)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(f"{scheduler}: there is no Dask scheduler: {error}") from error
        with client:
            yield client
        return
    n_workers = min(n_wanted, len(os.sched_getaffinity(0)))
    with (
        dask.LocalCluster(
            n_workers=n_workers, threads_per_worker=1, processes=True, memory_limit=0,
            dashboard_address=None, silence_logs=logging.ERROR,
        ) as cluster,
        dask.Client(cluster) as client,
    ):  # fmt: skip
        yield client


def _replayed(
    client: Any, out: Path, todo: dict[str, tuple[Path, str]], config: Config
) -> Iterator[BatchResult]:
    """Results of all flights, as they come."""
    from distributed import as_completed

    completed: Any = as_completed
    futures = {
        client.submit(replay_one, name, flight.absolute(), out.absolute(), config, mark,
                      pure=False): (name, flight)
        for name, (flight, mark) in todo.items()
    }  # fmt: skip
    for future in completed(futures):
        name, flight = futures[future]
        error = future.exception()
        if error is not None:  # its process has died
            yield BatchResult(name, flight, f"{type(error).__name__}: {error}", {})
        else:
            yield dataclasses.replace(future.result(), flight=flight)


def _merged_pairs(client: Any, pairs: Sequence[Pair]) -> Iterator[str]:
    """Answer of `merge_pair` for each pair of maps. InputError where a process has died."""
    futures = [client.submit(merge_pair, *pair, pure=False) for pair in pairs]
    for (first, other, _), future in zip(pairs, futures, strict=True):
        error = future.exception()
        if isinstance(error, CompanionError | OSError):
            raise error
        if error is not None:
            raise InputError(f"{first} and {other} cannot be merged: {error}") from error
        yield str(future.result())


def _named(flights: Sequence[Path]) -> dict[str, Path]:
    """Unique name of each flight: that of its folder or file, numbered where two are equal."""
    out: dict[str, Path] = {}
    for flight in flights:
        own = flight.absolute()
        base = own.parent.name if own.stem == "flight" and own.is_file() else own.stem
        name, number = base or "flight", 2
        while name in out:
            name, number = f"{base}-{number}", number + 1
        out[name] = flight
    return out


def _mark(flight: Path, config: Config) -> str:
    """Hash of the files' names, sizes and times, the settings and the program version."""
    inside = sorted(flight.iterdir())[:MOST_FILES] if flight.is_dir() else [flight]
    files = []
    for path in inside:
        try:
            status = path.stat()
        except OSError:
            continue
        if path.is_file():
            files.append([path.name, status.st_size, status.st_mtime_ns])
    text = json.dumps([str(flight.absolute()), files, shown(config), __version__])
    return hashlib.sha256(text.encode()).hexdigest()


def _done(folder: Path, mark: str) -> dict[str, Any] | None:
    """Report of a flight that was done with the same mark, or None."""
    said = _object(folder / DONE) or {}
    return _object(folder / REPORT) if said.get("mark") == mark else None


def _object(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def thumbnail(flight: Path, config: CameraConfig) -> bytes:
    """JPEG of the middle frame; empty where none can be decoded. FlightError likewise."""
    opened = open_flight(flight, config)
    middle_ns = opened.times_ns[opened.n_frames // 2]
    for frame in opened.frames(middle_ns):
        if isinstance(frame, Frame):
            height, width = frame.grey.shape
            size = THUMBNAIL_PX, max(1, round(height * THUMBNAIL_PX / width))
            small = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
            bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
            return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, THUMBNAIL_QUALITY])[
                1
            ].tobytes()
    return b""
