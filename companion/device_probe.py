"""Each OpenCL device is measured in a process of its own: a driver that ends its process is named.

As a program: NUMBER; the last line that it says is the MeasuredDevice as JSON.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
from collections.abc import Sequence

from companion.clock import monotonic_s
from companion.depth.device_choice import MeasuredDevice, measured_device
from companion.depth.opencl import device_names

PROGRAM = (sys.executable, "-m", "companion.device_probe")
PATIENCE_S = 120.0
"""The first build of the kernels on a small processor takes most of a minute."""


def probed_devices() -> list[MeasuredDevice]:
    """All devices there are, tested and measured one after the other."""
    return [probed(*each) for each in device_names()]


def probed(
    number: str, name: str, platform: str, program: Sequence[str] = PROGRAM,
    patience_s: float = PATIENCE_S,
) -> MeasuredDevice:  # fmt: skip
    """One device as `program` finds it, or what became of that."""
    try:
        ended = subprocess.run(
            [*program, number], stdin=subprocess.DEVNULL, capture_output=True, timeout=patience_s
        )
    except subprocess.TimeoutExpired:
        return MeasuredDevice(number, name, platform, None, f"hangs for {patience_s:.0f} s")
    try:
        return MeasuredDevice(**json.loads(ended.stdout.splitlines()[-1]))
    except (IndexError, ValueError, TypeError):
        problem = f"its driver ends the program ({_how(ended.returncode)})"
        said = ended.stderr.decode(errors="replace").strip().splitlines()
        return MeasuredDevice(number, name, platform, None, ": ".join([problem, *said[-1:]]))


def _how(status: int) -> str:
    if status >= 0:
        return f"status {status}"
    try:
        return signal.Signals(-status).name
    except ValueError:
        return f"signal {-status}"


def main() -> int:
    """Measure one device; the exit status."""
    (each,) = [each for each in device_names() if each[0] == sys.argv[1]]
    print(json.dumps(dataclasses.asdict(measured_device(*each, monotonic_s))), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
