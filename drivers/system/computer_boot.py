"""Boot id of the computer: monotonic clocks of processes with the same id are comparable."""

from __future__ import annotations

from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def computer_boot() -> str:
    """Boot id; "" where unknown."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""
