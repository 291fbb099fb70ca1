"""Films: H.264 in MP4, and animated WebP."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from companion.errors import InputError

CRF = "23"
"""Quality of x264, its own default."""
WEBP_QUALITY = 55
KINDS = (".mp4", ".webp")


def write_film(path: Path, frames: Iterable[NDArray[np.uint8]], rate_hz: int) -> int:
    """Write RGB frames (H, W, 3) by the kind that the name of the file ends in; their number.

    The file is there when it is whole. InputError for another kind, or where it cannot be written.
    """
    check_film_name(path)
    part = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        n = (_write_mp4 if path.suffix == ".mp4" else _write_webp)(part, frames, rate_hz)
        part.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)
    return n


def check_film_name(path: Path) -> None:
    """InputError where a name is of no known kind."""
    if path.suffix not in KINDS:
        raise InputError(f"{path}: a film is FILE.mp4 or FILE.webp")


def _write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], rate_hz: int) -> int:
    n = 0
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream: Any = container.add_stream("libx264", rate=Fraction(rate_hz))
        stream.pix_fmt, stream.options = "yuv420p", {"crf": CRF, "preset": "medium"}
        for n, rgb in enumerate(frames, 1):
            if n == 1:
                # players want even sides
                stream.height, stream.width = (side - side % 2 for side in rgb.shape[:2])
            picture = np.ascontiguousarray(rgb[: stream.height, : stream.width])
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return n


def _write_webp(path: Path, frames: Iterable[NDArray[np.uint8]], rate_hz: int) -> int:
    pictures = [Image.fromarray(np.asarray(rgb)) for rgb in frames]
    pictures[0].save(
        path, save_all=True, append_images=pictures[1:], duration=round(1000 / rate_hz), loop=0,
        quality=WEBP_QUALITY, method=4,
    )  # fmt: skip
    return len(pictures)
