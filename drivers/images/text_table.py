"""Text tables of data sets: words separated by blanks or commas, `#` before a comment."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from companion.errors import FlightError
from companion.geometry.transforms import Pose, rotation_from_quaternion

MAX_BYTES = 200_000_000
MAX_S = 9e9
"""Largest Unix seconds whose nanoseconds fit in 64 bits."""


def read_rows(path: Path, n_words: int) -> list[list[str]]:
    """Words of each line; FlightError for a line with too few, or no line at all."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FlightError(f"{path}: longer than {MAX_BYTES // 10**6} MB; that is no such list")
        text = path.read_text("utf-8")
    except OSError as error:
        raise FlightError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise FlightError(f"{path}: it is not text")
    out = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < n_words:
            raise FlightError(f"{path}, line {number}: wanted {n_words} words, found {line[:60]!r}")
        out.append(words)
    if not out:
        raise FlightError(f"{path}: there is nothing in it")
    return out


def numbers_of(path: Path, words: Sequence[str]) -> list[float]:
    """Words as numbers; FlightError unless finite."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [float("nan")]
    if not all(abs(number) < float("inf") for number in numbers):
        raise FlightError(f"{path}: {' '.join(words)[:60]!r} are not all numbers")
    return numbers


def ns_of_seconds(path: Path, word: str) -> int:
    """Nanoseconds of decimal seconds, exact; FlightError if invalid."""
    try:
        seconds = Decimal(word)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not (seconds.is_finite() and abs(seconds) < MAX_S):
        raise FlightError(f"{path}: {word[:30]!r} is not a time in seconds")
    return int(seconds.scaleb(9).to_integral_value())


def ns_of_whole(path: Path, word: str) -> int:
    """Integer nanoseconds; FlightError if invalid."""
    if not (word.isascii() and word.isdigit() and int(word) < 2**63):
        raise FlightError(f"{path}: {word[:30]!r} is not a time in whole nanoseconds")
    return int(word)


def pose_of(path: Path, place: Sequence[float], turn_wxyz: Sequence[float]) -> Pose:
    """Pose of position and quaternion; FlightError for a zero quaternion."""
    length = sum(q * q for q in turn_wxyz) ** 0.5
    if length < 1e-6:
        raise FlightError(f"{path}: a quaternion of zeros")
    turn = rotation_from_quaternion(np.array(turn_wxyz, np.float64) / length)
    return Pose(turn, np.array(place, np.float64))
