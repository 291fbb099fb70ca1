"""One picture in a file, as its sensor has it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.messages import Bytes


def read_picture(path: Path, how: int) -> NDArray[Any] | None:
    """A picture read by a flag of OpenCV's, such as IMREAD_COLOR; None where it cannot be."""
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:  # a file that a list names need not be there
        return None
    # OpenCV turns pictures by EXIF unless told not to; calibrations are of the sensor as it is
    return cv2.imdecode(data, how | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None


def read_grey(path: Path, width: int, height: int) -> Bytes | None:
    """A grey picture (H, W) of that size; None where there is none."""
    grey = read_picture(path, cv2.IMREAD_GRAYSCALE)
    return None if grey is None or grey.shape != (height, width) else np.asarray(grey, np.uint8)
