"""Configuration keys that can change while the daemon runs."""

from __future__ import annotations

import dataclasses
from typing import Any

from companion.config import Config
from companion.config_file import dump

FIXED_SECTIONS = frozenset({"camera", "mount", "link", "router", "distributed"})
FIXED_KEYS = frozenset({
    "daemon.socket", "daemon.prometheus_port", "feedback.mode", "feedback.obstacle_distance",
})  # fmt: skip
"""Keys read at the start only. All others take effect at once or with the next flight."""


def reloaded(running: Config, read: Config) -> tuple[Config, list[str]]:
    """Configuration in force after a reload, and the changed keys that need a restart."""
    old, new = dump(running), dump(read)
    cannot = [
        f"{section}.{key}"
        for section, keys in new.items()
        for key, value in keys.items()
        if value != old[section][key]
        and (section in FIXED_SECTIONS or f"{section}.{key}" in FIXED_KEYS)
    ]
    kept: dict[str, Any] = {}
    for name in cannot:
        section, key = name.split(".")
        part = kept.get(section, getattr(read, section))
        kept[section] = dataclasses.replace(part, **{key: getattr(getattr(running, section), key)})
    return dataclasses.replace(read, **kept), cannot
