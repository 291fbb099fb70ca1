"""What a report says of the program and the machine that it ran on."""

from __future__ import annotations

import platform
import resource
from importlib import metadata

from companion import __version__

LIBRARIES = ("numpy", "opencv-python-headless", "pyopencl", "pymavlink", "filterpy", "rerun-sdk")


def versions() -> dict[str, str]:
    """Of the program, Python and the libraries whose versions can change results."""
    found = {name: metadata.version(name) for name in LIBRARIES}
    return {"companion": __version__, "python": platform.python_version(), **found}


def peak_memory_mb() -> float:
    """Of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
