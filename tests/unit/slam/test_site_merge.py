"""Site maps of several flights as one: bound by what both saw, placed as both were."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.app.cli import main
from companion.geometry.transforms import Array, Pose, Similarity, yaw_rotation
from companion.products.site_map_file import read_site_map, write_site_map
from companion.slam.map.patch_refinement import SIGMA_PX
from companion.slam.map.seen import Seen
from companion.slam.map.site_map import SiteGeoreference, SiteMap, SitePart, site_map_of
from companion.slam.mapping.site_merge import merge_sites
from tests.bench.kept_map import rms, similarity
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

IN_ITSELF = Similarity.identity()


def kept(ground: Ground, path: list[Pose], name: str, off_m: float, scale: float) -> SiteMap:
    """A site map off by some metres to the north, and by a scale."""
    made = mapped(ground, path, Similarity(0.4, yaw_rotation(1.1), np.array([3.0, -7.0, 2.0])))
    world_from_map = (
        Similarity(scale, np.eye(3), np.array([off_m, 0.0, 0.0]))
        @ Similarity(0.4, yaw_rotation(1.1), np.array([3.0, -7.0, 2.0])).inverse()
    )
    georeference = SiteGeoreference(None, 1.0, 0.02, 0.01, "gps")
    part = SitePart(name, 0, CAMERA, 1)
    return site_map_of(made, world_from_map, (part,), {}, georeference, 1)


def line(start: tuple[float, float], end: tuple[float, float], yaw: float) -> list[Pose]:
    return [flown(p, yaw) for p in np.linspace(start, end, 9)]


PATHS = line((-6, 0), (6, 0), 0.0), line((6, 3), (0, -3), 2.6)


def places(site: SiteMap) -> Array:
    return np.stack([k.camera_from_map.inverse().translation for k in site.keyframes])


@pytest.fixture(scope="module")
def sites() -> tuple[SiteMap, SiteMap]:
    ground = Ground(np.random.default_rng(5))
    return (
        kept(ground, PATHS[0], "first", 1.0, 1.01),
        kept(ground, PATHS[1], "second", -1.0, 0.99),
    )


def test_two_maps_become_one_between_them(sites: tuple[SiteMap, SiteMap]) -> None:
    merged = merge_sites(*sites, IN_ITSELF)
    assert merged is not None
    assert [p.flight for p in merged.parts] == ["first", "second"]
    assert merged.part_of.tolist() == [0] * 9 + [1] * 9
    assert [k.keyframe_id for k in merged.keyframes] == list(range(18))
    assert [k.t_ns for k in merged.keyframes[9:]] == [k.t_ns for k in sites[1].keyframes]
    true = np.stack([p.translation for path in PATHS for p in path])
    off = places(merged) - true
    assert np.abs(off).max() < 0.1  # of 1 m each, the other way
    assert merged.georeference.sigma_m == pytest.approx(1 / np.sqrt(2))
    of_first = np.unique(np.concatenate([k.point_ids for k in merged.keyframes[:9]]))
    shared = [np.isin(k.point_ids[k.point_ids >= 0], of_first).sum() for k in merged.keyframes[9:]]
    assert np.median(shared) > 50


def refined(ground: Ground, path: list[Pose], name: str) -> SiteMap:
    """A site map, right to the bit but for its scale, whose features are refined.

    Each point is not the corner itself, but what its first view took for the corner, to 0.3 px; of
    that the features of all others see the place to a twentieth of a pixel.
    """
    made = mapped(ground, path, IN_ITSELF)
    rng = np.random.default_rng(len(name))
    for keyframe in made.keyframes.values():
        new = made.first_seen[keyframe.point_ids] == keyframe.keyframe_id
        ids, rays = keyframe.point_ids[new], np.insert(keyframe.normalised[new], 2, 1.0, axis=1)
        depth = keyframe.camera_from_map.apply(made.positions[ids])[:, 2:]
        made.positions[ids] = keyframe.camera_from_map.inverse().apply(rays * depth)
    for keyframe in made.keyframes.values():
        ids = keyframe.point_ids
        seen = keyframe.camera_from_map.apply(made.positions[ids])
        noise = rng.normal(scale=0.05 / CAMERA.fx, size=(len(ids), 2))
        keyframe.seen = Seen(
            keyframe.features, seen[:, :2] / seen[:, 2:] + noise,
            keyframe.features.whitening / SIGMA_PX,
        )  # fmt: skip
        keyframe.refined_for = ids.copy()
    georeference = SiteGeoreference(None, 1.0, 0.02, 0.01, "gps")
    to_world = Similarity(1.02, yaw_rotation(0.1), np.array([1.0, 0.0, 0.0]))
    part = SitePart(name, 0, CAMERA, 1)
    return site_map_of(made, to_world, (part,), {}, georeference, 1)


def test_what_patches_tell_within_each_map_is_kept_between_both() -> None:
    ground = Ground(np.random.default_rng(5))
    merged = merge_sites(
        refined(ground, PATHS[0], "first"), refined(ground, PATHS[1], "second"), IN_ITSELF
    )
    assert merged is not None
    true = np.stack([p.translation for path in PATHS for p in path])
    found = places(merged)
    off_m = rms(found, true, similarity(found, true))
    assert off_m < 0.002  # where both maps' corners count, 0.0036


def test_the_better_placed_map_counts_more(sites: tuple[SiteMap, SiteMap]) -> None:
    first, second = sites
    surer = replace(first, georeference=replace(first.georeference, sigma_m=0.1))
    merged = merge_sites(surer, second, IN_ITSELF)
    assert merged is not None
    true = np.stack([p.translation for path in PATHS for p in path])
    assert (places(merged) - true)[:, 0].mean() == pytest.approx(1.0, abs=0.1)


def test_maps_of_two_sites_are_not_merged(sites: tuple[SiteMap, SiteMap]) -> None:
    elsewhere = kept(Ground(np.random.default_rng(6)), PATHS[0], "elsewhere", 0.0, 1.0)
    assert merge_sites(sites[0], elsewhere, IN_ITSELF) is None


def without_patches(site: SiteMap, sigma_m: float) -> SiteMap:
    level = np.full_like(site.points.patch_level, -1)
    return replace(
        site, points=site.points._replace(patch_level=level),
        georeference=replace(site.georeference, sigma_m=sigma_m),
    )  # fmt: skip


def test_maps_bound_by_one_place_alone_are_told_and_refused(
    sites: tuple[SiteMap, SiteMap], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for sigma_m, status, said in ((5.0, 0, "at one place only"), (1e-4, 2, "at one place only")):
        for n, site in enumerate(sites):
            write_site_map(tmp_path / f"{n}.map", without_patches(site, sigma_m))
        out = tmp_path / "both.map"
        out.unlink(missing_ok=True)
        given = [str(tmp_path / f"{n}.map") for n in range(2)]
        assert main(["map", "merge", *given, "--out", str(out)]) == status
        assert said in "".join(capsys.readouterr())
        assert out.exists() == (status == 0)


def test_pruning_leaves_out_redundant_keyframes_only(tmp_path: Path) -> None:
    ground = Ground(np.random.default_rng(8))
    near = [flown(np.array([0.02 * n, 0.0])) for n in range(16)]
    far = [flown(np.array([3.0 + 2.0 * n, 0.0])) for n in range(6)]
    site = kept(ground, near + far, "hover", 0.0, 1.0)
    write_site_map(tmp_path / "all.map", site)
    out = tmp_path / "few.map"
    assert main(["map", "prune", str(tmp_path / "all.map"), "--out", str(out)]) == 0
    pruned = read_site_map(out).site
    assert pruned.revision == 2 and 0 < len(site.keyframes) - len(pruned.keyframes)
    left = places(pruned)
    for place in places(site)[16:]:
        assert np.linalg.norm(left - place, axis=1).min() < 1e-6
    times = {k.t_ns for k in site.keyframes}
    assert {k.t_ns for k in pruned.keyframes} < times


def test_pruning_thins_a_flight_that_sees_its_ground_often(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Keyframes 6 degrees apart, each point in a dozen of them."""
    path = [flown(np.array([1.0 * n, 0.0])) for n in range(-10, 11)]
    site = kept(Ground(np.random.default_rng(8)), path, "line", 0.0, 1.0)
    write_site_map(tmp_path / "all.map", site)
    out = tmp_path / "few.map"
    assert main(["map", "prune", str(tmp_path / "all.map"), "--out", str(out)]) == 0
    pruned = read_site_map(out).site
    assert len(pruned.keyframes) <= 0.7 * len(site.keyframes)
    assert len(pruned.points.positions) >= 0.9 * len(site.points.positions)
    assert f"{len(pruned.keyframes)} of 21 keyframes" in capsys.readouterr().out


def test_the_command_merges_files(
    sites: tuple[SiteMap, SiteMap], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for n, site in enumerate(sites):
        write_site_map(tmp_path / f"{n}.map", site)
    out = tmp_path / "both.map"
    paths = [str(tmp_path / "0.map"), str(tmp_path / "1.map")]
    assert main(["map", "merge", *paths, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "second moved by" in said and "second gave" in said
    assert len(read_site_map(out).site.keyframes) == 18
    assert main(["map", "merge", *paths, "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    (join,) = told["joins"]
    assert join["n_shared"] >= 20 and not join["by_one_place"]
    assert [each["flights"] for each in join["moved"]] == [["first"], ["second"]]
    assert told["n_keyframes"] == 18
    for flight, site in zip(told["flights"], sites, strict=True):
        way_m = np.linalg.norm(np.diff(places(site), axis=0), axis=1).sum()
        assert abs(flight["path_m"] / way_m - 1.0) < 0.05 and flight["n_keyframes"] == 9
        assert 0 < flight["apart_m"] < 0.1
    assert main(["map", "merge", paths[0], "--out", str(out)]) == 2
