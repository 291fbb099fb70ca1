"""The scene of the page: what an exporter gives, only while somebody looks, flight after flight."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import cv2
import numpy as np
import pytest

from companion.geometry.transforms import Pose, Similarity
from companion.page import scene as scene_module
from companion.page.scene import Scene
from companion.streaming.item_store import ItemStore
from companion.streaming.items import (
    WHOLE,
    FlightItem,
    ImageItem,
    PathItem,
    PlacesItem,
    PointsItem,
    PoseItem,
    Shown,
)
from tests.support.waiting import until
from tests.unit.streaming.test_stream_link import serving, tell
from tests.unit.streaming.test_viewer_recording import CAMERA

WORLD = Similarity(2.0, np.eye(3), np.array([10.0, 20.0, -5.0]))
HERE = Similarity(1.0, np.eye(3), np.zeros(3))


@contextmanager
def looking(ports: list[int]) -> Iterator[Scene]:
    scene = Scene(lambda: ports[-1])
    with closing(scene):
        yield scene
    scene.join()


def fill(exporter: Any, flight_id: str, picture_grey: int) -> None:
    strip = np.array([[0, 0, 0], [1, 2, 0]], np.float32)
    points = np.array([[3, 4, 5]] * 40, np.float32)
    image = np.full((CAMERA.height, CAMERA.width, 3), picture_grey, np.uint8)
    for item in (
        FlightItem(flight_id, "", CAMERA),
        PlacesItem(1, {7: HERE}, WORLD),
        PathItem(1, 1, 7, strip),
        PointsItem(1, 7, WHOLE, points, np.full((40, 3), 200, np.uint8), np.ones(40, np.float32)),
        ImageItem(1, image, np.array([[10, 20], [30, 40]], np.float32)),
        PoseItem(2, Shown.TRACKING, Pose(np.eye(3), np.array([11.0, 22.0, -6.0])), 9, 80, 6.0, 1.5),
    ):
        tell(exporter, item)


def above(scene: Scene) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(scene.from_above())
    return found


def test_picture_and_map_are_those_of_the_exporter() -> None:
    with serving(ItemStore(1 << 20)) as (exporter, port), looking([port]) as scene:
        fill(exporter, "first", 90)
        until(lambda: scene.picture_after(-1) is not None)
        until(lambda: above(scene)["path"] and above(scene)["points"] and above(scene)["here"])
        told = above(scene)
        assert told["metric"] and told["path"] == [[1000, 2000, 1200, 2400]]
        assert told["here"][:2] == [1100, 2200] and told["height_m"] == 6.0
        north, east, colour = told["points"][:3]
        assert (north, east) == (pytest.approx(1600, abs=10), pytest.approx(2800, abs=10))
        assert [colour >> shift & 255 for shift in (16, 8, 0)] == pytest.approx([200] * 3, abs=9)
        picture = json.loads(scene.picture_after(-1) or b"")
        assert picture["n_found"] == 2 and len(picture["found"]) == 4
        jpeg = np.frombuffer(base64.b64decode(picture["jpeg"]), np.uint8)
        shown = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
        assert shown is not None and abs(int(shown.mean()) - 90) < 5
        assert scene.picture_after(picture["number"]) is None


def test_it_goes_on_with_the_next_flight_at_another_port() -> None:
    with (
        serving(ItemStore(1 << 20)) as (exporter, port),
        serving(ItemStore(1 << 20)) as (other, other_port),
    ):
        ports = [port]
        with looking(ports) as scene:
            fill(exporter, "first", 90)
            fill(other, "second", 200)
            until(lambda: above(scene)["path"])
            ports.append(other_port)
            until(lambda: above(scene)["path"] and other.report()["viewers"] == 1)
            until(lambda: exporter.report()["viewers"] == 0)


def test_nobody_is_asked_for_pictures_while_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(ItemStore(1 << 20)) as (exporter, port), looking([port]) as scene:
        fill(exporter, "first", 90)
        until(lambda: above(scene)["path"])
        assert exporter.report()["viewers"] == 1
        monkeypatch.setattr(scene_module, "LOOKED_S", 0.2)
        until(lambda: exporter.report()["viewers"] == 0)
