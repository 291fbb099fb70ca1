"""What each process imports: no heavy library that it does not need."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = {
    "IPython", "PIL", "av", "jinja2", "llvmlite", "matplotlib", "mavsdk", "mcap", "numba",
    "pandas", "pyarrow", "pymavlink", "pyopencl", "pyproj", "rerun", "rich", "rosbags", "scipy",
    "serial", "zenoh",
}  # fmt: skip
"""Of 4 MB, or 50 ms, and more."""
NEEDED = {
    "companion.app.cli": set(),
    "companion.stages.localisation_work": {"llvmlite", "numba", "scipy"},
    "companion.stages.depth_work": {"pyopencl"},
    "companion.stages.recorder_work": {"mcap", "pymavlink"},
    "companion.stages.topics_work": set(),
    "companion.stages.viewers_work": set(),
    "companion.stages.video_work": set(),
    "companion.stages.results_work": {"PIL", "pyarrow", "rerun"},
    "companion.daemon.daemon": {"pymavlink"},
}


@pytest.mark.parametrize("module", NEEDED)
def test_a_process_imports_no_heavy_library_that_it_does_not_need(module: str) -> None:
    program = f"import sys, {module}; print(*{{name.partition('.')[0] for name in sys.modules}})"
    told = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True
    ).stdout
    assert HEAVY & set(told.split()) == NEEDED[module]
