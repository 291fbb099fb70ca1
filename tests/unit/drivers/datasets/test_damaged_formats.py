"""Some damaged copies of flights of every format; `tests.bench.damaged_files` tries hundreds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.flights.bags import write_bag
from tests.support.flights.damage import KINDS, damage_source, in_limits, read_all
from tests.support.flights.sequences import (
    Piece,
    piece,
    write_euroc,
    write_flight_folder,
    write_kitti,
    write_posed_video,
    write_remode,
    write_tum_rgbd,
)

WRITERS: dict[str, Callable[[Path, Piece], object]] = {
    "folder": write_flight_folder,
    "euroc": write_euroc,
    "tum": write_tum_rgbd,
    "kitti": write_kitti,
    "remode": write_remode,
    "posed": write_posed_video,
    "flight.bag": lambda path, flown: write_bag(path, "ros1", flown),
    "sqlite": lambda path, flown: write_bag(path, "sqlite", flown),
    "mcap": lambda path, flown: write_bag(path, "mcap", flown),
}
SEEDS = range(3)


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    place = tmp_path_factory.mktemp("flights")
    flown = piece().part(2)
    made = {}
    for name, write in WRITERS.items():
        inner = write(place / name, flown)
        made[name] = inner if isinstance(inner, Path) else place / name
    return made


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_copies_are_read_or_refused(
    flights: dict[str, Path], tmp_path: Path, name: str
) -> None:
    for seed in SEEDS:
        for kind in KINDS:
            copy = damage_source(flights[name], tmp_path / f"{kind}{seed}", kind, seed)
            said = read_all(copy)
            assert said.startswith(("read", "refused")), said


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_processes_with_limits() -> None:
    """What counts the outcomes tells them apart."""

    def hang() -> str:
        while True:
            pass

    def crash() -> str:
        raise KeyError("x")

    assert in_limits(lambda: "read: 3", 20, 4000).said == "read: 3"
    assert in_limits(crash, 20, 4000).said.startswith("crashed: Traceback")
    assert in_limits(hang, 1, 4000).said == "hung"
    assert in_limits(lambda: str(len(bytearray(8 << 30))), 20, 4000).said.startswith("memory")
