"""Cost of telling the whole map once, by the number of keyframes: poses as a table, and as objects.

    python -m tests.bench.map_update

What localisation makes and packs for each keyframe, and what each process that hears it unpacks.
"""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from companion.geometry.transforms import Pose, nearest_rotation
from companion.messages import MapUpdate
from companion.slam.map.sparse_map import SlamMap

POINTS_EACH, N_TRIES = 40, 7


def a_map(n: int) -> SlamMap:
    rng = np.random.default_rng(n)
    out = SlamMap(1.2, 8)
    for k in range(n):
        pose = Pose(nearest_rotation(rng.normal(size=(3, 3))), rng.normal(size=3))
        out.keyframes[k] = SimpleNamespace(camera_from_map=pose)  # type: ignore[assignment]
    out.n_points = n * POINTS_EACH
    out.positions = rng.normal(size=(out.n_points, 3))
    out.alive = np.ones(out.n_points, bool)
    return out


def as_objects(slam_map: SlamMap) -> MapUpdate:
    poses = {key: k.camera_from_map.inverse() for key, k in slam_map.keyframes.items()}
    return MapUpdate(1, 1, poses, slam_map.point_positions(), None)


def as_table(slam_map: SlamMap) -> MapUpdate:
    return MapUpdate(1, 1, slam_map.poses(), slam_map.point_positions(), None)


def costs_ms(make: Callable[[SlamMap], MapUpdate], slam_map: SlamMap) -> tuple[float, float]:
    """Least times to make and pack one, and to unpack it."""
    made, unpacked = [], []
    for _ in range(N_TRIES):
        buffers: list[pickle.PickleBuffer] = []
        began_s = time.perf_counter()
        packed = pickle.dumps(make(slam_map), protocol=5, buffer_callback=buffers.append)
        made.append(time.perf_counter() - began_s)
        aside: list[Any] = [bytes(each) for each in buffers]
        began_s = time.perf_counter()
        pickle.loads(packed, buffers=aside)
        unpacked.append(time.perf_counter() - began_s)
    return 1e3 * min(made), 1e3 * min(unpacked)


def main() -> None:
    print("| keyframes | made and packed, ms | as objects | unpacked, ms | as objects |")
    print("|---|---|---|---|---|")
    for n in (100, 450, 2000, 5000):
        slam_map = a_map(n)
        (table, to_read), (objects, read) = (
            costs_ms(make, slam_map) for make in (as_table, as_objects)
        )
        print(f"| {n} | {table:.2f} | {objects:.1f} | {to_read:.2f} | {read:.1f} |", flush=True)


if __name__ == "__main__":
    main()
