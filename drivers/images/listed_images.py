"""Images listed with their times, as in most data sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from companion.errors import FlightError
from companion.messages import Warned
from drivers.images.frame_source import ImageFolder


def listed_images(
    listing: Path, stamped: Sequence[tuple[int, Path]]
) -> tuple[ImageFolder, list[int], list[int], list[Warned]]:
    """Images with their numbers, times and warnings; FlightError where there are none.

    `stamped` is in order of the list. Those stamped no later than the one before are left out;
    those whose file is missing keep their number and come as images that cannot be decoded.
    """
    numbers: list[int] = []
    times_ns: list[int] = []
    for number, (t_ns, _) in enumerate(stamped):
        if not times_ns or t_ns > times_ns[-1]:
            numbers.append(number)
            times_ns.append(t_ns)
    files = [file for _, file in stamped]
    missing = [file for file in files if not file.is_file()]
    if len(missing) == len(files):
        raise FlightError(f"{listing}: none of its {len(files)} images is there: {files[0]}")
    warnings = []
    if missing:
        detail = f"{len(missing)} of {len(files)}, the first is {missing[0].name}"
        warnings.append(Warned(times_ns[0], "images of the list are missing", detail))
    if len(numbers) < len(stamped):
        detail = f"{len(stamped) - len(numbers)} in {listing.name}"
        warnings.append(Warned(times_ns[0], "frames out of order left out", detail))
    return ImageFolder(listing.parent, files), numbers, times_ns, warnings
