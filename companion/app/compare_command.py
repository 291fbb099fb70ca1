"""companion compare: differences between two runs of a flight, or between two maps of a site."""

from __future__ import annotations

import json
from pathlib import Path

from companion.products.atomic_file import write_atomically
from companion.products.report.comparison import Comparison, compare_runs, numbers
from companion.products.report.comparison_page import comparison_page, shown
from companion.products.run_folder import read_run


def compare(run_a: Path, run_b: Path, out: Path | None) -> Comparison:
    """Compare the folders of two runs; with `out`, write compare.html and compare.json there.

    InputError where one of them is no run, or they are of different flights.
    """
    found = compare_runs(read_run(run_a), read_run(run_b))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        text = json.dumps(numbers(found), indent=2, allow_nan=False) + "\n"
        write_atomically(out / "compare.json", text.encode())
        write_atomically(out / "compare.html", comparison_page(found, str(run_a), str(run_b)))
    return found


def in_words(found: Comparison) -> str:
    """Summary of the comparison."""
    if found.identical:
        return "poses and cloud are the same to the last bit"
    n, unit = numbers(found), found.unit
    poses, cloud = n["poses"], n["cloud"]
    lines = [
        f"{name}: {'the same bytes' if same else 'differs'}"
        for name, same in found.same_files.items()
    ]
    lines += [
        f"poses: {poses['common']} in both, {poses['only_a']} in A only, {poses['only_b']} in B "
        f"only; apart {shown(poses['rms'])} {unit} RMS, {shown(poses['max'])} {unit} and "
        f"{shown(poses['turned_deg_max'])} deg at most; {shown(poses['aligned_rms'])} {unit} RMS "
        f"after alignment, scale {shown(poses['scale'])}",
        f"cloud: {shown(cloud['a_to_b']['p50'])} {unit} from A to B (median), "
        f"{shown(cloud['b_to_a']['p50'])} {unit} back; 95 % within "
        f"{shown(cloud['a_to_b']['p95'])} and {shown(cloud['b_to_a']['p95'])} {unit}",
    ]
    lines += [f"{name}: {shown(a)}, {shown(b)}" for name, (a, b) in found.counts.items() if a != b]
    lines += [f"{name} = {a!r}, {b!r}" for name, (a, b) in found.config.items()]
    return "\n".join(lines)


def beyond(found: Comparison, most_apart: float | None, most_cloud: float | None) -> list[str]:
    """Limits exceeded: RMS distance of poses, 95th percentile of distances between the clouds."""
    out = []
    poses, cloud = found.poses, numbers(found)["cloud"]
    if most_apart is not None:
        missing = poses.n_only_a - poses.n_only_b
        if not len(poses.t_ns) or poses.rms_m > most_apart:
            out.append(f"poses are {poses.rms_m:.4g} {found.unit} apart, allowed {most_apart:g}")
        if missing > 0.01 * (len(poses.t_ns) + poses.n_only_a):
            out.append(f"B has placed {missing} frames fewer")
    if most_cloud is not None:
        for name, key in (("A to B", "a_to_b"), ("B to A", "b_to_a")):
            p95 = cloud[key]["p95"]
            if p95 is None or p95 > most_cloud:
                away = "there is no cloud" if p95 is None else f"{p95:.4g} {found.unit} (95 %)"
                out.append(f"cloud from {name}: {away}, allowed {most_cloud:g}")
    return out
