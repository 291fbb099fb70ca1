"""The map of an earlier flight in the world of now: placed, contradicted, said."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from companion.estimation.georeference.trajectory_alignment import Scale
from companion.estimation.site.site_of_flight import site_of_flight
from companion.estimation.site.site_use import (
    CONTRADICTED,
    DOUBTED,
    LOCATED,
    OTHER_CAMERA,
    SiteUse,
    world_from_site,
)
from companion.geometry.camera import Distortion
from companion.geometry.geodesy import GeoOrigin, geodetic_from_ned, ned_from_geodetic
from companion.geometry.transforms import Similarity, yaw_rotation
from companion.messages import Georeference
from companion.slam.loop.loop_closure import LoopClosure
from companion.slam.loop.relocalizer import Relocalised
from companion.slam.map.site_map import SiteMap
from companion.slam.map.sparse_map import SlamMap
from tests.support.reference.synthetic_map import CAMERA, Ground, flown, mapped

ORIGIN = GeoOrigin(47.1, 8.5, 400.0)
SCALE = 2.5
TO_WORLD = Similarity(SCALE, yaw_rotation(0.4), np.array([10.0, -20.0, -30.0]))
BY_GPS = Georeference(TO_WORLD, 0.01, 0.02, "gps", 9, 0.5)


@pytest.fixture(scope="module")
def slam_map() -> SlamMap:
    path = [flown(p) for p in np.linspace((-6, 0), (6, 0), 10)]
    return mapped(Ground(np.random.default_rng(5)), path, Similarity.identity())


@pytest.fixture(scope="module")
def site(slam_map: SlamMap) -> SiteMap:
    made = site_of_flight([(slam_map, BY_GPS)], CAMERA, "morning", ORIGIN, None)
    assert made is not None
    return made


def found_in(use: SiteUse, slam_map: SlamMap, scale: float = 1.0) -> LoopClosure:
    """The same keyframe, found where it is, in a map of now whose unit is `scale` times longer."""
    there = use.slam_map.keyframes[4]
    nothing = np.zeros(0, np.int64)
    here_from_there = Similarity(1.0 / (SCALE * scale), np.eye(3), np.zeros(3))
    return LoopClosure(
        slam_map.keyframes[4], use.slam_map,
        Relocalised(there.camera_from_map, nothing, nothing, there), here_from_there,
    )  # fmt: skip


def test_georeferences_of_a_flight_are_kept(site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, ORIGIN)
    assert use.georeference.has_origin
    assert use.georeference.world_from_map.scale == 1.0
    assert "morning" in use.georeference.method
    assert not use.warnings(0)


def test_a_flight_without_origin_has_that_of_the_map(slam_map: SlamMap, site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, None)
    assert use.georeference.has_origin
    slam_map.held = frozenset()
    merged = replace(use.georeference, has_origin=False)  # as in the air, without an origin
    here = use.slam_map
    again = site_of_flight([(here, merged)], CAMERA, "evening", None, site.account)
    assert again is not None and again.georeference.origin == ORIGIN
    assert again.revision == 2 and [p.flight for p in again.parts] == ["morning"]
    assert [k.t_ns for k in again.keyframes] == [k.t_ns for k in site.keyframes]


def test_worlds_of_two_origins_agree_on_a_place() -> None:
    other = GeoOrigin(47.103, 8.495, 410.0)
    to_other = world_from_site(ORIGIN, other)
    place = np.array([120.0, -80.0, -25.0])
    latitude, longitude, altitude = geodetic_from_ned(place[None], ORIGIN)[0]
    assert to_other.apply(place) == pytest.approx(
        ned_from_geodetic(latitude, longitude, altitude, other), abs=1e-3
    )


def test_a_place_20_m_off_is_said_and_not_used(slam_map: SlamMap, site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, ORIGIN)
    found = found_in(use, slam_map)
    there = found.relocalised.camera_from_map.inverse().translation
    assert use.allowed(found, BY_GPS, there + [15.0, 0, 0])
    assert not use.warnings(0)
    assert not use.allowed(found, BY_GPS, there + [25.0, 0, 0])
    (warning,) = use.warnings(0)
    assert warning.what == CONTRADICTED and "25 m" in warning.detail and not warning.good
    assert not use.allowed(found, BY_GPS, there + [25.0, 0, 0])
    assert not use.warnings(0)  # once


def test_another_scale_is_said_and_not_used(slam_map: SlamMap, site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, ORIGIN)
    assert use.allowed(found_in(use, slam_map, 1.05), BY_GPS, None)
    assert not use.allowed(found_in(use, slam_map, 1.5), BY_GPS, None)
    (warning,) = use.warnings(0)
    assert warning.what == CONTRADICTED and "50 %" in warning.detail
    uncertain = replace(BY_GPS, sigma_scale=0.2)
    assert use.allowed(found_in(use, slam_map, 1.5), uncertain, None)
    assert use.allowed(found_in(use, slam_map, 1.5), None, None)


def test_a_scale_that_accelerometers_contradict_later_is_said_and_given_up(site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, ORIGIN)
    use.locate()
    use.warnings(0)
    units = use.georeference.world_from_map.scale
    for ratio, sigma in ((1.05, 0.01), (1.3, 0.1), (1.3, 0.01), (1.3, 0.01), (1.0, 0.01)):
        assert not use.compare_scale(use.georeference, Scale(units / ratio, sigma, "a", 9))
    for n in range(3):
        off = Scale(units / 1.3, 0.01, "accelerometers", 9)
        assert use.compare_scale(use.georeference, off) == (n == 2)
        assert not use.compare_scale(use.georeference, off), "one counts once"
    (warning,) = use.warnings(0)
    assert warning.what == CONTRADICTED and "30 % from that by acc" in warning.detail
    assert use.left.georeference.origin is None and not use.georeference.has_origin


def test_places_about_unknown_origins_are_not_compared(slam_map: SlamMap, site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, None)
    assert use.allowed(found_in(use, slam_map), None, np.array([5000.0, 0, 0]))


def test_in_the_air_a_map_has_a_place_once_the_origin_is_known(
    slam_map: SlamMap, site: SiteMap
) -> None:
    use = SiteUse(site, CAMERA, None, is_live=True)
    assert not use.georeference.has_origin
    found = found_in(use, slam_map)
    assert use.allowed(found, None, None)
    there = found.relocalised.camera_from_map.inverse().translation
    assert not use.allowed(found, None, there)
    origin = GeoOrigin(47.1001, 8.5, 400.0)
    moved = use.set_origin(origin)
    assert moved is not None and use.set_origin(ORIGIN) is None
    assert use.georeference.has_origin
    assert use.allowed(found, None, moved.apply(there))
    assert moved.translation[0] == pytest.approx(-11.1, abs=0.1)


def test_satellites_that_contradict_later_are_said(site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, ORIGIN)
    offs_m = (0.0, 21.0, 30.0, 19.0, 21.0, 22.0)  # one leap of a filter is none
    assert not any(use.compare(np.zeros(3), np.array([off_m, 0.0, 0.0])) for off_m in offs_m)
    assert not use.compare(np.zeros(3), None)
    assert not use.warnings(5) and use.georeference.has_origin
    assert use.compare(np.zeros(3), np.array([0.0, 0.0, 23.0]))
    (warning,) = use.warnings(5)
    assert warning.what == DOUBTED and "23 m" in warning.detail
    assert not use.georeference.has_origin
    assert not use.compare(np.zeros(3), np.array([0.0, 0.0, 24.0]))  # once


def test_a_contradicted_map_is_left_without_a_place(site: SiteMap) -> None:
    """Whoever flies in it next is not told a place that satellites have contradicted."""
    use = SiteUse(site, CAMERA, ORIGIN)
    assert use.left.georeference.origin == ORIGIN
    for _ in range(3):
        use.compare(np.zeros(3), np.array([0.0, 25.0, 0.0]))
    again = site_of_flight([(use.slam_map, use.georeference)], CAMERA, "noon", ORIGIN, use.left)
    assert again is not None and again.georeference.origin is None
    assert again.revision == 2 and again.georeference.sigma_scale == site.georeference.sigma_scale


def test_another_camera_is_said(site: SiteMap) -> None:
    use = SiteUse(site, replace(CAMERA, fx=600.0, fy=600.0), ORIGIN)
    (warning,) = use.warnings(7)
    assert warning.what == OTHER_CAMERA and "500" in warning.detail and "600" in warning.detail
    longer = use.slam_map.base_distance[: use.slam_map.n_points]
    np.testing.assert_allclose(longer, 1.2 * site.points.base_distance)


@pytest.mark.parametrize(
    "changed",
    [
        {"width": CAMERA.width + 160},
        {"distortion": Distortion.EQUIDISTANT, "coefficients": (0.1, 0.0, 0.0, 0.0)},
    ],
)
def test_another_picture_or_lens_of_the_same_focal_length_is_said(
    site: SiteMap, changed: dict[str, Any]
) -> None:
    (warning,) = SiteUse(site, replace(CAMERA, **changed), ORIGIN).warnings(7)
    assert warning.what == OTHER_CAMERA and "morning" in warning.detail
    assert not SiteUse(site, replace(CAMERA, fx=502.0, readout_ms=5.0), ORIGIN).warnings(7)


def test_being_located_is_good_news(site: SiteMap) -> None:
    use = SiteUse(site, CAMERA, ORIGIN)
    use.locate()
    (warning,) = use.warnings(9)
    assert warning.what == LOCATED and warning.good and use.located
