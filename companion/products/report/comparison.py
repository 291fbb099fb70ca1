"""Differences between two runs of one flight: poses, cloud, times."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from companion.config_file import CONSTANTS, current_key
from companion.errors import InputError
from companion.geometry.transforms import Array, best_similarity
from companion.products.cloud import Cloud
from companion.products.run_folder import FinishedRun

MOST_POINTS = 200_000
"""Most points of a cloud looked up in the other; evenly sampled beyond it."""
AT_ONCE = 2000
"""Between two of them a signal is heard."""
NEAR, ROUGH = 0.02, 0.1
"""Further apart than this share of the cloud's extent, distances are up to a tenth too large: of
two sheets beside each other, each point would be compared with thousands."""
COUNTS = ("frames", "tracked", "segments", "keyframes", "depth_maps", "points", "path_length")
"""Numbers of the reports that are compared."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseDifference:
    """Frames localised in both runs, by time: `distance_m` (N,), `rotation_deg` (N,).

    Both in the world of each run; `aligned_rms_m` is the ATE after the best similarity, whose scale
    is `scale`.
    """

    n_only_a: int
    n_only_b: int
    t_ns: Array
    centres_a: Array
    centres_b: Array
    distance_m: Array
    rotation_deg: Array
    aligned_rms_m: float
    scale: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the distances; 0 where no frame is in both."""
        return float(np.sqrt((self.distance_m**2).mean())) if len(self.distance_m) else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CloudDifference:
    """Distances (N,) from points of each cloud to the nearest of the other, metres."""

    from_a_m: Array
    from_b_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Run B compared to run A; `same_files` says for each result whether its bytes are equal."""

    same_files: Mapping[str, bool]
    poses: PoseDifference
    cloud: CloudDifference
    counts: Mapping[str, tuple[Any, Any]]
    stages: Mapping[str, tuple[Mapping[str, float] | None, Mapping[str, float] | None]]
    config: Mapping[str, tuple[Any, Any]]
    """Keys that differ."""
    versions: Mapping[str, tuple[Any, Any]]
    """Versions that differ."""
    unit: str

    @property
    def identical(self) -> bool:
        """True if poses and cloud are equal to the last bit."""
        return all(self.same_files.values())


def compare_runs(a: FinishedRun, b: FinishedRun) -> Comparison:
    """Compare two finished runs; InputError where they have no frame in common."""
    times = [{pose.t_ns for pose in run.poses} for run in (a, b)]
    if all(times) and times[0].isdisjoint(times[1]):
        raise InputError(
            f"{a.path} and {b.path} have no frame in common: they are not of one flight, or of "
            "other parts of it"
        )
    same = {
        name: (a.path / name).read_bytes() == (b.path / name).read_bytes()
        for name in ("trajectory.tum", "cloud.ply")
    }
    return Comparison(
        same,
        _poses(a, b),
        CloudDifference(_distances(a.cloud, b.cloud), _distances(b.cloud, a.cloud)),
        {name: (a.report.get(name), b.report.get(name)) for name in COUNTS},
        _side_by_side(a.report.get("stages"), b.report.get("stages")),
        _differing(_settings(a.report), _settings(b.report)),
        _differing(_flat(a.report.get("versions")), _flat(b.report.get("versions"))),
        "m" if a.metric and b.metric else "map units",
    )


def numbers(found: Comparison) -> dict[str, Any]:
    """The comparison as JSON; null for missing values."""
    poses, cloud = found.poses, found.cloud
    return {
        "identical": found.identical,
        "same_files": dict(found.same_files),
        "unit": found.unit,
        "poses": {
            "common": len(poses.t_ns), "only_a": poses.n_only_a, "only_b": poses.n_only_b,
            "rms": poses.rms_m, "max": _largest(poses.distance_m),
            "turned_deg_max": _largest(poses.rotation_deg),
            "aligned_rms": poses.aligned_rms_m, "scale": poses.scale,
        },
        "cloud": {
            "a_to_b": _quantiles(cloud.from_a_m), "b_to_a": _quantiles(cloud.from_b_m),
        },
        "counts": {name: list(pair) for name, pair in found.counts.items()},
        "stages_p50_ms": {
            name: [each.get("p50_ms") if each else None for each in pair]
            for name, pair in found.stages.items()
        },
        "config": {name: list(pair) for name, pair in found.config.items()},
        "versions": {name: list(pair) for name, pair in found.versions.items()},
    }  # fmt: skip


def _poses(a: FinishedRun, b: FinishedRun) -> PoseDifference:
    of_a = {pose.t_ns: pose.world_from_camera for pose in a.poses}
    of_b = {pose.t_ns: pose.world_from_camera for pose in b.poses}
    common = sorted(of_a.keys() & of_b.keys())
    centres_a = np.array([of_a[t].translation for t in common]).reshape(-1, 3)
    centres_b = np.array([of_b[t].translation for t in common]).reshape(-1, 3)
    # by the chord, not the trace: exact for rotations that are nearly the same
    chords = np.array([np.linalg.norm(of_a[t].rotation - of_b[t].rotation) for t in common])
    rms, scale = 0.0, 1.0
    if len(common) >= 3 and not np.array_equal(centres_a, centres_b):
        found = best_similarity(centres_b, centres_a)
        rms = float(np.sqrt(((found.apply(centres_b) - centres_a) ** 2).sum(1).mean()))
        scale = found.scale
    return PoseDifference(
        len(of_a) - len(common), len(of_b) - len(common), np.array(common, np.int64), centres_a,
        centres_b, np.linalg.norm(centres_a - centres_b, axis=1),
        np.degrees(2 * np.arcsin(np.minimum(chords / np.sqrt(8), 1))), rms, scale,
    )  # fmt: skip


def _distances(cloud: Cloud, other: Cloud) -> Array:
    if not len(cloud) or not len(other):
        return np.zeros(0)
    step = -(-len(cloud) // MOST_POINTS)
    points, tree = cloud.points[::step], cKDTree(other.points.astype(np.float64))
    near = NEAR * float(np.linalg.norm(np.ptp(other.points, axis=0)))
    parts = []
    for begin in range(0, len(points), AT_ONCE):
        part = points[begin : begin + AT_ONCE]
        found, _ = tree.query(part, distance_upper_bound=near)
        far = np.isinf(found)
        found[far], _ = tree.query(part[far], eps=ROUGH)
        parts.append(found)
    out: Array = np.concatenate(parts)
    return out


def _side_by_side(
    a: Any, b: Any
) -> dict[str, tuple[Mapping[str, float] | None, Mapping[str, float] | None]]:
    of_a, of_b = (each if isinstance(each, Mapping) else {} for each in (a, b))
    return {name: (of_a.get(name), of_b.get(name)) for name in sorted({*of_a, *of_b})}


def _settings(report: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by the keys of this version; a constant of now only where it was another value."""
    values = _flat(report.get("config")).items()
    return {current_key(k) or k: v for k, v in values if CONSTANTS.get(k) != v}


def _flat(values: Any, before: str = "") -> dict[str, Any]:
    if not isinstance(values, Mapping):
        return {before.rstrip("."): values}
    out: dict[str, Any] = {}
    for key, value in values.items():
        out.update(_flat(value, f"{before}{key}."))
    return out


def _differing(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    return {key: (a.get(key), b.get(key)) for key in sorted({*a, *b}) if a.get(key) != b.get(key)}


def _largest(values: Array) -> float | None:
    return float(values.max()) if len(values) else None


def _quantiles(values: Array) -> dict[str, float | None]:
    shares = {"p50": 50, "p95": 95, "max": 100}
    return {k: float(np.percentile(values, q)) if len(values) else None for k, q in shares.items()}
