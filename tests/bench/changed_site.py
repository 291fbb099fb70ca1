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


def site(work: Path, seed: int, after: bool, known: SiteMap | None = None) -> SiteMap:
    """The map of the flight before or after, the latter flown in a `known` one too."""
    name = f"{seed}_{'after' if after else 'before'}{'_in_map' if known else ''}"
    kept = work / f"{name}.map"
    if kept.exists():
        return read_site_map(kept).site
    ground = Terrain(seed, plane=True, pattern=leaves)
    for kind, size, height, there, then, look in THINGS:
        if kind != ("gone" if after else "new"):
            ground.add_roof(height, then if after else there, size, look)
    lines = [(-14.0, 14.0, -7.0), (14.0, -14.0, 0.0), (-14.0, 14.0, 7.0)]
    if after:
        lines = [(14.0, -14.0, 5.0), (-14.0, 14.0, -1.0), (14.0, -14.0, -6.0)]
    ned_from_body = path(lines, 0.5 if after else 0.0)
    flown = fly(CAMERA, ned_from_body, ground, 24.0, RATE_HZ, site=known)
    made = flown.stage.site_map("after" if after else "before", None)
    assert made is not None
    n_points = len(made.points.positions)
    print(
        f"{name}: {len(made.keyframes)} keyframes, {n_points} points, "
        f"{flown.placed_share:.0%} placed; {', '.join(flown.warnings)}",
        flush=True,
    )
    work.mkdir(parents=True, exist_ok=True)
    write_site_map(kept, made)
    return made


def of_before(site: SiteMap) -> tuple[int, int]:
    """Points of the first flight alone: on top of what went or moved; all others."""
    of_first = np.zeros(len(site.points.positions), bool)
    for keyframe in (k for k, part in zip(site.keyframes, site.part_of, strict=True) if not part):
        of_first[keyframe.point_ids[keyframe.point_ids >= 0]] = True
    on_things = np.zeros(len(of_first), bool)
    at = site.points.positions
    for kind, size, height, there, _, _ in THINGS:
        if kind != "new":
            inside = np.abs(at[:, :2] - np.array(there) - size / 2).max(1) < size / 2
            on_things |= inside & (np.abs(at[:, 2] + height) < 0.25)
    return int((of_first & on_things).sum()), int((of_first & ~on_things).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--work", type=Path, required=True)
    options = parser.parse_args()
    before, after = (site(options.work, options.seed, later) for later in (False, True))
    found = compare_sites(before, after, Similarity.identity())
    assert found is not None
    assert found.apart_m is not None
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
    (on_before, rest_before), (on_after, rest_after) = (
        of_before(each) for each in (before, site(options.work, options.seed, True, before))
    )
    print(
        f"flown in and saved again: {on_after} of {on_before} points on what went are left, "
        f"{rest_after} of {rest_before} others"
    )
    for each in unclaimed:
        print(
            f"FALSE {each.kind} at {each.centre_m.round(1)}, {len(each.points_m)} points, "
            f"{each.n_views} views, size {each.size_m.round(1)}"
        )


if __name__ == "__main__":
    main()
