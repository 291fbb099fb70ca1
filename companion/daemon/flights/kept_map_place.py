"""Path of the map checkpoint for a restart in the air: in memory where possible.

Some megabytes each second would wear out an SD card.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from drivers.system.status_socket import own_socket_path

NAME = "map.checkpoint"
SHARED_MEMORY = Path("/dev/shm")
"""File system in memory that Linux always has (tmpfs), writable for all."""


def kept_map_path(setting: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Path beside the socket; `setting` is `expert.daemon.socket`.

    systemd's RuntimeDirectory and a user's XDG_RUNTIME_DIR are in memory. Where there is neither,
    the socket lies in /tmp, which may be on a disk: then a folder in shared memory is used.
    """
    on_disk = setting == "auto" and not (
        environment.get("RUNTIME_DIRECTORY") or environment.get("XDG_RUNTIME_DIR")
    )
    if on_disk and os.access(SHARED_MEMORY, os.W_OK):
        return SHARED_MEMORY / f"companion-{os.getuid()}" / NAME
    return own_socket_path(setting, environment).with_name(NAME)
