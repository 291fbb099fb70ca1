"""Result files of a run."""

from __future__ import annotations

from pathlib import Path

from companion.messages.run_facts import RunFacts
from companion.products.atomic_file import write_atomically
from companion.products.cloud_ply import ply_parts
from companion.products.flight_result import FlightResult
from companion.products.report.report_json import report, report_json
from companion.products.report.report_page import report_page
from companion.products.trajectory_file import trajectory_tum


def write_results(
    out: Path, result: FlightResult, facts: RunFacts, voxel_m: float, page: bool = True
) -> None:
    """Write trajectory.tum, cloud.ply, report.json and report.html into folder `out`.

    Without `page` the last, which takes longest, is left out. Each is replaced in one step, the
    page last; raises OSError where the folder cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    poses, cloud = result.poses(), result.cloud(voxel_m)
    origin, unit = facts.origin, result.unit
    numbers = report(result, facts, poses, cloud)
    write_atomically(out / "trajectory.tum", trajectory_tum(poses, unit, origin))
    write_atomically(out / "cloud.ply", ply_parts(cloud, unit, origin))
    write_atomically(out / "report.json", report_json(numbers))
    if page:
        html = report_page(result, facts, poses, cloud, numbers)
        write_atomically(out / "report.html", html)
