"""Findings of `companion doctor`: as a document, and in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, TextIO

from companion.config import Config
from companion.doctor.wanted import Finding
from drivers.mavlink.vehicle import Vehicle


@dataclass(slots=True)
class Examination:
    """Findings, and the parameters written."""

    vehicle: Vehicle
    where: str
    mode: str
    findings: list[Finding]
    n_examined: int
    comes: str = ""
    """Note on what the daemon hears of the autopilot; without one, the IMU it will ask for."""
    written: list[dict[str, Any]] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    """Parameters that the autopilot refused, in words."""
    not_stored: str = ""
    """Reason for which those written may be lost with the power; "" where they are not."""

    @property
    def blocking(self) -> list[Finding]:
        """Findings that prevent use of the pose."""
        return [finding for finding in self.findings if finding.blocking]

    @property
    def reboot_for(self) -> list[str]:
        """Parameters written that take effect after a reboot."""
        return [each["name"] for each in self.written if each["reboot"]]

    def settable(self, only: Collection[str] = ()) -> list[Finding]:
        """Findings that a parameter can be set for, of these names alone where any are given."""
        settable = [finding for finding in self.blocking if finding.set_to is not None]
        return [finding for finding in settable if not only or finding.name in only]


def document(found: Examination) -> dict[str, Any]:
    """The same for programs, as JSON has it."""
    return {
        "vehicle": dataclasses.asdict(found.vehicle),
        "link": found.where,
        "mode": found.mode,
        "n_examined": found.n_examined,
        "comes": found.comes,
        "in_the_way": [_plain(finding) for finding in found.blocking],
        "notes": [_plain(finding) for finding in found.findings if not finding.blocking],
        "written": found.written,
        "refused": found.refused,
        "not_stored": found.not_stored,
        "reboot_needed": bool(found.reboot_for),
    }


def _plain(finding: Finding) -> dict[str, Any]:
    document = dataclasses.asdict(finding)
    del document["blocking"]
    return document


def print_findings(found: Examination, config: Config, out: TextIO) -> None:
    """Print what stands in the way, and what is not judged."""
    print(f"{found.vehicle}, by {found.where}", file=out)
    if config.feedback.mode == "off":
        print("feedback.mode is off; examined for odometry", file=out)
    if found.comes:
        print(found.comes, file=out)
    if found.blocking:
        width = max(len(finding.name) for finding in found.blocking)
        print(f"\nThese stand in the way of {found.mode}:", file=out)
        for finding in found.blocking:
            value = "missing" if finding.value is None else f"is {_number(finding.value)}"
            wanted = f", wanted {finding.wanted}" if finding.wanted else ""
            print(f"  {finding.name:{width}}  {value}{wanted}", file=out)
            print(f"  {'':{width}}  {finding.why}", file=out)
    for finding in found.findings:
        if not finding.blocking and finding.value is not None:
            print(
                f"\nNot judged: {finding.name} is {_number(finding.value)}, wanted "
                f"{finding.wanted}; {finding.why}",
                file=out,
            )
    out.flush()


def print_outcome(found: Examination, write: bool, out: TextIO) -> None:
    """Print what was set, and what is left."""
    print(file=out)
    for each in found.written:
        print(f"{each['name']}: {_number(each['from'])} -> {_number(each['to'])}, read back",
              file=out)  # fmt: skip
    for refusal in found.refused:
        print(f"not set: {refusal}", file=out)
    if found.not_stored:
        print(f"not stored: {found.not_stored}", file=out)
    if found.reboot_for:
        print(f"Reboot the autopilot, for {', '.join(found.reboot_for)}", file=out)
    if not found.blocking:
        print(f"Nothing stands in the way of {found.mode} ({found.n_examined} examined)", file=out)
        return
    n = len(found.blocking)
    left = f"{counted(n, 'parameter')} {'stands' if n == 1 else 'stand'} in the way"
    if found.settable() and not write:
        left += "; `companion doctor --write` sets what can be set"
    print(left, file=out)


def _number(value: float) -> str:
    return f"{value:.7g}"


def counted(n: int, noun: str) -> str:
    """A number of things in words."""
    return f"{n} {noun}" + ("" if n == 1 else "s")
