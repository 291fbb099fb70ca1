"""State of the companion for its HEARTBEAT."""

from __future__ import annotations

from companion.health import Health

BOOT, CALIBRATING, STANDBY, ACTIVE, CRITICAL, POWEROFF = 1, 2, 3, 4, 5, 7
"""MAV_STATE values."""
NO_CAMERA = ("missing", "opening", "silent", "frozen", "ended", "driver fault")


def component_state(health: Health) -> int:
    """MAV_STATE: boot (no camera), standby, calibrating, active, or critical (no pose)."""
    camera = next((source for source in health.sources if source.name == "camera"), None)
    is_blind = camera is not None and camera.state in NO_CAMERA
    if not health.flight:
        return BOOT if is_blind else STANDBY
    died = any(stage.name == "localisation" and not stage.alive for stage in health.stages)
    if is_blind or died or health.tracker == "lost":
        return CRITICAL
    return ACTIVE if health.tracker in ("tracking", "dead reckoning") else CALIBRATING
