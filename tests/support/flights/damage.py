"""Damaged copies of files, and their reading in a process with limits."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from companion.config import CameraConfig, TelemetryConfig
from companion.errors import InputError
from companion.messages import Frame, Warned
from drivers.open_flight import open_flight
from drivers.telemetry.log_readers import READERS, aligned, read_log_file
from drivers.telemetry.telemetry_log import Pictures


class Ended(NamedTuple):
    """What became of some work, and what it took."""

    said: str
    cpu_s: float
    peak_mb: float


KINDS = ("cut", "flips", "zeros")
MAX_FRAMES = 8


def damaged(data: bytes, kind: str, seed: int) -> bytes:
    """A copy that was cut, had bits flipped, or whole stretches zeroed."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if not data:
        return data
    if kind == "cut":
        return data[: int(rng.integers(0, len(data)))]
    copy = np.frombuffer(data, np.uint8).copy()
    if kind == "flips":
        n = int(rng.integers(1, max(2, min(2000, len(data) // 50))))
        # half of them near the begin, where formats say what is to come
        at = np.where(rng.random(n) < 0.5, rng.integers(0, len(data), n),
                      rng.integers(0, min(len(data), 4096), n))  # fmt: skip
        np.bitwise_xor.at(copy, at, np.uint8(1) << rng.integers(0, 8, n).astype(np.uint8))
    else:
        for _ in range(int(rng.integers(1, 8))):
            begin = int(rng.integers(0, len(data)))
            copy[begin : begin + int(rng.integers(1, max(2, len(data) // 20)))] = 0
    return copy.tobytes()


def damage_source(source: Path, out: Path, kind: str, seed: int) -> Path:
    """A damaged copy of a file, or of a folder in which one file is damaged."""
    if source.is_file():
        out.mkdir(parents=True)
        (out / source.name).write_bytes(damaged(source.read_bytes(), kind, seed))
        return out / source.name
    copy = out / source.name
    shutil.copytree(source, copy, copy_function=os.link)
    files = sorted(p for p in copy.rglob("*") if p.is_file())
    # texts and heads are few among many pictures: each kind of file is as likely
    kinds = sorted({p.suffix for p in files})
    rng = np.random.default_rng(seed)
    suffix = kinds[int(rng.integers(len(kinds)))]
    same = [p for p in files if p.suffix == suffix]
    chosen = same[int(rng.integers(len(same)))]
    data = chosen.read_bytes()
    chosen.unlink()  # which was a link to the original
    chosen.write_bytes(damaged(data, kind, seed))
    return copy


def read_all(path: Path) -> str:
    """Open a log or a flight and read what is in it; "read", or "refused: why"."""
    try:
        if path.is_file() and path.suffix.lower() in READERS:
            pictures = Pictures(path, 10**18, 2 * 10**18, lambda t_ns: t_ns)
            log = aligned(read_log_file(path), pictures, TelemetryConfig(starts_with_video=True))
            return f"read: {len(log.samples)} samples" if log.samples else "read: nothing in it"
        # a video is not put on a log's time here: that is its own work, and takes long
        config = TelemetryConfig(align="never")
        flight = open_flight(path, CameraConfig(), config)
        n = 0
        for item in flight.frames():
            assert isinstance(item, (Frame, Warned))
            n += 1
            if n == MAX_FRAMES:
                break
        flight.telemetry()
    except InputError as error:
        assert str(error).count("\n") == 0, "more than one line"
        return f"refused: {error}"
    return f"read: {n} frames"


def in_limits(work: Callable[[], str], limit_s: int, memory_mb: int) -> Ended:
    """What work says in a process of its own, or "crashed", "hung" or "memory" and why."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receive)
        try:
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_AS, (memory_mb << 20, memory_mb << 20))
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(limit_s)
            said = work()
        except MemoryError:
            said = "memory: " + traceback.format_exc(limit=-2).replace("\n", " | ")
        except BaseException:
            said = "crashed: " + traceback.format_exc(limit=-3).replace("\n", " | ")
        os.write(send, said.encode()[:4000])
        os._exit(0)
    os.close(send)
    with os.fdopen(receive, "rb") as pipe:
        said_bytes = pipe.read()
    _, status, used = os.wait4(child, 0)
    said = said_bytes.decode("utf-8", "replace") or "crashed: said nothing"
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        said = "hung" if number == signal.SIGALRM else f"crashed: signal {number}"
    return Ended(said, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
