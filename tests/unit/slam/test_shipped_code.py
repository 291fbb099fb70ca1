"""A package carries its loops compiled: a start compiles none, unless they do not fit."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import companion
from companion.slam.compiled.shipped_code import MADE_FOR, ShippedCode, write

START = """
import importlib, pkgutil
from numba.core.event import install_recorder
from companion.slam import compiled
with install_recorder("numba:compile") as compilations:
    for each in pkgutil.iter_modules(compiled.__path__):
        importlib.import_module(f"{compiled.__name__}.{each.name}")
from companion.slam.compiled import compiling, spreading
import numpy as np
pixels = np.array([[1, 1], [2, 2], [50, 50]], np.float32)
chosen = spreading.spread(pixels, np.array([1, 2, 1], np.float32), 10.0, 2)
print(len(compilations.buffer), chosen.tolist(), compiling.shipped.why_unfit)
"""


def python(folder: Path, *arguments: str) -> str:
    """Output of an interpreter that has companion from a folder, and no cache of loops yet."""
    cache = folder / "loops"
    shutil.rmtree(cache, ignore_errors=True)
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, check=True,
        env=os.environ | {"PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(cache)}, cwd=folder,
    )  # fmt: skip
    return done.stdout.strip()


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with companion, whose loops are compiled for any processor."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(
        Path(companion.__file__).parent, folder / "companion",
        ignore=shutil.ignore_patterns("__pycache__", "sample"),
    )  # fmt: skip
    python(folder, "-m", "companion.slam.compiled.ship")
    return folder


def test_start_compiles_nothing(package: Path) -> None:
    assert python(package, "-c", START) == "0 [1, 2]"
    assert not list((package / "loops").rglob("*.nbi"))


def test_code_of_other_loops_is_not_used(package: Path) -> None:
    module = package / "companion/slam/compiled/undistorting.py"
    text = module.read_text("utf-8")
    module.write_text(f"{text}\n# changed\n", "utf-8")
    said = python(
        package, "-c",
        "from companion.slam.compiled import compiling\n"
        "compiling.may_copy = False\n"  # a copy would compile all loops
        "from companion.slam.compiled import undistorting\n"
        "print(compiling.shipped.why_unfit)",
    )  # fmt: skip
    module.write_text(text, "utf-8")
    assert said.startswith("it is for loops ")
    assert list((package / "loops").rglob("*.nbi"))


def test_code_for_other_versions_is_refused(tmp_path: Path) -> None:
    here = {"numba": "0.68.1", "architecture": "aarch64"}
    write(tmp_path, {"spreading.spread": b"code"}, here)
    assert ShippedCode(tmp_path, here).of("spreading.spread") == b"code"
    newer = ShippedCode(tmp_path, {**here, "numba": "0.69.0"})
    assert newer.of("spreading.spread") is None
    assert newer.why_unfit == "it is for numba 0.68.1, and here is 0.69.0"


def test_no_package_is_no_fault(tmp_path: Path) -> None:
    clone = ShippedCode(tmp_path / "none", {})
    assert clone.of("spreading.spread") is None and not clone.why_unfit


@pytest.mark.parametrize("text", ["{", json.dumps({"numba": 1})])
def test_damaged_description_is_told(tmp_path: Path, text: str) -> None:
    (tmp_path / MADE_FOR).write_text(text)
    found = ShippedCode(tmp_path, {"numba": "0.68.1"})
    assert found.of("any") is None and found.why_unfit
