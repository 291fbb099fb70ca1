"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path


def write_atomically(path: Path, data: bytes | Iterable[bytes]) -> None:
    """Put `data`, whole or in parts, at `path`, replacing what was there in one step.

    Raises OSError. A write that fails half way leaves the old file as it was, and nothing of its
    own.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            for some in [data] if isinstance(data, bytes) else data:
                file.write(some)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
