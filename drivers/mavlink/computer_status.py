"""Load of the computer as ONBOARD_COMPUTER_STATUS."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.health import ComputerLoad

UNKNOWN_U8 = 0xFF
UNKNOWN_I8 = 0x7F
UNKNOWN_I16 = 0x7FFF
UNKNOWN_U32 = 0xFFFFFFFF
PRIMARY = 0
STORAGE = {"hdd": 0, "ssd": 1, "emmc": 2, "sd": 4}
BOARD_SENSORS = ("board", "acpitz")
CORE_SENSORS = ("cpu", "core", "x86_pkg", "soc", "tj")
DISK_FULL_MIB = 100.0


def computer_status(t_ns: int, load: ComputerLoad, *, too_hot: bool = False) -> Any:
    """ONBOARD_COMPUTER_STATUS without links; `too_hot`: the load level is reduced for heat."""
    unknown_slices = [UNKNOWN_U8] * 10  # of the last second: not measured so finely
    no_links = [UNKNOWN_U32] * 6
    full = load.disk_free_mib is not None and load.disk_free_mib < DISK_FULL_MIB
    return mavlink.MAVLink_onboard_computer_status_message(
        time_usec=t_ns // 1000,
        uptime=round(load.uptime_s * 1000) & 0xFFFFFFFF,  # begins again after 49 days
        type=PRIMARY,
        cpu_cores=_filled((_percent(share) for share in load.core_shares), 8, UNKNOWN_U8),
        cpu_combined=unknown_slices,
        gpu_cores=_filled([_percent(load.gpu_share)], 4, UNKNOWN_U8),
        gpu_combined=unknown_slices,
        temperature_board=next(iter(_celsius(load, BOARD_SENSORS)), UNKNOWN_I8),
        temperature_core=_filled(_celsius(load, CORE_SENSORS), 8, UNKNOWN_I8),
        fan_speed=_filled(
            (min(max(rpm, 0), UNKNOWN_I16 - 1) for rpm in load.fans_rpm), 4, UNKNOWN_I16
        ),
        ram_usage=_whole(load.memory_used_mib),
        ram_total=_whole(load.memory_total_mib),
        storage_type=_filled([STORAGE.get(load.disk_kind, UNKNOWN_U32)], 4, UNKNOWN_U32),
        storage_usage=_filled([_whole(load.disk_used_mib)], 4, UNKNOWN_U32),
        storage_total=_filled([_whole(load.disk_total_mib)], 4, UNKNOWN_U32),
        link_type=no_links,
        link_tx_rate=no_links,
        link_rx_rate=no_links,
        link_tx_max=no_links,
        link_rx_max=no_links,
        status_flags=(mavlink.COMPUTER_STATUS_FLAGS_THERMAL_THROTTLE if too_hot else 0)
        | (mavlink.COMPUTER_STATUS_FLAGS_DISK_FULL if full else 0),
    )


def _filled(values: Iterable[int], n: int, unknown: int) -> list[int]:
    known = list(values)[:n]
    return known + [unknown] * (n - len(known))


def _percent(share: float | None) -> int:
    return UNKNOWN_U8 if share is None else min(max(round(100 * share), 0), 100)


def _whole(value: float | None) -> int:
    return UNKNOWN_U32 if value is None else min(max(round(value), 0), UNKNOWN_U32 - 1)


def _celsius(load: ComputerLoad, words: tuple[str, ...]) -> list[int]:
    """Temperatures of the sensors whose name begins with one of these words."""
    return [
        min(max(round(celsius), -128), UNKNOWN_I8 - 1)
        for name, celsius in load.temperatures_c.items()
        if name.lower().startswith(words)
    ]
