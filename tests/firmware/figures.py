"""Figures of a trial: what was measured, what is asked, and whether it holds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from companion.geometry.transforms import Array


@dataclass(frozen=True)
class Figure:
    """One row. `at_most` None: nothing is asked of it, it is told."""

    name: str
    value: float | None
    unit: str
    at_most: float | None = None
    note: str = ""

    @property
    def holds(self) -> bool | None:
        """Whether it is as asked; None where nothing is."""
        if self.at_most is None:
            return None
        return self.value is not None and self.value <= self.at_most

    def __str__(self) -> str:
        value = "none" if self.value is None else f"{self.value:.2f} {self.unit}".rstrip()
        asked = "" if self.at_most is None else f" (asked {self.at_most:g})"
        verdict = {None: "    ", True: "ok  ", False: "MISS"}[self.holds]
        return f"{verdict} {self.name}: {value}{asked} {self.note}".rstrip()


@dataclass
class Figures:
    """Those of one trial, in order."""

    rows: list[Figure] = field(default_factory=list)

    def add(
        self, name: str, value: float | None, unit: str = "", at_most: float | None = None,
        note: str = "",
    ) -> None:  # fmt: skip
        """One more, printed as it comes."""
        self.rows.append(Figure(name, None if value is None else float(value), unit, at_most, note))
        print(f"        {self.rows[-1]}", flush=True)

    def add_true(self, name: str, holds: bool, note: str = "") -> None:
        """What must be so."""
        self.add(name, 0.0 if holds else 1.0, "failures", 0.0, note)

    @property
    def hold(self) -> bool:
        """Whether all are as asked."""
        return all(each.holds is not False for each in self.rows)


def percentile(values: Array, share: float) -> float | None:
    """None of nothing."""
    return float(np.percentile(values, share)) if len(values) else None


def strayed_m(places_m: Array, from_m: Array) -> tuple[Array, Array]:
    """How far places (N, 3) are from one, level and up or down."""
    off = places_m - from_m
    return np.linalg.norm(off[:, :2], axis=1), np.abs(off[:, 2])


def append_to(path: Path, experiment: str, firmware: str, told: dict[str, Any],
              rows: Sequence[Figure]) -> list[dict[str, Any]]:  # fmt: skip
    """Add a run to a JSON of runs; all that are in it."""
    runs: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    figures = [asdict(each) | {"holds": each.holds} for each in rows]
    run = {"experiment": experiment, "firmware": firmware, **told, "figures": figures}
    runs.append(run)
    path.write_text(json.dumps(runs, indent=1))
    return runs
