"""The doctor that the page starts: what it is asked, and its share of a full processor."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import pytest

from companion.config import Config
from companion.page.doctor_process import Doctor
from companion.page.facts import Facts

DOCTOR = """#!{python}
import json, os, time
until_s = time.monotonic() + 20
while (level := os.getpriority(os.PRIO_PROCESS, 0)) == 15 and time.monotonic() < until_s:
    time.sleep(0.01)
print(json.dumps({{"level": level}}))
"""
PAGE = """
import asyncio, os, sys
from pathlib import Path
from companion.config import Config
from companion.page.doctor_process import Doctor
from companion.page.facts import Facts

os.nice(15)
sys.executable = sys.argv[1]
doctor = Doctor(Facts(Config(), None, (), Path("none"), supervised=False))
print(asyncio.run(doctor.examine()), os.getpriority(os.PRIO_PROCESS, 0))
"""


@pytest.mark.skipif(os.getuid() != 0, reason="only root may take a turn without the service")
def test_it_stands_nearer_to_a_stage(tmp_path: Path) -> None:
    doctor = tmp_path / "doctor"
    doctor.write_text(DOCTOR.format(python=sys.executable), "utf-8")
    doctor.chmod(0o755)
    done = subprocess.run(
        [sys.executable, "-c", PAGE, str(doctor)], capture_output=True, text=True, check=True
    )
    assert done.stdout == "{'level': 5} 15\n"


def test_all_are_more_than_those_found_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = tmp_path / "doctor"
    told.write_text(
        f"#!{sys.executable}\nimport json, sys\nprint(json.dumps({{'asked': sys.argv[3:]}}))\n",
        "utf-8",
    )
    told.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(told))
    doctor = Doctor(Facts(Config(), None, (), Path("none"), supervised=False))

    async def asked() -> list[list[str]]:
        each = [await doctor.examine(), await doctor.set_one("VISO_TYPE"), await doctor.set_all()]
        return [found["asked"] for found in each]

    examined, one, every = asyncio.run(asked())
    assert "--write" not in examined
    assert one[2:6] == ["--write", "--yes", "--only", "VISO_TYPE"]
    assert "--write" in every and "--only" not in every
