"""Load of this computer: processor, memory, temperatures, disk.

Unknown values are None or missing, never a guess. Reading takes some milliseconds, longer where
temperature sensors are slow: not for the event loop.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

import psutil

from companion.health import ComputerLoad, ProcessLoad

MIB = 1 << 20
NOT_A_TEMPERATURE = ("pmic-die",)
"""Constant that Jetsons report."""
PLAUSIBLE_C = (-60.0, 150.0)
GPU_LOADS = (  # per mille, of Jetsons by age
    "devices/platform/gpu.0/load",
    "devices/gpu.0/load",
    "class/devfreq/*.gpu/device/load",
)
GPU_PERCENTS = ("class/drm/card*/device/gpu_busy_percent",)
FANS = ("class/hwmon/hwmon*/fan*_input", "class/hwmon/hwmon*/rpm")


class SystemLoad:
    """Reads the load; processor shares are those since the last reading.

    `folder` is on the disk that is measured.
    """

    def __init__(self, folder: Path, sys: Path = Path("/sys")) -> None:
        self._folder = folder
        self._sys = sys
        self._disk_kind: str | None = None
        self._cores: list[tuple[float, float]] = []
        self._processes: dict[int, tuple[float, float]] = {}
        self.read({})

    def read(self, processes: Mapping[str, int]) -> ComputerLoad:
        """Load now, and that of our processes, by name and process id; 0 is this one."""
        shares = self._core_shares()
        memory = psutil.virtual_memory()
        used, total, free = _disk(self._folder)
        if self._disk_kind is None and total is not None:
            self._disk_kind = _disk_kind(self._folder, self._sys)
        return ComputerLoad(
            uptime_s=time.clock_gettime(time.CLOCK_BOOTTIME),
            cpu_share=sum(shares) / len(shares) if shares else None,
            core_shares=shares,
            gpu_share=self._gpu_share(),
            temperatures_c=dict(self._temperatures()),
            fans_rpm=tuple(round(rpm) for rpm in self._numbers(FANS)),
            memory_used_mib=(memory.total - memory.available) / MIB,
            memory_total_mib=memory.total / MIB,
            disk_kind=self._disk_kind or "",
            disk_used_mib=used,
            disk_total_mib=total,
            disk_free_mib=free,
            processes=tuple(self._loads(processes)),
        )

    def _core_shares(self) -> tuple[float, ...]:
        """Busy share of each core since the last reading; empty at the first."""
        now = []
        for core in psutil.cpu_times(percpu=True):
            idle = core.idle + core.iowait
            busy = core.user + core.nice + core.system + core.irq + core.softirq + core.steal
            now.append((busy, busy + idle))
        before, self._cores = self._cores, now
        if len(before) != len(now):  # the first time, or a core was switched on or off
            return ()
        return tuple(
            min(max((busy - busy0) / (total - total0), 0.0), 1.0) if total > total0 else 0.0
            for (busy, total), (busy0, total0) in zip(now, before, strict=True)
        )

    def _loads(self, processes: Mapping[str, int]) -> Iterator[ProcessLoad]:
        before, self._processes = self._processes, {}
        for name, given in processes.items():
            pid = given or os.getpid()
            try:
                process = psutil.Process(pid)
                times, memory = process.cpu_times(), process.memory_info()
            except psutil.Error:  # gone meanwhile
                continue
            now_s, used_s = time.monotonic(), times.user + times.system
            self._processes[pid] = (now_s, used_s)
            then_s, used_then_s = before.get(pid, (now_s, used_s))
            span_s = now_s - then_s
            cores = max(used_s - used_then_s, 0.0) / span_s if span_s > 0 else 0.0
            yield ProcessLoad(name, pid, cores, memory.rss / MIB)

    def _temperatures(self) -> Iterator[tuple[str, float]]:
        for zone in sorted(self._sys.glob("class/thermal/thermal_zone*")):
            name = _text(zone / "type")
            number = _number(zone / "temp")
            if number is None or name.lower() in NOT_A_TEMPERATURE:
                continue  # sensors of parts that are switched off give an error
            celsius = number * 1e-3
            if PLAUSIBLE_C[0] < celsius < PLAUSIBLE_C[1]:
                yield name or zone.name, celsius

    def _gpu_share(self) -> float | None:
        for patterns, full in ((GPU_LOADS, 1000.0), (GPU_PERCENTS, 100.0)):
            for number in self._numbers(patterns):
                return min(max(number / full, 0.0), 1.0)
        return None

    def _numbers(self, patterns: tuple[str, ...]) -> Iterator[float]:
        for pattern in patterns:
            for path in sorted(self._sys.glob(pattern)):
                number = _number(path)
                if number is not None:
                    yield number


def _disk(folder: Path) -> tuple[float, float, float] | tuple[None, None, None]:
    """MiB used, total, and free for us, of the disk that a folder is or will be on."""
    try:
        usage = psutil.disk_usage(str(_that_exists(folder)))
    except OSError:
        return None, None, None
    return usage.used / MIB, usage.total / MIB, usage.free / MIB


def _that_exists(folder: Path) -> Path:
    folder = folder.absolute()
    return next((each for each in (folder, *folder.parents) if each.exists()), Path("/"))


def _disk_kind(folder: Path, sys: Path) -> str:
    try:
        device = _that_exists(folder).stat().st_dev
        block = (sys / "dev/block" / f"{os.major(device)}:{os.minor(device)}").resolve()
    except OSError:
        return ""
    for each in (block, block.parent):  # a partition lies in its disk
        if (each / "queue").is_dir():
            card = _text(each / "device/type")
            if card in ("MMC", "SD"):
                return "emmc" if card == "MMC" else "sd"
            rotates = _number(each / "queue/rotational")
            return "" if rotates is None else "hdd" if rotates else "ssd"
    return ""


def _text(path: Path) -> str:
    try:
        return path.read_text("ascii", "replace").strip()
    except OSError:
        return ""


def _number(path: Path) -> float | None:
    try:
        return float(_text(path))
    except ValueError:
        return None
