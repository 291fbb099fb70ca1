"""Changes between two flights over a rendered site: what is found of them, and false alarms.

    python -m tests.bench.changed_site --work DIR [--seed N]

Roofs that stand free over textured ground: some are taken away between the flights, some put there,
some moved. Both flights are flown by `LocalisationStage` on paths of their own; their maps are kept
in DIR, and not made again.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, Similarity, yaw_rotation
from companion.products.site_map_file import read_site_map, write_site_map
from companion.slam.map.site_map import SiteMap
from companion.slam.mapping.site_change import compare_sites
from tests.support.flights.rendered_flight import CAMERA_DOWN, Terrain, fly
from tests.support.flights.scene import leaves

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, body_from_camera=CAMERA_DOWN)
HEIGHT_M, SPEED_M_S, RATE_HZ = 14.0, 4.0, 8.0
Thing = tuple[str, float, float, tuple[float, float], tuple[float, float], int]
"""Kind, size and height in metres, place before and after, look."""
THINGS: list[Thing] = [
    ("gone", 3.0, 1.5, (-9.0, -8.0), (0, 0), 101),
    ("gone", 1.5, 1.0, (4.0, 6.0), (0, 0), 102),
    ("gone", 2.0, 0.4, (9.0, -5.0), (0, 0), 103),
    ("new", 3.0, 1.5, (0, 0), (7.0, 1.0), 104),
    ("new", 1.5, 1.0, (0, 0), (-4.0, 8.0), 105),
    ("new", 2.0, 0.4, (0, 0), (-10.0, 2.0), 106),
    ("moved", 2.5, 1.5, (0.0, -9.0), (3.0, -4.0), 107),
    ("moved", 2.5, 1.5, (0.0, 1.5), (-3.0, -3.0), 108),
]


def path(lines: list[tuple[float, float, float]], yaw_rad: float) -> Callable[[float], Pose]:
    """`ned_from_body` along lines: from north to north, at an east; smooth at the turns."""
    corners = np.array([p for a, b, east in lines for p in ((a, east), (b, east))])
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]

    def at(after_s: float) -> Pose:
        steps = after_s * SPEED_M_S + np.linspace(-1.5, 1.5, 7)
        north, east = (np.interp(steps, along, corners[:, n]).mean() for n in (0, 1))
        height = HEIGHT_M + 0.5 * np.sin(after_s)
        return Pose(yaw_rotation(yaw_rad), np.array([north, east, -height]))

    return at


def site(work: Path, seed: int, after: bool) -> SiteMap:
    """The map of the flight before or after."""
    kept = work / f"{seed}_{'after' if after else 'before'}.map"
    if kept.exists():
        return read_site_map(kept).site
    ground = Terrain(seed, plane=True, pattern=leaves)
    for kind, size, height, there, then, look in THINGS:
        if kind != ("gone" if after else "new"):
            ground.add_roof(height, then if after else there, size, look)
    lines = [(-14.0, 14.0, -7.0), (14.0, -14.0, 0.0), (-14.0, 14.0, 7.0)]
    if after:
        lines = [(14.0, -14.0, 5.0), (-14.0, 14.0, -1.0), (14.0, -14.0, -6.0)]
    flown = fly(CAMERA, path(lines, 0.5 if after else 0.0), ground, 24.0, RATE_HZ)
    made = flown.stage.site_map("after" if after else "before", None)
    assert made is not None
    print(
        f"{'after' if after else 'before'}: {len(made.keyframes)} keyframes, "
        f"{len(made.points.positions)} points, {flown.placed_share:.0%} placed",
        flush=True,
    )
    work.mkdir(parents=True, exist_ok=True)
    write_site_map(kept, made)
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--work", type=Path, required=True)
    options = parser.parse_args()
    before, after = (site(options.work, options.seed, later) for later in (False, True))
    found = compare_sites(before, after, Similarity.identity())
    assert found is not None
    print(f"{found.n_shared} points of both, {100 * found.apart_m:.1f} cm apart")
    unclaimed = list(found.changes)
    for kind, size, height, there, then, _ in THINGS:
        centre = np.array(then if kind == "new" else there) + size / 2
        near = [
            c
            for c in unclaimed
            if c.kind == kind and np.linalg.norm(c.centre_m[:2] - centre) < max(1.0, size / 2)
        ]
        for each in near:
            unclaimed.remove(each)
        told = "missed"
        if near:
            told = f"found by {sum(len(c.points_m) for c in near)} points"
            if near[0].moved_m is not None:
                off = near[0].moved_m[:2] - (np.array(then) - np.array(there))
                told += f", its shift off by {np.linalg.norm(off):.2f} m"
        print(f"{kind} {size} m wide, {height} m high: {told}")
    for each in unclaimed:
        print(
            f"FALSE {each.kind} at {each.centre_m.round(1)}, {len(each.points_m)} points, "
            f"{each.n_views} views, size {each.size_m.round(1)}"
        )


if __name__ == "__main__":
    main()
