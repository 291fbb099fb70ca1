"""Configuration keys that can change while the daemon runs."""

from __future__ import annotations

from companion.config import Config
from companion.config.setting_keys import dump, with_values

FIXED_SECTIONS = frozenset({
    "camera", "mount", "link", "router", "page", "video", "distributed", "landing", "gps",
})  # fmt: skip
FIXED_KEYS = frozenset({
    "expert.daemon.socket", "expert.daemon.prometheus_port", "feedback.mode",
    "feedback.global_position",
    "feedback.obstacle_distance", "feedback.obstacles_3d", "telemetry.use",
})  # fmt: skip
"""Keys read at the start only. All others take effect at once or with the next flight."""


def needs_restart(name: str) -> bool:
    """True of a key that a running daemon does not take over."""
    return name.split(".")[-2] in FIXED_SECTIONS or name in FIXED_KEYS


def reloaded(running: Config, read: Config) -> tuple[Config, list[str]]:
    """Configuration in force after a reload, and the changed keys that need a restart."""
    old = dump(running)
    cannot = [
        name for name, value in dump(read).items() if value != old[name] and needs_restart(name)
    ]
    return with_values(read, {name: old[name] for name in cannot}), cannot
