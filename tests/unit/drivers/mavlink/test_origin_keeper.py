"""Origin of an autopilot that has none, with and without a GPS that may still find one."""

from __future__ import annotations

import asyncio
import contextlib
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import FeedbackConfig
from companion.geometry.geodesy import GeoOrigin
from drivers.mavlink import origin_keeper
from drivers.mavlink.origin_keeper import PATIENCE, PATIENCE_SEARCHING, SEARCHING, OriginKeeper
from drivers.telemetry.mavlink_samples import searches

HERE = GeoOrigin(47.397742, 8.545594, 489.0)


class Link:
    """An autopilot in reach; `looked` counts how often its origin was asked for."""

    def __init__(self, gps_searches: bool) -> None:
        self.alive, self.vehicle = True, None
        self.gps_searches, self.looked = gps_searches, 0
        self.given: list[GeoOrigin] = []

    @property
    def samples(self) -> Any:
        return SimpleNamespace(positions=self, gps_searches=self.gps_searches)

    @property
    def origin(self) -> GeoOrigin | None:
        self.looked += 1
        return None

    @property
    def commands(self) -> Any:
        return self

    async def at(self, _command: int, place: GeoOrigin) -> None:
        self.given.append(place)

    def send(self, _message: Any) -> None:
        pass


def looks_until_given(
    monkeypatch: pytest.MonkeyPatch, link: Link, believes_gps: bool = True
) -> tuple[int, list[str]]:
    """How often it was looked before an origin was given, and what was said."""
    monkeypatch.setattr(origin_keeper, "LOOK_EVERY_S", 0.0)
    said: list[str] = []
    keeper = OriginKeeper(
        FeedbackConfig(), link, said.append, lambda: True, lambda: HERE, lambda: believes_gps  # type: ignore[arg-type]
    )  # fmt: skip

    async def until_given() -> None:
        task = asyncio.create_task(keeper.run())
        while not link.given:
            await asyncio.sleep(0)
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    asyncio.run(asyncio.wait_for(until_given(), 20))
    return link.looked, said


def test_an_autopilot_without_an_origin_is_given_one(monkeypatch: pytest.MonkeyPatch) -> None:
    link = Link(gps_searches=False)
    looked, said = looks_until_given(monkeypatch, link)
    assert (looked, link.given) == (PATIENCE, [HERE])
    assert said == ["the autopilot had no origin and is given one: 47.3977420 8.5455940 at 489.0 m"]


def test_it_is_left_to_a_gps_that_sees_satellites(monkeypatch: pytest.MonkeyPatch) -> None:
    looked, said = looks_until_given(monkeypatch, Link(gps_searches=True))
    assert looked == PATIENCE_SEARCHING
    assert said[0] == SEARCHING and len(said) == 2


def test_a_gps_that_is_not_believed_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    looked, _ = looks_until_given(monkeypatch, Link(gps_searches=True), believes_gps=False)
    assert looked == PATIENCE


@pytest.mark.parametrize(
    ("fix_type", "n_satellites", "expected"),
    [(0, 0, False), (1, 0, False), (1, 5, True), (2, 4, True), (3, 9, False), (1, 255, False)],
)
def test_a_receiver_searches(fix_type: int, n_satellites: int, expected: bool) -> None:
    message = mavlink.MAVLink_gps_raw_int_message(
        0, fix_type, 0, 0, 0, 65535, 65535, 65535, 65535, n_satellites
    )
    assert searches(message) is expected
