"""The sample flight that comes with the program."""

from __future__ import annotations

from pathlib import Path

import companion
from companion.errors import InputError

NAME = "sample/survey"


def sample_flight() -> Path:
    """Folder of the sample flight: in the package, or in the clone that it runs from.

    InputError where it is in neither.
    """
    package = Path(companion.__file__).parent
    places = (package / NAME, package.parent / NAME)
    for place in places:
        if (place / "camera.mp4").is_file():
            return place
    raise InputError(
        f"the sample flight is missing, in {places[0]} and {places[1]}: companion demo FLIGHT "
        "takes any flight"
    )
