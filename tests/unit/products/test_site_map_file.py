"""Files of site maps: the same map back, what is damaged left out, what is no map refused."""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.app.cli import main
from companion.app.maps import map_command
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Similarity, yaw_rotation
from companion.products.array_file import ArrayFile
from companion.products.site_map_file import (
    SITE_MAP,
    read_head,
    read_site_map,
    write_site_map,
)
from companion.products.site_map_rows import (
    FEATURE,
    OBSERVED,
    PATCH,
    POINT,
    WHOLE_FEATURE,
    WHOLE_POINT,
    packed,
    unpacked,
)
from companion.products.site_map_tables import (
    BLOCK,
    BLOCK_BEFORE,
    VERSION,
    SiteMapError,
    SiteMapTables,
    _digest_before,
    checksum,
)
from companion.slam.loop.place_recognition import place_blocks
from companion.slam.map.map_points import PointArrays
from companion.slam.map.seen import Seen
from companion.slam.map.site_map import (
    SiteGeoreference,
    SiteMap,
    SitePart,
    site_map_of,
    slam_map_of,
)
from companion.slam.map.sparse_map import SlamMap
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

TO_WORLD = Similarity(2.5, yaw_rotation(0.4), np.array([10.0, -20.0, -30.0]))
ORIGIN = GeoOrigin(47.1, 8.5, 400.0)


@pytest.fixture(scope="module")
def slam_map() -> SlamMap:
    path = [flown(p) for p in np.linspace((-6, 0), (6, 0), 10)]
    made = mapped(Ground(np.random.default_rng(5)), path, Similarity.identity(), first_id=7)
    made.keyframes[12].ned_from_camera = flown(np.zeros(2)).rotation
    made.keyframes[12].refined_for[:] = made.keyframes[12].point_ids
    made.keyframes[12].whitening[:] *= 2.0
    return made


@pytest.fixture(scope="module")
def site(slam_map: SlamMap) -> SiteMap:
    part = SitePart("morning", min(k.t_ns for k in slam_map.keyframes.values()), CAMERA, 1)
    georeference = SiteGeoreference(ORIGIN, 0.8, 0.01, 0.004, "gps")
    return site_map_of(slam_map, TO_WORLD, (part,), {}, georeference, 1)


@pytest.fixture
def path(tmp_path: Path, site: SiteMap) -> Path:
    path = tmp_path / SITE_MAP
    write_site_map(path, site)
    return path


def test_a_map_comes_back_as_it_was(path: Path, site: SiteMap) -> None:
    read = read_site_map(path)
    again = read.site
    assert not read.damaged
    assert again.georeference == site.georeference and again.revision == 1
    assert [p.flight for p in again.parts] == ["morning"]
    for before, after in zip(site.keyframes, again.keyframes, strict=True):
        assert before.t_ns == after.t_ns
        np.testing.assert_array_equal(before.point_ids, after.point_ids)
        np.testing.assert_array_equal(before.features.descriptors, after.features.descriptors)
        np.testing.assert_allclose(before.features.pixels, after.features.pixels, atol=1e-3)
        np.testing.assert_allclose(before.normalised, after.normalised, atol=1e-7)
        np.testing.assert_allclose(before.whitening, after.whitening, rtol=1e-5)
        np.testing.assert_array_equal(
            before.camera_from_map.matrix(), after.camera_from_map.matrix()
        )
    np.testing.assert_array_equal(site.points.positions, again.points.positions)
    np.testing.assert_allclose(site.covariances, again.covariances, rtol=1e-5, equal_nan=True)


def test_it_is_metric_and_projects_as_before(slam_map: SlamMap, site: SiteMap) -> None:
    old, new = slam_map.keyframes[7], site.keyframes[0]
    np.testing.assert_allclose(
        TO_WORLD.apply(old.centre), new.camera_from_map.inverse().translation, atol=1e-9
    )
    _, ids = slam_map.observations_of(old)
    seen = old.camera_from_map.apply(slam_map.positions[ids])
    kept = new.point_ids[new.point_ids >= 0]
    again = new.camera_from_map.apply(site.points.positions[kept])
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], again[:, :2] / again[:, 2:], atol=1e-9)


def test_covariances_are_those_of_scattered_observations(site: SiteMap) -> None:
    rng = np.random.default_rng(0)
    seen_often = np.argmax([
        sum(int(np.any(k.point_ids == p)) for k in site.keyframes) for p in range(200)
    ])  # fmt: skip
    views = [
        (k, np.flatnonzero(k.point_ids == seen_often)[0])
        for k in site.keyframes
        if np.any(k.point_ids == seen_often)
    ]
    truth = site.points.positions[seen_often]
    errors = []
    for _ in range(400):
        information, gradient = np.zeros((3, 3)), np.zeros(3)
        for k, feature in views:
            p = k.camera_from_map.apply(truth)
            projection = np.array([[1, 0, -p[0] / p[2]], [0, 1, -p[1] / p[2]]]) / p[2]
            jacobian = k.whitening[feature] @ projection @ k.camera_from_map.rotation
            information += jacobian.T @ jacobian
            gradient += jacobian.T @ rng.normal(size=2)
        errors.append(np.linalg.solve(information, gradient))
    measured = np.cov(np.array(errors).T)
    stated = site.covariances[seen_often]
    assert 0.75 < np.trace(measured) / np.trace(stated) < 1.33


def test_keyframes_of_another_day_lie_before_all_of_today(site: SiteMap) -> None:
    again = slam_map_of(site, CAMERA)
    assert again.held == frozenset(range(10)) and again.level
    assert max(k.t_ns for k in again.keyframes.values()) < 0
    assert all(k.ned_from_camera is None for k in again.keyframes.values())
    often = again.n_observers[: again.n_points] >= 2
    np.testing.assert_array_equal(again.alive[: again.n_points], often)


def test_what_is_damaged_is_left_out_and_named(path: Path, site: SiteMap) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute("UPDATE keyframe SET features = zeroblob(length(features)) WHERE id = 3")
        file.execute("UPDATE points SET data = zeroblob(length(data)) WHERE id = 0")
        file.commit()
    read = read_site_map(path)
    assert len(read.damaged) == 2 and "keyframe 3" in read.damaged
    assert len(read.site.keyframes) == 9
    lost = np.isnan(read.site.points.positions[:, 0])
    assert lost[:BLOCK].all() and not lost[BLOCK:].any()
    seen = np.concatenate([k.point_ids for k in read.site.keyframes])
    assert not lost[seen[seen >= 0]].any()
    assert main(["map", "verify", str(path)]) == 1


def test_features_of_another_layout_are_left_out(path: Path) -> None:
    """Whole by their checksum, but not what this version writes."""
    with closing(sqlite3.connect(path)) as file:
        *row, _ = file.execute("SELECT * FROM keyframe WHERE id = 3").fetchone()
        row[-1] = row[-1][:-1]
        file.execute(
            "UPDATE keyframe SET features = ?, checksum = ? WHERE id = 3", (row[-1], checksum(row))
        )
        file.commit()
    assert read_site_map(path).damaged == ("keyframe 3",)


def test_an_index_of_places_is_that_of_its_keyframes(path: Path, site: SiteMap) -> None:
    read = read_site_map(path)
    made = place_blocks((k.keyframe_id, k.features.descriptors) for k in site.keyframes)
    for kept, new in zip(read.places, made, strict=True):
        for a, b in zip(kept, new, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_damaged_index_is_not_used(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = read_site_map(path)
    with closing(sqlite3.connect(path)) as file:
        (owners,) = file.execute("SELECT owners FROM places").fetchone()
        file.execute("UPDATE places SET owners = ?", (owners[:-1] + b"\xff",))
        file.commit()
    read = read_site_map(path)
    assert len(read.damaged) == 1 and "index" in read.damaged[0]
    assert whole.places and not read.places and len(read.site.keyframes) == 10
    assert main(["map", "verify", str(path)]) == 1
    assert "index" in capsys.readouterr().out


def test_an_index_of_another_version_is_made_anew(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.products.site_map_rows.PLACES_VERSION", 2)
    read = read_site_map(path)
    assert not read.places and not read.damaged


def test_a_flight_knows_its_map_by_what_was_whole(path: Path, site: SiteMap) -> None:
    whole = read_site_map(path).digest
    assert read_site_map(path, ArrayFile(path.parent)).digest == whole
    write_site_map(path, replace(site, revision=2))
    assert read_site_map(path).digest != whole
    write_site_map(path, site)
    with closing(sqlite3.connect(path)) as file:
        file.execute("UPDATE keyframe SET features = zeroblob(length(features)) WHERE id = 3")
        file.commit()
    assert read_site_map(path).digest != whole


def overwrite(path: Path) -> None:
    """As cp and scp do: another map of as many keyframes and features, in the same file."""
    other = path.with_name("other.map")
    site = read_site_map(path).site
    turned = (
        replace(
            k,
            seen=Seen(
                replace(k.features, descriptors=~k.features.descriptors), k.normalised, k.whitening
            ),
        )
        for k in site.keyframes
    )
    points = site.points._replace(patch_grey=~np.asarray(site.points.patch_grey))
    write_site_map(other, replace(site, keyframes=tuple(turned), points=points))
    path.write_bytes(other.read_bytes())


@pytest.mark.parametrize("change", [
    overwrite, Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:20_000])
])  # fmt: skip
@pytest.mark.parametrize("has_room", [True, False])
def test_a_map_in_use_stays_as_it_was_read(
    path: Path, has_room: bool, change: Callable[[Path], None]
) -> None:
    before = read_site_map(path).site
    used = read_site_map(path, ArrayFile(path.parent if has_room else path)).site
    change(path)
    for one, other in zip(before.keyframes, used.keyframes, strict=True):
        np.testing.assert_array_equal(one.features.descriptors, other.features.descriptors)
        np.testing.assert_array_equal(one.normalised, other.normalised)
    every = np.arange(len(before.points.positions))
    np.testing.assert_array_equal(before.points.patch_grey, used.points.patch_grey[every])


def test_a_map_that_is_written_to_while_it_is_read_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyframe = SiteMapTables.keyframe

    def meanwhile(tables: SiteMapTables, key: int) -> object:
        found = keyframe(tables, key)
        if key == 9:
            path.write_bytes(path.read_bytes()[:-100])
        return found

    monkeypatch.setattr(SiteMapTables, "keyframe", meanwhile)
    with pytest.raises(SiteMapError, match="written to while it was read"):
        read_site_map(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_file_cut_short_is_read_as_far_or_refused(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    try:
        read = read_site_map(path)
    except SiteMapError as error:
        assert str(path) in str(error)
    else:
        assert read.damaged


@pytest.mark.parametrize("seed", range(20))
def test_no_damage_is_taken_for_a_map(path: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, len(data), 200):
        data[at] = rng.integers(256)
    path.write_bytes(bytes(data))
    try:
        read = read_site_map(path)
    except SiteMapError:
        return
    assert read.damaged
    slam_map_of(read.site, CAMERA)


def test_a_newer_version_is_refused_in_words(path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute(f"PRAGMA user_version = {VERSION + 1}")
    with pytest.raises(SiteMapError, match=f"version {VERSION + 1}"):
        read_head(path)


@pytest.mark.parametrize("version", [1, 2])
def test_versions_before_are_read_the_same(path: Path, version: int) -> None:
    new = read_site_map(path).site
    as_before(path, version)
    for far in (None, ArrayFile(path.parent)):
        old = read_site_map(path, far)
        assert not old.damaged and not old.places
        for name in PointArrays._fields:
            a, b = getattr(old.site.points, name), getattr(new.points, name)
            every = np.arange(len(b))
            np.testing.assert_array_equal(a[every], b[every], err_msg=name)
        for one, other in zip(old.site.keyframes, new.keyframes, strict=True):
            np.testing.assert_array_equal(one.point_ids, other.point_ids)
            np.testing.assert_array_equal(one.refined_for, other.refined_for)
            np.testing.assert_array_equal(one.normalised, other.normalised)
            np.testing.assert_array_equal(one.whitening, other.whitening)
            np.testing.assert_array_equal(one.features.descriptors, other.features.descriptors)


def as_before(path: Path, version: int) -> None:
    """Turn a file into one of a version before 3, of a map of less than 1024 points or more."""

    def bytes_of(rows: NDArray[np.void]) -> bytes:
        return packed(rows) if version == 2 else rows.tobytes()

    def whole(of: np.dtype[np.void], *parts: NDArray[np.void]) -> NDArray[np.void]:
        rows = np.zeros(len(parts[0]), of)
        for part in parts:
            for name in part.dtype.names or ():
                rows[name] = part[name]
        return rows

    with closing(sqlite3.connect(path)) as file:
        tables = {
            name: file.execute(f"SELECT * FROM {name}").fetchall()
            for name in ("head", "part", "keyframe", "points")
        }
        for name in (*tables, "places"):
            file.execute(f"DROP TABLE {name}")
        for name in ("head", "part"):
            file.execute(f"CREATE TABLE {name} (id INTEGER PRIMARY KEY, json, digest)")
            for key, said_now, _ in tables[name]:
                said = re.sub('"n_places": 1, |"places_version": 1, ', "", said_now)
                file.execute(
                    f"INSERT INTO {name} VALUES (?, ?, ?)", (key, said, _digest_before([said]))
                )
        file.execute("CREATE TABLE keyframe (id INTEGER PRIMARY KEY, part, json, features, digest)")
        for key, part, said, observed, features, _ in tables["keyframe"]:
            rows = whole(WHOLE_FEATURE, unpacked(features, FEATURE, 10_000))
            seen, rows["point_ids"] = np.frombuffer(observed, OBSERVED), -1
            rows["point_ids"][seen["feature"]] = seen["point"]
            rows["refined"][seen["feature"]] = seen["refined"]
            values = part, said, bytes_of(rows)
            file.execute(
                "INSERT INTO keyframe VALUES (?, ?, ?, ?, ?)",
                (key, *values, _digest_before(values)),
            )
        points = np.concatenate([
            whole(WHOLE_POINT, unpacked(data, POINT, BLOCK), unpacked(patches, PATCH, BLOCK))
            for _, data, patches, _ in tables["points"]
        ])  # fmt: skip
        file.execute("CREATE TABLE points (id INTEGER PRIMARY KEY, data, digest)")
        for first in range(0, len(points), BLOCK_BEFORE):
            block = first, bytes_of(points[first : first + BLOCK_BEFORE])
            file.execute("INSERT INTO points VALUES (?, ?, ?)", (*block, _digest_before(block)))
        file.execute(f"PRAGMA user_version = {version}")
        file.commit()


def test_rows_come_back_from_few_bytes_and_not_more_than_are_due() -> None:
    rows = np.zeros(1000, FEATURE)
    rows["descriptors"] = np.random.default_rng(1).integers(0, 256, (1000, 32))
    rows["sharpness"] = np.arange(1000)
    data = packed(rows)
    assert len(data) < 0.8 * rows.nbytes
    np.testing.assert_array_equal(unpacked(data, FEATURE, 1000), rows)
    for wrong in (data[:-20], b"Dear all", data + b"."):
        with pytest.raises(ValueError, match=r"rows|header"):
            unpacked(wrong, FEATURE, 1000)
    with pytest.raises(ValueError, match="rows"):
        unpacked(data, FEATURE, 999)


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "letter.map"
    with pytest.raises(SiteMapError, match="no such file"):
        read_site_map(path)
    path.write_bytes(b"Dear all,\n" * 500)
    with pytest.raises(SiteMapError, match="no site map"):
        read_site_map(path)


def test_a_failed_write_leaves_the_old_map(
    path: Path, site: SiteMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost_power(_from: object, _to: object) -> None:
        raise OSError(5, "power lost")

    before = path.read_bytes()
    monkeypatch.setattr(os, "replace", lost_power)
    with pytest.raises(OSError, match="power lost"):
        write_site_map(path, site)
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]


def test_the_same_map_gives_the_same_bytes(path: Path, site: SiteMap, tmp_path: Path) -> None:
    again = tmp_path / "again.map"
    write_site_map(again, site)
    assert again.read_bytes() == path.read_bytes()


def test_commands_show_export_and_save(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", "show", str(path.parent)]) == 0
    said = capsys.readouterr().out
    assert "10 keyframes" in said and "47.1000000 8.5000000" in said and "morning" in said
    out = tmp_path / "out"
    out.mkdir()
    assert main(["map", "export", str(path), "--out", str(out)]) == 0
    assert (out / "points.ply").read_bytes().startswith(b"ply")
    assert len([line for line in (out / "keyframes.tum").read_text().splitlines()
                if not line.startswith("#")]) == 10  # fmt: skip
    kept = tmp_path / "kept.map"
    assert main(["map", "save", str(path), "--out", str(kept)]) == 0
    assert map_command.verify(kept)[1]
    assert main(["map", "show", str(tmp_path / "none.map")]) == 2


@pytest.mark.parametrize("words", [["map", "merge"], ["compare", "--maps"]])
def test_maps_of_other_features_are_not_put_together(
    path: Path, site: SiteMap, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    other = tmp_path / "other.map"
    write_site_map(other, replace(site, n_levels=site.n_levels + 1))
    out = tmp_path / "both"
    assert main([*words, str(path), str(other), "--out", str(out)]) == 2
    assert "other features.scale_factor or n_levels" in capsys.readouterr().err
    assert not out.is_file() and not list(out.glob("*"))
