"""Measurements of `depth`."""

from __future__ import annotations

from dataclasses import dataclass

from tests.bench.accuracy.depth_accuracy import Accuracy


@dataclass(frozen=True, slots=True)
class AfterFrames:
    """State after some frames; `ms_per_frame` is wall time of updates and result."""

    frames: int
    still_updated: float
    """Share of the pixels."""
    ms_per_frame: float
    converged: Accuracy
    all_pixels: Accuracy


@dataclass(frozen=True, slots=True)
class AtThreshold:
    """Result for one least correlation of a matching image."""

    min_zncc: float
    converged: Accuracy


@dataclass(frozen=True, slots=True)
class Timed:
    """One run over all frames: `update_s` for them, `finish_s` for the regularised result."""

    name: str
    update_s: float
    finish_s: float
    cpu_s: float
    converged: Accuracy
    all_pixels: Accuracy

    @property
    def wall_s(self) -> float:
        """Seconds for updates and result."""
        return self.update_s + self.finish_s


@dataclass(frozen=True, slots=True)
class ReferenceAsUsed:
    """One reference with its own depth range, before and after the consensus with others."""

    reference: int
    alone_converged: Accuracy
    alone_all: Accuracy
    converged: Accuracy
    all_pixels: Accuracy


@dataclass(frozen=True, slots=True)
class AsUsed:
    """Result of `companion depth`: own depth ranges, all references.

    `rows` are the references that have truth, `n_references` is the number of all. Times are per
    reference, over all, with reading of images and search for ranges. `refused` is the reason where
    there is no result, else empty.
    """

    n_references: int
    wall_s: float
    cpu_s: float
    rows: tuple[ReferenceAsUsed, ...]
    refused: str = ""


@dataclass(frozen=True, slots=True)
class DepthBench:
    """All measurements; `searched` of `frames` images were searched for one reference."""

    dataset: str
    device: str
    width: int
    height: int
    frames: int
    searched: int
    runs: tuple[Timed, ...]
    kernel_ms: dict[str, float]
    after_frames: tuple[AfterFrames, ...]
    serial_after_frames: tuple[AfterFrames, ...]
    thresholds: tuple[AtThreshold, ...]
    as_used: AsUsed

    @property
    def speed_up(self) -> float | None:
        """Wall time of the serial reference over ours; None where it was left out."""
        return self.runs[1].wall_s / self.runs[0].wall_s if len(self.runs) > 1 else None
