"""Summary of a recording; of a whole file only its end is read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from drivers.recording.growing_file import is_growing
from drivers.recording.mcap_file import McapFile
from drivers.recording.mcap_scan import scan, summary
from drivers.recording.recording_topics import PICTURES
from drivers.recording.repair import was_cut

State = Literal["whole", "repaired", "cut short", "damaged", "being recorded"]


@dataclass(frozen=True, slots=True)
class FlightSummary:
    """Summary of one recording; times in ns of the flight's clock, 0 where it is empty."""

    path: Path
    state: State
    n_bytes: int
    start_ns: int
    stop_ns: int
    counts: dict[str, int] = field(default_factory=dict)
    """Messages by topic."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    n_lost_bytes: int = 0
    n_lost_places: int = 0

    @property
    def n_pictures(self) -> int:
        """Number of images."""
        return sum(n for topic, n in self.counts.items() if topic in PICTURES)

    @property
    def duration_s(self) -> float:
        """Seconds from its first message to its last."""
        return (self.stop_ns - self.start_ns) * 1e-9


def summarise(path: Path, on_progress: Callable[[int], None] | None = None) -> FlightSummary:
    """Summary of a recording; changes nothing.

    With `on_progress`, which takes the bytes read, every chunk is read and its checksum verified.
    FlightError where it is no MCAP file.
    """
    with McapFile(path) as file:
        found = (None if on_progress is not None else summary(file)) or scan(file, on_progress)
        growing = is_growing(file.fd)
        n_bytes = file.size
    contents = found.contents
    state: State = "whole"
    if growing:
        state = "being recorded"
    elif not found.whole:
        state = "cut short"
    elif found.n_lost_bytes:
        state = "damaged"
    elif was_cut(found):
        state = "repaired"
    counts = {
        contents.channels[number].topic: n
        for number, n in sorted(contents.counts.items())
        if n and number in contents.channels
    }
    return FlightSummary(
        path, state, n_bytes, contents.start_ns, contents.stop_ns, counts, found.metadata,
        found.attachments, found.n_lost_bytes, found.n_lost_places,
    )  # fmt: skip
