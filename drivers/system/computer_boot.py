"""Names this computer's present boot, as Linux does: monotonic clocks of two processes compare."""

from __future__ import annotations

from pathlib import Path

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def computer_boot() -> str:
    """A name that no other boot has; "" where the system tells none."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""
