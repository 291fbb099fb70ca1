"""Memory size of messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any

import numpy as np

from companion.geometry.pose_table import PoseTable

SMALL_BYTES, ENTRY_BYTES = 256, 400
"""Measured: a message without arrays; an entry of a mapping whose values are poses."""

WITHOUT_SIZE = int, float, type(None)


def size_bytes(message: Any) -> int:
    """Approximate size of a message: its arrays and bytes, its mappings by their length."""
    return SMALL_BYTES + sum(_size(getattr(message, name)) for name in _names_of(message.__class__))


@cache
def _names_of(kind: Any) -> tuple[str, ...]:
    return tuple(part.name for part in fields(kind)) if is_dataclass(kind) else ()


def _size(value: Any) -> int:
    if isinstance(value, WITHOUT_SIZE):  # most of all, and what is a mapping is slow to tell
        return 0
    if isinstance(value, np.ndarray | PoseTable):
        return int(value.nbytes)
    if isinstance(value, bytes | bytearray | str):
        return len(value)
    return ENTRY_BYTES * len(value) if isinstance(value, Mapping) else 0
