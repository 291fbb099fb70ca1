"""System load as read, from this computer and from a Jetson's files, and as sent."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.health import ComputerLoad
from drivers.mavlink.computer_status import computer_status
from drivers.system.system_load import SystemLoad


def sent(message: Any) -> Any:
    """As the other end decodes it: what does not fit a field fails here."""
    link = mavlink.MAVLink(None, 1, 197)
    return link.parse_buffer(message.pack(link))[0]


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


JETSON = {
    "class/thermal/thermal_zone0/type": "cpu-thermal\n",
    "class/thermal/thermal_zone0/temp": "61500\n",
    "class/thermal/thermal_zone1/type": "gpu-thermal\n",
    "class/thermal/thermal_zone1/temp": "58250\n",
    "class/thermal/thermal_zone2/type": "PMIC-Die\n",
    "class/thermal/thermal_zone2/temp": "100000\n",
    "class/thermal/thermal_zone3/type": "cv0-thermal\n",
    "class/thermal/thermal_zone3/temp": "",  # switched off
    "class/thermal/thermal_zone4/type": "broken\n",
    "class/thermal/thermal_zone4/temp": "-273150\n",
    "devices/platform/gpu.0/load": "437\n",
    "class/hwmon/hwmon2/fan1_input": "2310\n",
}


def test_load_of_a_jetson(tmp_path: Path) -> None:
    write(tmp_path, JETSON)
    load = SystemLoad(tmp_path, sys=tmp_path).read({})
    assert load.temperatures_c == {"cpu-thermal": 61.5, "gpu-thermal": 58.25}
    assert load.temperature_c == 61.5
    assert load.gpu_share == pytest.approx(0.437)
    assert load.fans_rpm == (2310,)


@pytest.mark.parametrize(
    ("files", "kind"),
    [
        ({"queue/rotational": "0"}, "ssd"),
        ({"queue/rotational": "1"}, "hdd"),
        ({"queue/rotational": "0", "device/type": "SD"}, "sd"),
        ({"queue/rotational": "0", "device/type": "MMC"}, "emmc"),
        ({"other": ""}, ""),
    ],
)
@pytest.mark.parametrize("partition", [False, True])
def test_kind_of_the_disk(
    tmp_path: Path, files: dict[str, str], kind: str, partition: bool
) -> None:
    disk = tmp_path / "devices/disk0"
    write(disk, files)
    (disk / "disk0p1").mkdir()
    device = tmp_path.stat().st_dev
    link = tmp_path / "dev/block" / f"{os.major(device)}:{os.minor(device)}"
    link.parent.mkdir(parents=True)
    link.symlink_to(disk / "disk0p1" if partition else disk)
    assert SystemLoad(tmp_path, sys=tmp_path).read({}).disk_kind == kind


def test_a_computer_that_tells_nothing_is_not_guessed_at(tmp_path: Path) -> None:
    load = SystemLoad(tmp_path / "not" / "yet", sys=tmp_path / "nothing").read({})
    assert (load.temperatures_c, load.temperature_c, load.gpu_share) == ({}, None, None)
    assert (load.fans_rpm, load.disk_kind) == ((), "")
    assert load.disk_total_mib is not None  # of what the folder will be made on


@pytest.mark.real_time
def test_load_of_this_computer(tmp_path: Path) -> None:
    system = SystemLoad(tmp_path)
    ours = {"here": 0, "gone": 2**22 + 1}
    system.read(ours)
    began_s, stop = time.monotonic(), time.process_time() + 0.3
    while time.process_time() < stop:
        pass
    used_cores = 0.3 / (time.monotonic() - began_s)
    load = system.read(ours)
    assert [process.name for process in load.processes] == ["here"]
    assert load.processes[0].pid == os.getpid()
    assert load.processes[0].cpu_cores == pytest.approx(used_cores, rel=0.35)
    assert load.processes[0].memory_mib > 5
    assert load.cpu_share is not None
    assert 0 < load.cpu_share <= 1
    assert len(load.core_shares) == os.cpu_count()
    assert max(load.core_shares) > 0.2
    assert load.memory_share is not None
    assert 0 < load.memory_share < 1
    assert load.uptime_s > 0


def test_reading_is_quick_enough_for_once_a_second(tmp_path: Path) -> None:
    system = SystemLoad(tmp_path)
    begun = time.process_time()
    for _ in range(20):
        system.read({"here": os.getpid()})
    assert (time.process_time() - begun) / 20 < 0.02


FULL = ComputerLoad(
    uptime_s=3661.5,
    cpu_share=0.5,
    core_shares=(0.254, 1.0),
    gpu_share=0.437,
    temperatures_c={"CPU-therm": 61.5, "gpu-thermal": 58.0, "acpitz": 45.4, "tj-thermal": -200.0},
    fans_rpm=(2310, 99999),
    memory_used_mib=2048.4,
    memory_total_mib=8192,
    disk_kind="emmc",
    disk_used_mib=10_000,
    disk_total_mib=30_000,
    disk_free_mib=19_000,
)


def test_every_field_is_in_its_unit() -> None:
    message = sent(computer_status(1_790_000_000_123_456_789, FULL))
    assert message.get_type() == "ONBOARD_COMPUTER_STATUS"
    assert message.time_usec == 1_790_000_000_123_456
    assert message.uptime == 3_661_500
    assert message.type == 0
    assert message.cpu_cores == [25, 100, 255, 255, 255, 255, 255, 255]
    assert message.cpu_combined == [255] * 10
    assert message.gpu_cores == [44, 255, 255, 255]
    assert message.gpu_combined == [255] * 10
    assert message.temperature_board == 45
    assert message.temperature_core == [62, -128, 127, 127, 127, 127, 127, 127]
    assert message.fan_speed == [2310, 32766, 32767, 32767]
    assert (message.ram_usage, message.ram_total) == (2048, 8192)
    unknown = 2**32 - 1
    assert message.storage_type == [2, unknown, unknown, unknown]
    assert message.storage_usage == [10_000, unknown, unknown, unknown]
    assert message.storage_total == [30_000, unknown, unknown, unknown]
    assert message.status_flags == 0


def test_what_is_not_known_is_marked_so() -> None:
    message = sent(computer_status(1000, ComputerLoad()))
    assert message.cpu_cores == [255] * 8
    assert message.gpu_cores == [255] * 4
    assert message.temperature_board == 127
    assert message.temperature_core == [127] * 8
    assert message.fan_speed == [32767] * 4
    unknown = 2**32 - 1
    assert (message.ram_usage, message.ram_total) == (unknown, unknown)
    for name in ("storage_type", "storage_usage", "storage_total"):
        assert getattr(message, name) == [unknown] * 4
    for name in ("link_type", "link_tx_rate", "link_rx_rate", "link_tx_max", "link_rx_max"):
        assert getattr(message, name) == [unknown] * 6


def test_more_than_fits_is_cut() -> None:
    many = ComputerLoad(
        uptime_s=60 * 86400, core_shares=(0.5,) * 64, fans_rpm=(1,) * 9,
        temperatures_c={f"cpu{i}": 50.0 for i in range(20)},
    )  # fmt: skip
    message = sent(computer_status(0, many))
    assert message.cpu_cores == [50] * 8
    assert message.temperature_core == [50] * 8
    assert message.fan_speed == [1] * 4
    assert message.uptime == 60 * 86_400_000 - 2**32


def test_flags_tell_of_heat_and_of_a_full_disk() -> None:
    assert sent(computer_status(0, ComputerLoad(disk_free_mib=99))).status_flags == 8
    assert sent(computer_status(0, ComputerLoad(disk_free_mib=101))).status_flags == 0
    assert sent(computer_status(0, ComputerLoad(), too_hot=True)).status_flags == 4
