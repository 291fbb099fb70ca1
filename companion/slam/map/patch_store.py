"""Patches of map points, by rows that are used again; those of far points lie in other arrays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from companion.messages import Bytes
from companion.slam.compiled.patch_alignment import STORED
from companion.slam.features.orb_features import Ints

NO_PATCH = -1
LEAST_ROWS = 4096


class PatchRows(Protocol):
    """Patches (N, 24, 24) u8 by row."""

    def __len__(self) -> int: ...

    def __getitem__(self, at: Any, /) -> Any: ...


class PatchesLater:
    """N patches that nothing changes, in blocks: `read` is called with the first row of each."""

    def __init__(self, n: int, block: int, read: Callable[[int], Bytes]) -> None:
        self._n, self._block, self._read = n, block, read
        self._blocks: dict[int, Bytes] = {}

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, at: Ints) -> Bytes:
        out = np.empty((len(at), STORED, STORED), np.uint8)
        firsts = at - at % self._block
        for first in np.unique(firsts).tolist():
            if first not in self._blocks:
                self._blocks[first] = self._read(first)
            own = firsts == first
            out[own] = self._blocks[first][at[own] - first]
        return out


@dataclass(slots=True, eq=False)
class PatchStore:
    """Patches (24, 24) u8 by number: from 0 in `near`, below NO_PATCH in arrays put away."""

    near: Bytes = field(default_factory=lambda: np.zeros((1, STORED, STORED), np.uint8))
    """The last row is looked at for NO_PATCH."""
    _free: list[int] = field(default_factory=list)
    _far: list[PatchRows] = field(default_factory=list)
    _far_begins: list[int] = field(default_factory=lambda: [0])
    """Number of patches before each array of `_far`, and of all."""

    def add(self, grey: Bytes) -> list[int]:
        """Store patches (N, 24, 24); their numbers."""
        missing = len(grey) - len(self._free)
        if missing > 0:
            size = len(self.near)
            new = max(LEAST_ROWS, size // 2, missing)
            grown = np.zeros((size + new, STORED, STORED), np.uint8)
            grown[:size] = self.near
            self.near = grown
            self._free += range(size + new - 1, size - 1, -1)
        numbers = [self._free.pop() for _ in range(len(grey))]
        self.near[numbers] = grey
        return numbers

    def free(self, numbers: Ints) -> None:
        """Use the rows of patches that are not needed any more again; far ones have none."""
        self._free += numbers[numbers >= 0].tolist()

    def of(self, numbers: Ints) -> Bytes:
        """The patches (N, 24, 24), a copy; of NO_PATCH anything."""
        grey = self.near[np.maximum(numbers, NO_PATCH)]
        is_far = numbers < NO_PATCH
        if is_far.any():
            at = NO_PATCH - 1 - numbers
            which = np.searchsorted(self._far_begins, at, "right") - 1
            for k in np.unique(which[is_far]).tolist():
                own = is_far & (which == k)
                grey[own] = self._far[k][at[own] - self._far_begins[k]]
        return grey

    def take_over(self, other: PatchStore, numbers: Ints) -> Ints:
        """Patches of another store, which is invalid afterwards; their numbers here."""
        out = numbers - self._far_begins[-1]
        near = numbers >= 0
        out[near] = self.add(other.near[numbers[near]])
        out[numbers == NO_PATCH] = NO_PATCH
        for grey in other._far:
            self._keep_far(grey)
        return out

    def put_away(self, numbers: Ints, grey: PatchRows) -> Ints:
        """Free the rows of near patches, which are in an array `grey` from now on; new numbers."""
        self.free(numbers)
        first = self._keep_far(grey)
        return NO_PATCH - 1 - np.arange(first, first + len(grey))

    def _keep_far(self, grey: PatchRows) -> int:
        """Keep an array of far patches; the number of those before it."""
        first = self._far_begins[-1]
        self._far.append(grey)
        self._far_begins.append(first + len(grey))
        return first
