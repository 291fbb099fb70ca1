"""The doctor that the page starts gets more of a full processor than the page."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

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
