"""Kernels are cached on disk, and compiled where they cannot be."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.slam.compiled import compiling

TEXT = """
from companion.slam.compiled.compiling import compiled, number, numbers

@compiled(numbers, number)
def scaled(values, by):
    return values * by / 0.0
"""

IN_A_PACKAGE = """
import sys, threading
import companion.slam.compiled as package
from companion.slam.compiled import compiling

package.__path__ = [sys.argv[1]]
if sys.argv[2] == "two threads":
    threading.Thread(target=threading.Event().wait, daemon=True).start()
from companion.slam.compiled import loops_of_a_test

assert loops_of_a_test.scaled([1.0], 3.0)[0] == float("inf")
assert compiling.cache_errors == []
print(len(compiling._loops["loops_of_a_test.scaled"].stats.cache_misses))
"""


@pytest.fixture(autouse=True)
def cache_errors(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    found: list[str] = []
    monkeypatch.setattr(compiling, "cache_errors", found)
    yield found


def module_in(folder: Path) -> Any:
    path = folder / "loops_of_a_test.py"
    path.write_text(TEXT, "utf-8")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_kernel_is_compiled_once(tmp_path: Path, cache_errors: list[str]) -> None:
    module_in(tmp_path)
    (kept,) = tmp_path.rglob("*.nbc")  # there before it is called
    stamp = kept.stat().st_mtime_ns
    scaled = module_in(tmp_path).scaled
    assert scaled(np.array([1.0, -2.0, 0.0]), 3.0)[:2].tolist() == [np.inf, -np.inf]
    assert [path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")] == [stamp]
    assert cache_errors == []


def test_corrupt_cache_is_recompiled(tmp_path: Path, cache_errors: list[str]) -> None:
    module_in(tmp_path)
    (kept,) = tmp_path.rglob("*.nbc")
    kept.write_bytes(kept.read_bytes()[:100])
    assert np.isnan(module_in(tmp_path).scaled(np.zeros(3), 1.0)).all()
    assert len(cache_errors) == 1 and cache_errors[0].startswith("scaled: ")


@pytest.mark.parametrize(("threads", "n_compiled"), [("one thread", 0), ("two threads", 1)])
def test_process_of_one_thread_does_not_compile_itself(
    tmp_path: Path, threads: str, n_compiled: int
) -> None:
    """A copy of it does, which takes the compiler's memory with it; threads cannot be copied."""
    (tmp_path / "loops_of_a_test.py").write_text(TEXT, "utf-8")
    command = [sys.executable, "-c", IN_A_PACKAGE, str(tmp_path), threads]
    told = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert told.returncode == 0, told.stderr
    assert told.stderr == ("" if n_compiled else f"{compiling.COMPILES}\n")
    assert int(told.stdout) == n_compiled


def test_without_a_cache_folder_kernels_are_compiled(
    tmp_path: Path, cache_errors: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "__pycache__").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "__pycache__"))
    assert np.isnan(module_in(tmp_path).scaled(np.zeros(2), 1.0)).all()
    assert len(cache_errors) == 1 and "cannot cache" in cache_errors[0]


def test_arrays_of_any_type_and_order_are_accepted(tmp_path: Path) -> None:
    scaled = module_in(tmp_path).scaled
    values = np.arange(1, 9, dtype=np.int32)[::-2]
    assert scaled(values, -1.0).tolist() == [-np.inf] * 4
    values.flags.writeable = False
    assert scaled(values, -1.0).tolist() == [-np.inf] * 4
    with pytest.raises(ValueError, match="longer"):
        scaled(values)
