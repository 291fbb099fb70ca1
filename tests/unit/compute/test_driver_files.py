"""A driver that takes the loader with it is left out, and the others are found."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import pytest

from companion.compute.device_probe import listed_devices
from companion.compute.driver_files import VENDORS, driver_files, folder_with

LOADER = """
import json, os, pathlib, sys, time
names = sorted(each.stem for each in pathlib.Path(os.environ["OCL_ICD_VENDORS"]).glob("*.icd"))
if "aborts" in names:
    print("no such device", file=sys.stderr, flush=True)
    os.abort()
if "hangs" in names:
    time.sleep(60)
for number, name in enumerate(names):
    print(json.dumps({"asked": number, "name": name}))
    each = {"number": f"{number}:0", "name": "d", "platform": name}
    print(json.dumps({"devices": [each]}))
print(json.dumps({"finished": True}))
"""
PROGRAM = (sys.executable, "-c", LOADER)


@pytest.fixture
def vendors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "vendors"
    folder.mkdir()
    monkeypatch.setenv(VENDORS, str(folder))
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return folder


def install(folder: Path, *names: str) -> None:
    for name in names:
        (folder / f"{name}.icd").write_text(f"lib{name}.so\n")


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        ("aborts", "its driver ends the program (SIGABRT): no such device"),
        ("hangs", "hangs for 2 s"),
    ],
)
def test_what_ends_the_loader_hides_no_other(bad: str, why: str, vendors: Path) -> None:
    install(vendors, bad, "one", "two")
    devices, failed = listed_devices(PROGRAM, 2.0)
    assert [(each.number, each.platform) for each in devices] == [("0:0", "one"), ("1:0", "two")]
    (refused,) = failed
    assert refused.named == f"the driver of {vendors / bad}.icd"
    assert refused.problem == why
    assert [each.name for each in driver_files()] == ["one.icd", "two.icd"], "from now on"
    assert (driver_files()[0].resolve()) == vendors / "one.icd"
    assert listed_devices(PROGRAM, 2.0) == (devices, []), "and at once"


def test_the_only_driver_is_named(vendors: Path) -> None:
    install(vendors, "aborts")
    devices, (refused,) = listed_devices(PROGRAM)
    assert not devices
    assert refused.named == f"the driver of {vendors}/aborts.icd"
    assert os.environ[VENDORS] == str(vendors)


def test_processes_share_a_folder_and_without_a_cache_each_has_its_own(vendors: Path) -> None:
    install(vendors, "one", "two")
    files, cache = driver_files(), vendors.parent / "cache"
    assert folder_with(files, cache) == folder_with(files, cache)
    assert folder_with(files[:1], cache) != folder_with(files, cache)
    own = [folder_with(files, place) for place in (None, vendors / "one.icd")]
    assert own[0] != own[1]
    for folder in own:
        assert driver_files({VENDORS: str(folder)}) == [folder / each.name for each in files]


def test_a_folder_that_is_not_there_has_no_files(vendors: Path) -> None:
    assert driver_files({VENDORS: str(vendors / "none")}) == []
