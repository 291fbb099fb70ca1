"""Flights located in the map of an earlier flight, maps merged, and other sites never found.

    python -m tests.bench.kept_map FLIGHTS --work DIR [--only maps,located,denied,merged,others]

FLIGHTS is the folder of the rendered flights; maps and paths are kept in DIR, and not made again.

- maps: the map of every flight: its size, and how long it takes to read.
- located: campus_return in the map of campus_orbit. When it was located, and the error of its
  frames after the similarity that fits campus_orbit's own path to its truth.
- denied: the same of campus_return with attitude and accelerations alone.
- merged: the maps of the three flights as one; errors of keyframes against truth after a
  similarity for each flight, alone and in the one map, and after one for all.
- others: every keyframe of every flight is looked for in the map of every other site, with no
  word from the autopilot. Flights over the campus are of one site.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np

from companion.app.maps.map_command import merge
from companion.app.replay.replay_command import RecordedInput
from companion.config_file import load_config
from companion.estimation.localisation import LocalisationStage
from companion.estimation.site.site_use import LOCATED, SiteUse
from companion.geometry.transforms import Array, Similarity
from companion.messages import Warned
from companion.products.atomic_file import write_atomically
from companion.products.flight_result import FlightResult
from companion.products.site_map_file import read_site_map, write_site_map
from companion.products.trajectory_file import trajectory_tum
from companion.slam.loop.loop_closure import LoopDetector
from companion.slam.loop.place_recognition import KeyframeDatabase
from companion.slam.loop.relocalizer import Relocalizer
from companion.slam.map.site_map import SiteMap, slam_map_of
from companion.timing.clock import StageTimes

CAMPUS = ("campus_orbit", "campus_sweep", "campus_return", "campus_rolling")
FLIGHTS = (*CAMPUS, "field_survey", "arducopter_survey")
MERGED = CAMPUS[:3]
WITHOUT_POSITIONS = 'telemetry.use=["attitude","imu"]'
FIRST_ID = 100_000
"""Of the keyframes that are looked for."""


def fly(flight: Path, out: Path, site: Path | None = None, sets: tuple[str, ...] = ()) -> str:
    """Replay a flight without its dense map; site.map, trajectory.tum and what was said of it."""
    if (out / "said.txt").exists():
        return (out / "said.txt").read_text()
    out.mkdir(parents=True, exist_ok=True)
    config = load_config(None, list(sets))
    given = RecordedInput(flight, config)
    camera, origin = given.flight.camera, given.log.origin
    use = None if site is None else SiteUse(read_site_map(site).site, camera, origin)
    stage, result = LocalisationStage(config, camera, StageTimes(), site=use), FlightResult()
    said: list[str] = []
    for message in given.messages():
        result.take(message)
        for made in stage.step(message):
            result.take(made)
            if isinstance(made, Warned) and made.what == LOCATED:
                since_s = (made.t_ns - given.flight.start_ns) * 1e-9
                said.append(f"located {since_s:.2f} s after the first frame")
    for made in stage.finish():
        result.take(made)
    result.close()
    found = stage.site_map(flight.name, origin)
    if found is not None:
        write_site_map(out / "site.map", found)
    write_atomically(out / "trajectory.tum", trajectory_tum(result.poses(), result.unit, origin))
    write_atomically(out / "said.txt", "; ".join(said).encode())
    return "; ".join(said)


def path_and_truth(run: Path, flight: Path) -> tuple[Array, Array, int]:
    """Places of frames (N, 3), the true ones, and the number of all frames."""
    found = np.loadtxt(run / "trajectory.tum", ndmin=2)
    places, n_frames = true_places(flight, found[:, 0])
    return found[:, 1:4], places, n_frames


def true_places(flight: Path, t_s: Array) -> tuple[Array, int]:
    """True places (N, 3) of the camera at frames, and the number of all frames."""
    truth = np.loadtxt(flight / "truth" / "world_from_camera.tum", ndmin=2)
    nearest = np.abs(truth[:, 0][None] - t_s[:, None]).argmin(1)
    return truth[nearest, 1:4], len(truth)


def similarity(found: Array, true: Array) -> Similarity:
    """The similarity that fits places to true ones (Umeyama 1991)."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = float((d * np.diag(sign)).sum() / (a * a).sum())
    return Similarity(scale, rotation, true.mean(0) - scale * rotation @ found.mean(0))


def rms(found: Array, true: Array, fit: Similarity) -> float:
    """RMS distance after a similarity."""
    return float(np.sqrt(((fit.apply(found) - true) ** 2).sum(1).mean()))


def maps(flights: Path, work: Path) -> None:
    for name in FLIGHTS:
        fly(flights / name, work / name)
        path = work / name / "site.map"
        began_s = time.perf_counter()
        site = read_site_map(path).site
        read_s = time.perf_counter() - began_s
        truth = np.loadtxt(flights / name / "truth" / "world_from_camera.tum", ndmin=2)
        way_m = np.linalg.norm(np.diff(truth[:, 1:4], axis=0), axis=1).sum()
        size_mb = path.stat().st_size * 1e-6
        print(
            f"{name}: {way_m:.0f} m, {len(site.keyframes)} keyframes, {size_mb:.1f} MB "
            f"({size_mb * 300 / way_m:.1f} in 300 m), read in {read_s:.2f} s",
            flush=True,
        )


def located(flights: Path, work: Path, sets: tuple[str, ...] = ()) -> None:
    old, new = flights / CAMPUS[0], flights / CAMPUS[2]
    fly(old, work / old.name)
    run = work / (f"{new.name}_located" + "_denied" * bool(sets))
    said = fly(new, run, work / old.name / "site.map", sets)
    found, true, _ = path_and_truth(work / old.name, old)
    fit = similarity(found, true)
    own_m = rms(found, true, fit)
    found, true, n_frames = path_and_truth(run, new)
    error_m = np.sort(np.linalg.norm(fit.apply(found) - true, axis=1))
    n_best = int(np.ceil(0.9 * n_frames))
    best = f"{np.sqrt((error_m[:n_best] ** 2).mean()):.3f} m" if len(error_m) >= n_best else "none"
    print(
        f"{run.name}: {said or 'never located'}; {len(found)} of {n_frames} frames placed, RMSE "
        f"{np.sqrt((error_m**2).mean()):.3f} m, of the best 90 % of all frames {best} (the old "
        f"map's own path {own_m:.3f} m; after a similarity of its own "
        f"{rms(found, true, similarity(found, true)):.3f} m)",
        flush=True,
    )


def merged(flights: Path, work: Path) -> None:
    for name in MERGED:
        fly(flights / name, work / name)
    paths = [work / name / "site.map" for name in MERGED]
    out = work / "merged.map"
    began_s = time.perf_counter()
    print(merge(paths, out))
    print(f"merged in {time.perf_counter() - began_s:.0f} s, {out.stat().st_size * 1e-6:.1f} MB")
    both = read_site_map(out).site
    found, true = keyframes_of(both, flights)
    fit = similarity(found, true)
    print(f"all three as one: {rms(found, true, fit):.3f} m, scale {1 / fit.scale:.5f}")
    world_m = np.linalg.norm(found.mean(0) - true.mean(0))
    off_m = rms(found, true, Similarity.identity())
    print(f"  in its own world {off_m:.3f} m, as a whole {world_m:.2f} m")
    alone = []
    flights_of = [part.flight for part in both.parts]
    for name, path in zip(MERGED, paths, strict=True):
        site = read_site_map(path).site
        before, true_before = keyframes_of(site, flights)
        own = both.part_of == flights_of.index(name)
        alone.append((before, true_before))
        by_own = similarity(found[own], true[own])
        print(
            f"  {name}: alone {rms(before, true_before, similarity(before, true_before)):.4f} m, "
            f"in the one map {rms(found[own], true[own], by_own):.4f} m (by the one similarity "
            f"{rms(found[own], true[own], fit):.3f} m); in its own world alone "
            f"{rms(before, true_before, Similarity.identity()):.3f} m, in the one map "
            f"{rms(found[own], true[own], Similarity.identity()):.3f} m"
        )  # fmt: skip
    a, b = np.concatenate([a for a, _ in alone]), np.concatenate([b for _, b in alone])
    print(f"  the three side by side, unmerged: {rms(a, b, similarity(a, b)):.3f} m", flush=True)


def keyframes_of(site: SiteMap, flights: Path) -> tuple[Array, Array]:
    """Places of keyframes (N, 3), and the true ones."""
    places = np.stack([k.camera_from_map.inverse().translation for k in site.keyframes])
    true = np.zeros_like(places)
    t_s = np.array([k.t_ns for k in site.keyframes]) * 1e-9
    for n, part in enumerate(site.parts):
        own = site.part_of == n
        true[own] = true_places(flights / part.flight, t_s[own])[0]
    return places, true


def others(flights: Path, work: Path) -> None:
    for name in FLIGHTS:
        fly(flights / name, work / name)
    for old, new in permutations(FLIGHTS, 2):
        same = old in CAMPUS and new in CAMPUS
        n_found, n_once, n_keyframes, most = looked_for(
            read_site_map(work / new / "site.map").site,
            read_site_map(work / old / "site.map").site,
        )
        print(
            f"{new} in the map of {old}{' (the same site)' * same}: {n_found} of {n_keyframes} "
            f"keyframes found, {n_once} more in one view alone; at most {most} points",
            flush=True,
        )


def looked_for(new: SiteMap, old: SiteMap) -> tuple[int, int, int, int]:
    """Keyframes of one map found in another, those found but not confirmed, all, most points."""
    camera = new.parts[0].camera
    there = slam_map_of(old, camera)
    keyframes = tuple(replace(k, keyframe_id=k.keyframe_id + FIRST_ID) for k in new.keyframes)
    here = slam_map_of(replace(new, keyframes=keyframes), camera)
    here.held = frozenset()
    database = KeyframeDatabase()
    for keyframe in there.keyframes.values():
        database.add(keyframe.keyframe_id, keyframe.features.descriptors)
    relocalizer = Relocalizer(camera)
    detector = LoopDetector(database, relocalizer)
    n_found = n_once = most = 0
    for keyframe in here.keyframes.values():
        found = detector.find(keyframe, here, [there], lambda _found, _same: True)
        if found is not None:
            n_found, most = n_found + 1, max(most, len(found.relocalised.points))
            continue
        level = keyframe.camera_from_map.rotation.T
        for key in database.query(keyframe.features.descriptors, 4):
            once = relocalizer.relocalise(
                keyframe.features, there, there.keyframes[key], level, keyframe.keyframe_id
            )
            if once is not None:
                n_once, most = n_once + 1, max(most, len(once.points))
                break
    return n_found, n_once, len(here.keyframes), most


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flights", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    measured: dict[str, Callable[[Path, Path], None]] = {
        "maps": maps, "located": located,
        "denied": lambda flights, work: located(flights, work, (WITHOUT_POSITIONS,)),
        "merged": merged, "others": others,
    }  # fmt: skip
    parser.add_argument("--only", default=",".join(measured))
    options = parser.parse_args()
    for name in options.only.split(","):
        measured[name](options.flights, options.work)


if __name__ == "__main__":
    main()
