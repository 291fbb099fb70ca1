"""Changes between two maps of a site: only what the other flight looked through has gone."""

from __future__ import annotations

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.app.cli import main
from companion.app.maps.compare_maps import changes_in_words, compare_maps
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Array, Pose, Similarity
from companion.products.site_map_file import write_site_map
from companion.slam.map.map_points import PointArrays
from companion.slam.map.site_map import SiteGeoreference, SiteMap, SitePart, site_map_of
from companion.slam.mapping.site_change import SiteComparison, changes_in, compare_sites
from companion.slam.mapping.site_fading import faded
from companion.slam.mapping.site_merge import merge_sites
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

IN_ITSELF = Similarity.identity()
HIGH_M = 3.0
"""Of the boxes, above ground that is rough by 0.4 m."""
THERE, ELSEWHERE, OUTSIDE = np.array([-2.0, 0.5]), np.array([2.5, -0.5]), np.array([0.0, 14.0])


def ground(seed: int = 5) -> Ground:
    made = Ground(np.random.default_rng(seed), half=16.0, n=9000)
    made.points[:, 2] *= 0.2
    return made


def box(made: Ground, at: Array, look: int, size_m: float = 1.6) -> None:
    """Put the flat top of a box there: it hides what is below."""
    rng = np.random.default_rng(look)
    hidden = np.abs(made.points[:, :2] - at).max(1) < 0.9 * size_m
    top = np.c_[at + rng.uniform(-size_m / 2, size_m / 2, (80, 2)), np.full(80, -HIGH_M)]
    made.points = np.concatenate([made.points[~hidden], top])
    looks = rng.integers(0, 256, (80, 32)).astype(np.uint8)
    made.descriptors = np.concatenate([made.descriptors[~hidden], looks])


def site(made: Ground, name: str, back: bool = False) -> SiteMap:
    ends = ((5.0, 1.0), (-5.0, -1.0)) if back else ((-5.0, 0.0), (5.0, 0.0))
    path: list[Pose] = [flown(p, 2.6 if back else 0.0) for p in np.linspace(*ends, 14)]
    georeference = SiteGeoreference(None, 1.0, 0.02, 0.01, "gps")
    return site_map_of(
        mapped(made, path, IN_ITSELF), IN_ITSELF, (SitePart(name, 0, CAMERA, 1),), {},
        georeference, 1,
    )  # fmt: skip


def compared(before: Ground, after: Ground) -> SiteComparison:
    found = compare_sites(site(before, "before"), site(after, "after", back=True), IN_ITSELF)
    assert found is not None
    return found


def test_where_nothing_changed_nothing_is_told() -> None:
    found = compared(ground(), ground())
    assert found.changes == () and found.n_shared > 500
    assert found.n_looked[0] > 0.5 * found.n_points[0]
    assert found.apart_m is not None and 0.0 < found.apart_m < 0.1


def test_gone_new_and_moved_things_are_told_apart() -> None:
    before, after = ground(), ground()
    box(before, THERE, 1)
    box(after, ELSEWHERE, 2)
    found = compared(before, after)
    assert sorted(c.kind for c in found.changes) == ["gone", "new"]
    for change in found.changes:
        place = np.r_[THERE if change.kind == "gone" else ELSEWHERE, -HIGH_M]
        assert np.linalg.norm(change.centre_m - place) < 0.4
        assert change.n_views >= 3 and 0.0 < change.threshold_m < HIGH_M
    after = ground()
    box(after, ELSEWHERE, 1)
    after.points[-80:, :2] = before.points[-80:, :2] + ELSEWHERE - THERE
    (moved,) = compared(before, after).changes
    assert moved.kind == "moved" and moved.moved_m is not None
    assert moved.moved_m == pytest.approx(np.r_[ELSEWHERE - THERE, 0.0], abs=0.2)


def test_a_thing_where_the_other_flight_did_not_look_is_no_change() -> None:
    before = ground()
    box(before, THERE, 1)
    left_out = ground()
    near = np.abs(left_out.points[:, :2] - THERE).max(1) < 3.0
    left_out.points, left_out.descriptors = left_out.points[~near], left_out.descriptors[~near]
    assert compared(before, left_out).changes == ()


def side_by_side(old: SiteMap, new: SiteMap) -> SiteMap:
    """Two maps as one, without a point that both observe."""
    n_old, offset = len(old.keyframes), len(old.points.positions)
    later = tuple(
        replace(k, keyframe_id=k.keyframe_id + n_old,
                point_ids=np.where(k.point_ids >= 0, k.point_ids + offset, -1))
        for k in deepcopy(new.keyframes)
    )  # fmt: skip
    return replace(
        old, parts=(*old.parts, *new.parts), keyframes=(*old.keyframes, *later),
        part_of=np.r_[old.part_of, new.part_of + 1],
        points=PointArrays._make(
            np.concatenate([a, b]) for a, b in zip(old.points, new.points, strict=True)
        ),
        covariances=np.concatenate([old.covariances, new.covariances]),
    )  # fmt: skip


def test_where_no_point_is_observed_by_both_nothing_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, after = ground(), ground()
    box(before, THERE, 1)
    both = side_by_side(site(before, "before"), site(after, "after", back=True))
    found = changes_in(both, 1)
    assert found.apart_m is None and found.changes == () and found.n_looked == (0, 0)
    assert "too few" in changes_in_words(found)
    assert faded(both) is both
    monkeypatch.setattr("companion.app.maps.compare_maps.compare_sites", lambda *_: found)
    path = tmp_path / "site.map"
    write_site_map(path, both)
    compare_maps(path, path, tmp_path)
    assert json.loads((tmp_path / "changes.json").read_text())["apart_m"] is None
    assert "What has changed is not known" in (tmp_path / "changes.html").read_text()


def test_what_later_flights_look_through_fades_from_a_map() -> None:
    before, after = ground(), ground()
    box(before, THERE, 1)
    old, new = site(before, "before"), site(after, "after", back=True)
    both = merge_sites(old, new, IN_ITSELF)
    assert both is not None
    left = faded(both)
    tops = [int((s.points.positions[:, 2] < -2.5).sum()) for s in (both, left)]
    assert tops[0] > 40 and tops[1] < 0.2 * tops[0]
    n_lost = len(both.points.positions) - len(left.points.positions)
    assert n_lost < tops[0] + 0.01 * len(both.points.positions)
    for keyframe in left.keyframes:
        seen = keyframe.point_ids[keyframe.point_ids >= 0]
        projected = keyframe.camera_from_map.apply(left.points.positions[seen])
        off = projected[:, :2] / projected[:, 2:] - keyframe.normalised[keyframe.point_ids >= 0]
        assert np.abs(off).max() < 0.02
    assert faded(old) is old


def test_the_command_leaves_a_page_and_layers_for_other_programs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, after = ground(), ground()
    box(after, ELSEWHERE, 2)
    origin = GeoOrigin(47.1, 8.5, 400.0)
    for name, made in (("a", before), ("b", after)):
        kept = site(made, name, back=name == "b")
        placed = replace(kept.georeference, origin=origin)
        write_site_map(tmp_path / f"{name}.map", replace(kept, georeference=placed))
    maps, out = [str(tmp_path / f"{name}.map") for name in "ab"], tmp_path / "out"
    assert main(["compare", "--maps", *maps, "--out", str(out)]) == 0
    assert "new at 2." in capsys.readouterr().out
    told = json.loads((out / "changes.json").read_text())
    assert [each["kind"] for each in told["changes"]] == ["new"]
    ((layer),) = json.loads((out / "changes.geojson").read_text())["features"]
    lon, lat, height = layer["geometry"]["coordinates"]
    assert lat == pytest.approx(47.1 + 2.5 / 111_200, abs=1e-5) and lon > 8.5 - 1e-4
    assert height == pytest.approx(400.0 + HIGH_M, abs=1.5)
    assert b"element vertex 0" not in (out / "changes.ply").read_bytes()[:400]
    assert "1 new" in (out / "changes.html").read_text()
    assert main(["compare", "--maps", maps[0], str(tmp_path / "none.map")]) == 2
    assert main(["compare", "--maps", *maps, "--max-apart", "1"]) == 2
