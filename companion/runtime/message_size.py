"""Memory size of messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from companion.geometry.pose_table import PoseTable

SMALL_BYTES, ENTRY_BYTES = 256, 400
"""Measured: a message without arrays; an entry of a mapping whose values are poses."""


def size_bytes(message: Any) -> int:
    """Approximate size of a message: its arrays and bytes, its mappings by their length."""
    parts = fields(message) if is_dataclass(message) else ()
    return SMALL_BYTES + sum(_size(getattr(message, part.name)) for part in parts)


def _size(value: Any) -> int:
    if isinstance(value, np.ndarray | PoseTable):
        return int(value.nbytes)
    if isinstance(value, bytes | bytearray | str):
        return len(value)
    return ENTRY_BYTES * len(value) if isinstance(value, Mapping) else 0
