"""companion compare --maps: what has changed at a site between two flights."""

from __future__ import annotations

import json
from pathlib import Path

from companion.errors import InputError
from companion.estimation.site.site_use import world_from_site
from companion.products.atomic_file import write_atomically
from companion.products.cloud_ply import ply_parts
from companion.products.report.change_page import change_page
from companion.products.site_changes import change_cloud, change_geojson, change_numbers
from companion.products.site_map_file import map_path, read_site_map
from companion.slam.mapping.site_change import SiteComparison, compare_sites

PAGE = "changes.html"


def compare_maps(path_a: Path, path_b: Path, out: Path | None) -> SiteComparison:
    """Compare two site maps; with `out`, write changes.html, .json, .ply and .geojson there.

    The last of them only where A has an origin. InputError where no place of one is seen in the
    other, so that nothing can be said.
    """
    a, b = (read_site_map(map_path(path)).site for path in (path_a, path_b))
    if (a.scale_factor, a.n_levels) != (b.scale_factor, b.n_levels):
        raise InputError(
            f"{path_a} and {path_b} were made with other features.scale_factor or n_levels"
        )
    origin = a.georeference.origin
    found = compare_sites(a, b, world_from_site(b.georeference.origin, origin))
    if found is None:
        raise InputError(f"{path_b}: no place in it is seen in {path_a}")
    if out is not None:
        numbers = change_numbers(found, origin)
        text = json.dumps(numbers, indent=2, allow_nan=False) + "\n"
        write_atomically(out / "changes.json", text.encode())
        write_atomically(out / "changes.ply", ply_parts(change_cloud(found), "m", origin))
        if origin is not None:
            write_atomically(out / "changes.geojson", change_geojson(found, origin))
        write_atomically(out / PAGE, change_page(found, numbers, str(path_a), str(path_b)))
    return found


def changes_in_words(found: SiteComparison) -> str:
    """A line about the comparison, and one for each change."""
    if found.apart_m is None:
        return (
            f"{found.n_shared} points in both maps: too few to tell how far these are apart, and "
            "so what has changed"
        )
    lines = [
        f"{found.n_shared} points in both maps, {found.apart_m:.3f} m apart (one axis); looked at "
        f"again: {found.n_looked[0]} of {found.n_points[0]} points of A, {found.n_looked[1]} of "
        f"{found.n_points[1]} of B"
    ]
    for change in found.changes:
        at, size = (
            ", ".join(f"{v:.1f}" for v in each) for each in (change.centre_m, change.size_m)
        )
        moved = change.moved_m
        by = "" if moved is None else f", moved by {', '.join(f'{v:.1f}' for v in moved)} m"
        lines.append(
            f"{change.kind} at {at} m (NED), {size} m large{by}: {len(change.points_m)} points, "
            f"looked through by {change.n_views} keyframes, threshold {change.threshold_m:.2f} m"
        )
    if not found.changes:
        lines.append("no change where both flights looked")
    return "\n".join(lines)
