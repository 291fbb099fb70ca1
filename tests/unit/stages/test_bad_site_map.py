"""A site map that cannot be used: a replay ends, a flight says so and goes on without it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config, MapConfig
from companion.estimation.site.site_of_flight import site_of_flight
from companion.estimation.site.site_use import wrong_metres
from companion.geometry.geodesy import GeoOrigin
from companion.geometry.transforms import Similarity
from companion.messages import Frame, Georeference, Warned
from companion.pilot_messages import OTHER, of_warning
from companion.products.site_map_file import read_site_map, write_site_map
from companion.products.site_map_tables import SiteMapError
from companion.runtime.stage_protocol import Finish, Setup
from companion.stages.localisation_work import MAP_DAMAGED, MAP_NOT_USED, work
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A map made with the features of `Config()`."""
    world = Similarity(2.5, np.eye(3), np.zeros(3))
    there = [flown(p) for p in np.linspace((-6, 0), (6, 0), 10)]
    slam_map = mapped(Ground(np.random.default_rng(5)), there, Similarity.identity())
    placed = Georeference(world, 0.01, 0.02, "gps", 9, 0.5)
    site = site_of_flight(
        [(slam_map, placed)], CAMERA, "morning", GeoOrigin(47.1, 8.5, 400.0), None
    )
    assert site is not None
    features = Config().features
    made = replace(site, scale_factor=features.scale_factor, n_levels=features.n_levels)
    write_site_map(tmp_path / "site.map", made)
    return tmp_path / "site.map"


def said(path: Path, is_live: bool) -> list[Warned]:
    """Warnings with the first frame."""
    stage = work(Setup(Config(map=MapConfig(use=str(path))), CAMERA, path.parent, is_live=is_live))
    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    frame = Frame(0, 1_000_000_000, grey, np.repeat(grey[..., None], 3, 2))
    out = [each for each in stage.step(frame) if isinstance(each, Warned)]
    list(stage.finish(Finish(hurry=True)))
    return out


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:1000])


def newer(path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute("PRAGMA user_version = 99")


def letter(path: Path) -> None:
    path.write_bytes(b"Dear all,\n" * 500)


def of_other_features(path: Path) -> None:
    """Made with more levels of the image pyramid, and smaller steps between them."""
    write_site_map(path, replace(read_site_map(path).site, scale_factor=1.1, n_levels=12))


def by_a_guess(path: Path) -> None:
    """Made with a camera of which no focal length was known, and one tenth longer than now."""
    site = read_site_map(path).site
    camera = replace(CAMERA, fx=1.1 * CAMERA.fx, fy=1.1 * CAMERA.fy, assumed=True)
    write_site_map(path, replace(site, parts=(replace(site.parts[0], camera=camera),)))


def with_points_elsewhere(path: Path) -> None:
    """Its points a fifth further from its middle, its keyframes where they were."""
    site = read_site_map(path).site
    points = site.points._replace(positions=1.2 * site.points.positions)
    write_site_map(path, replace(site, points=points))


SPOILT = [
    cut, newer, letter, Path.unlink, of_other_features, by_a_guess, with_points_elsewhere,
]  # fmt: skip


@pytest.mark.parametrize("spoil", SPOILT)
def test_a_flight_goes_on_without_it_and_a_replay_ends(
    path: Path, spoil: Callable[[Path], None]
) -> None:
    assert not said(path, True)
    spoil(path)
    (warning,) = said(path, True)
    assert warning.what == MAP_NOT_USED and str(path) in warning.detail
    assert of_warning(warning.what) not in (None, OTHER())
    with pytest.raises(SiteMapError):
        said(path, False)


def test_a_guess_that_pixels_do_not_tell_apart_does_no_harm(path: Path) -> None:
    site = read_site_map(path).site
    for ratio, refused in ((1.0005, False), (1.02, True)):
        guess = replace(CAMERA, fx=ratio * CAMERA.fx, fy=ratio * CAMERA.fy, assumed=True)
        assert bool(wrong_metres(site, guess)) is refused
        assert not wrong_metres(site, replace(guess, assumed=False))


def test_a_damaged_one_is_used_in_part(path: Path) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.execute("UPDATE keyframe SET features = zeroblob(length(features)) WHERE id = 3")
        file.commit()
    for is_live in (True, False):
        (warning,) = said(path, is_live)
        assert warning.what == MAP_DAMAGED and "1 parts" in warning.detail
        assert of_warning(warning.what) not in (None, OTHER())
