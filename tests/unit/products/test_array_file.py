"""Arrays put into a file are what they were; a full disk is told."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from companion.products import array_file
from companion.products.array_file import ArrayFile

RANDOM = np.random.default_rng(8)


def some(n: int) -> list[object]:
    return [
        RANDOM.normal(size=(n, 2)), RANDOM.integers(0, 9, n), np.zeros((0, 24, 24), np.uint8),
        RANDOM.integers(0, 256, (n, 32), dtype=np.uint8)[::2], RANDOM.random(n) < 0.5,
    ]  # fmt: skip


def test_arrays_are_what_they_were(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(array_file, "SEGMENT_BYTES", 100_000)
    file = ArrayFile(tmp_path)
    given = [some(n) for n in (700, 3, 0, 5000, 1, 900)]
    kept = [file.put(each) for each in given]
    file.forget()
    assert len(file._segments) > 2
    for before, after in zip(given, kept, strict=True):
        assert after is not None
        for a, b in zip(before, after, strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype and not b.flags.writeable  # type: ignore[attr-defined]
    assert list(tmp_path.iterdir()) == []  # it goes with the program


def test_memory_is_given_back(tmp_path: Path) -> None:
    file = ArrayFile(tmp_path)
    (kept,) = file.put([np.ones(20 << 20, np.uint8)]) or [None]

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[2]) * os.sysconf("SC_PAGESIZE")

    before = resident()
    assert kept is not None and kept.sum() == 20 << 20
    assert resident() - before > 15 << 20
    file.forget()
    assert resident() - before < 5 << 20
    assert kept[::4096].sum() == 5 << 10


def test_a_full_disk_is_told_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = ArrayFile(tmp_path)
    (kept,) = file.put([np.arange(9)]) or [None]

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    assert file.put([np.arange(9)]) is None
    assert file.fault == f"{tmp_path}: No space left on device"
    monkeypatch.undo()
    assert file.put([np.arange(9)]) is None
    assert kept is not None and kept.tolist() == list(range(9))


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    file = ArrayFile(tmp_path / "none")
    assert file.put([np.arange(9)]) is None
    assert "No such file" in file.fault
