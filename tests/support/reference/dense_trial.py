"""Every kernel of the dense engine once, on a small picture: to be run under Oclgrind.

    oclgrind OPTIONS python -m tests.support.reference.dense_trial WIDTH HEIGHT STRIDE VIEWS

Prints the names of the kernels that ran. What `SHUFFLED` kernels write is read and written again by
the host: Oclgrind 21.10 takes a vector put together from parts of two others for uninitialised, and
would say so of all that is made of it.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from companion.config import DepthConfig
from companion.dense.engine import DepthEngine
from companion.dense.opencl import device_asked_for, devices_of, open_device, platform_names
from companion.dense.self_test import FAR, NEAR, scene

PLATFORM = "Oclgrind"
SHUFFLED = ("aggregate", "winner", "blocks")


def main() -> None:
    width, height, stride, n_views = map(int, sys.argv[1:])
    listed = [each for n in range(len(platform_names())) for each in devices_of(n)]
    device = open_device(device_asked_for(PLATFORM, listed))
    it = scene(width, height)
    config = DepthConfig(stride=stride, regularise_iterations=1)
    engine = DepthEngine(device, width, height, it.intrinsics, config, eager=False)
    sweep, run = engine._sweep, engine._run

    def run_and_settle(name: str, *arguments: Any) -> None:
        run(name, *arguments)
        if name.startswith(SHUFFLED):
            for buffer in (sweep._sum, sweep._winner, sweep.margin, sweep._blocks):
                held = np.empty(buffer.size, np.uint8)
                device.read(held, buffer)
                device.write(buffer, held)

    setattr(engine, "_run", run_and_settle)  # noqa: B010 - mypy lets no method be assigned
    engine.begin(it.images[0], 0.9 * NEAR, 1.1 * FAR)
    for image, pose in list(zip(it.images[1:], it.poses, strict=True))[:n_views]:
        engine.update(image, pose)
    depth_map = engine.finish(0, 0, np.repeat(it.images[0][..., None], 3, 2))
    assert np.isfinite(depth_map.depth).all() and np.isfinite(depth_map.sigma).all()
    print(*depth_map.kernel_ms)


if __name__ == "__main__":
    main()
