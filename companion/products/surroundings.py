"""Program versions and memory use for the report."""

from __future__ import annotations

import platform
import resource
from importlib import metadata

from companion import __version__

LIBRARIES = ("numpy", "opencv-python-headless", "pyopencl", "pymavlink", "rerun-sdk")


def versions() -> dict[str, str]:
    """Versions of the program, Python and the libraries that can change results."""
    found = {name: metadata.version(name) for name in LIBRARIES}
    return {"companion": __version__, "python": platform.python_version(), **found}


def peak_memory_mb() -> float:
    """Peak memory of this process and the largest of its children that have ended, MB."""
    whose = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return sum(resource.getrusage(each).ru_maxrss for each in whose) / 1024.0
