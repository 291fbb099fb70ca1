"""Link bytes from before a flight, with which its recording begins."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from companion.daemon.recorder_notes import (
    LEAD_NS,
    MOST_IN_LEAD,
    MOST_LEAD_BYTES,
    RecorderNotes,
)
from companion.flight_notes import LinkBytes
from companion.timing.clock import FlightClock


class Recorded:
    """Flights that record what they take while one is current."""

    def __init__(self) -> None:
        self.current: object | None = None
        self.taken: list[LinkBytes] = []

    def take(self, note: LinkBytes) -> None:
        assert self.current is not None
        self.taken.append(note)


def begun() -> tuple[Recorded, RecorderNotes]:
    flights: Any = Recorded()
    link: Any = SimpleNamespace(port=SimpleNamespace(set_tap=lambda tap: None))
    watch: Any = None
    return flights, RecorderNotes(FlightClock(), flights, watch, link)


def recorded_of(reads: list[tuple[bytes, int]]) -> list[LinkBytes]:
    """What a flight records that begins with the last of these reads."""
    flights, notes = begun()
    for data, monotonic_ns in reads[:-1]:
        notes._on_bytes(False, data, monotonic_ns)
    flights.current = object()
    notes._on_bytes(False, *reads[-1])
    return flights.taken


def test_a_recording_begins_with_the_seconds_before_it() -> None:
    taken = recorded_of([(b"%d" % second, second * 1_000_000_000) for second in range(30)])
    assert [note.data for note in taken] == [b"%d" % second for second in range(19, 30)]
    assert taken[-1].t_ns - taken[0].t_ns == LEAD_NS


def test_the_lead_is_bounded_by_bytes_and_by_reads() -> None:
    large = recorded_of([(bytes(50_000), n) for n in range(100)])
    assert len(large) == MOST_LEAD_BYTES // 50_000
    assert large[-1].monotonic_ns == 99
    assert len(recorded_of([(b"x", n) for n in range(MOST_IN_LEAD + 7)])) == MOST_IN_LEAD


def test_what_was_recorded_counts_no_more() -> None:
    flights, notes = begun()
    for _ in range(3):
        flights.current = None
        notes._on_bytes(False, bytes(MOST_LEAD_BYTES - 1), 1)
        flights.current, flights.taken = object(), []
        notes._on_bytes(True, b"x", 2)
        assert [len(note.data) for note in flights.taken] == [MOST_LEAD_BYTES - 1, 1]
