"""Program versions for the report."""

from __future__ import annotations

import platform
from importlib import metadata

from companion import __version__

LIBRARIES = ("numpy", "opencv-python-headless", "pyopencl", "pymavlink", "rerun-sdk")


def versions() -> dict[str, str]:
    """Versions of the program, Python and the libraries that can change results."""
    found = {name: metadata.version(name) for name in LIBRARIES}
    return {"companion": __version__, "python": platform.python_version(), **found}
