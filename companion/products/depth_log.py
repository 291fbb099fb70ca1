"""Timing log of `companion depth`, as depth.json."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.messages import DepthMap, PixelState
from companion.products.atomic_file import write_atomically

COPIES = {"upload": "upload_ms", "read-back": "read_back_ms", "copy": "copy_ms"}
"""Transfers, by the engine's names for them."""


@dataclass(frozen=True, slots=True)
class Spent:
    """Milliseconds on the device by OpenCL events, and the rest of the wall time on the host.

    `copy_ms` is from buffer to buffer. Where device and host overlap, `host_ms` is the host's time
    beyond the device's.
    """

    upload_ms: float = 0.0
    kernel_ms: Mapping[str, float] = field(default_factory=dict)
    copy_ms: float = 0.0
    read_back_ms: float = 0.0
    host_ms: float = 0.0

    @staticmethod
    def of(wall_ms: float, device_ms: Mapping[str, float]) -> Spent:
        """From wall time and the device times of the engine."""
        kernels = {name: ms for name, ms in device_ms.items() if name not in COPIES}
        copies = {key: device_ms.get(name, 0.0) for name, key in COPIES.items()}
        host_ms = max(wall_ms - sum(device_ms.values()), 0.0)
        return Spent(kernel_ms=kernels, host_ms=host_ms, **copies)

    def rounded(self) -> dict[str, Any]:
        """For JSON, to the nanosecond, as devices count: a small image takes some hundred."""
        return {
            "upload_ms": round(self.upload_ms, 6),
            "kernel_ms": {name: round(ms, 6) for name, ms in self.kernel_ms.items()},
            "copy_ms": round(self.copy_ms, 6), "read_back_ms": round(self.read_back_ms, 6),
            "host_ms": round(self.host_ms, 6),
        }  # fmt: skip


@dataclass(frozen=True, slots=True)
class UpdateLog:
    """One image: pixels still updated after it, converged and diverged ones."""

    frame: int
    pixels_worked_on: int
    converged: int
    diverged: int
    spent: Spent


@dataclass(frozen=True, slots=True)
class ReferenceLog:
    """One reference: `searched` of the images of `updates` were searched; `spent` is the total."""

    reference: int
    range_m: tuple[float, float]
    searched: int
    updates: Sequence[UpdateLog]
    spent: Spent


def write_log(
    out: Path, *, device: str, layout: str, maps: Sequence[DepthMap],
    log: Sequence[ReferenceLog], stages: Mapping[str, Any],
) -> None:  # fmt: skip
    """Write depth.json; `maps` are the depth maps of the log."""
    references = [_reference(r, depth_map) for r, depth_map in zip(log, maps, strict=True)]
    content = {
        "device": device, "layout": layout, "in_all": in_all([r.spent for r in log]).rounded(),
        "stages": stages, "references": references,
    }  # fmt: skip
    write_atomically(out / "depth.json", json.dumps(content, indent=1, allow_nan=False).encode())


def in_all(parts: Sequence[Spent]) -> Spent:
    """Sum of times."""
    kernels: dict[str, float] = {}
    for part in parts:
        for name, ms in part.kernel_ms.items():
            kernels[name] = kernels.get(name, 0.0) + ms
    return Spent(
        sum(p.upload_ms for p in parts), kernels, sum(p.copy_ms for p in parts),
        sum(p.read_back_ms for p in parts), sum(p.host_ms for p in parts),
    )  # fmt: skip


def _reference(log: ReferenceLog, depth_map: DepthMap) -> dict[str, Any]:
    return {
        "reference": log.reference,
        "range_m": [round(d, 4) for d in log.range_m],
        "searched": log.searched,
        **log.spent.rounded(),
        "pixels": {
            state.name.lower(): int((depth_map.state == state.value).sum()) for state in PixelState
        },
        "pixels_with_depth": int((depth_map.depth > 0).sum()),
        "frames": [
            {
                "frame": u.frame, **u.spent.rounded(), "pixels_worked_on": u.pixels_worked_on,
                "converged": u.converged, "diverged": u.diverged,
            }
            for u in log.updates
        ],
    }  # fmt: skip
