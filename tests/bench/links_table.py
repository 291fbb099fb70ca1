"""Link table: viewers on the ground over bad links, against the requirements. Needs root.

    python -m tests.bench.links_table --flight FOLDER [--log FILE] [--only NAME] [--json FILE]

It takes 14 minutes, and two more where there is no message log yet, on a machine that does nothing
else; the short form, of half a minute, is tests/live/test_thin_link.py.

A flight is replayed once into a message log, which is played to an exporter in real time, in a
network namespace, and watched from another over a thin link: rate by `tc tbf`, loss by nftables,
delay by a relay between two TUN devices. Delay and loss are those of either direction. Ages count
from when the exporter was given a message: what the tracker takes comes on top.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.config import Config
from tests.bench import viewers_and_pose
from tests.support.flights.message_log import write_message_log
from tests.support.processes.link_trial import Trial, fly
from tests.support.processes.two_namespaces import TwoNamespaces, why_not

SETTLE_S = 5.0
MARGIN_S = 1.0
HEAD = "| link | what | measured | asked | holds |\n|---|---|---|---|---|"
VIEWERS = "pose beside viewers"
Row = tuple[str, str, str, bool]
"""What, measured, asked, and whether that holds."""


@dataclass(frozen=True)
class Link:
    """A row of the table."""

    name: str
    kbit_s: float
    delay_ms: float
    loss: float
    seconds: float
    rows: Callable[[Trial], list[Row]]
    budget_kbit_s: float = 0.0
    from_s: float = 0.0
    until_s: float = 0.0
    """Between these the link is cut, or the viewer stopped."""
    stops_viewer: bool = False
    joins_s: float = 0.0
    """The viewer comes so late."""


def good(trial: Trial) -> list[Row]:
    return [
        pose_row(trial, 0.3),
        behind_row(trial, "coarse", 2.0),
        behind_row(trial, "fine", 2.0),
    ]


def fair(trial: Trial) -> list[Row]:
    worst = float(trial.behind_s("coarse", *span(trial)).max())
    return [
        pose_row(trial, 0.7), behind_row(trial, "coarse", 5.0),
        ("coarse cloud behind, most", f"{worst:.1f} s", "10 s", worst <= 10),
    ]  # fmt: skip


def poor(trial: Trial) -> list[Row]:
    at = sorted(t for t in trial.coarse.values() if t > trial.began_s + SETTLE_S)
    gap_s = float(np.diff([*at, trial.ended_s]).max()) if at else float("inf")
    told_gap_s = float(np.diff(sorted(trial.given.values())).max())
    most = max(rate for _, rate in trial.bytes_per_s[2:]) / 125
    return [
        pose_row(trial, 1.5),
        ("longest without new cloud", f"{gap_s:.1f} s ({told_gap_s:.1f} s where it is made)",
         "grows all the time", gap_s < told_gap_s + 5),
        ("most in a second, of 400 kbit/s", f"{most:.0f} kbit/s", "440 kbit/s", most <= 440),
    ]  # fmt: skip


def outage(trial: Trial) -> list[Row]:
    back_s = trial.began_s + CUT[1]
    fresh = [at - back_s for at, t in trial.poses if at > back_s and t > back_s - 1.0]
    missing = [k for k, t in trial.given.items() if t < back_s]
    coarse_s = max((trial.coarse.get(k, np.inf) for k in missing), default=back_s) - back_s
    before, after = memory_mib(trial, CUT[0] - 10, CUT[0]), memory_mib(trial, CUT[1], CUT[1] + 15)
    first = fresh[0] if fresh else np.inf
    return [
        ("state after return", f"{first:.1f} s", "2 s", first <= 2),
        ("coarse map after return", f"{coarse_s:.1f} s", "10 s", coarse_s <= 10),
        ("exporter's memory", f"{before:.0f} to {after:.0f} MiB", "flat", after < before + 10),
    ]


def stopped(trial: Trial) -> list[Row]:
    before, after = memory_mib(trial, 5, STOP[0]), memory_mib(trial, STOP[1] - 10, STOP[1])
    sent = [n for at, n in trial.bytes_per_s if STOP[0] + 5 < at - trial.began_s < STOP[1]]
    ages = trial.pose_age_s(trial.began_s + STOP[1] + 5, trial.ended_s - MARGIN_S)
    return [
        ("slowest call of the flight's thread", f"{trial.slowest_take_ms:.1f} ms", "-", True),
        ("exporter's memory", f"{before:.0f} to {after:.0f} MiB", "flat", after < before + 10),
        ("sent meanwhile", f"{max(sent) / 125:.0f} kbit/s at most", "-", True),
        ("pose once it goes on, p95", f"{np.percentile(ages, 95):.2f} s", "-", True),
    ]


def late(trial: Trial) -> list[Row]:
    before = [k for k, t in trial.given.items() if t < trial.joined_s]
    took_s = max((trial.coarse.get(k, np.inf) for k in before), default=np.inf) - trial.joined_s
    asked_s = 5.0
    return [(f"coarse map of {len(before)} views there", f"{took_s:.1f} s", f"{asked_s:g} s",
             took_s <= asked_s)]  # fmt: skip


def late_and_thin(trial: Trial) -> list[Row]:
    """Newest first: what is made meanwhile does not wait for all that was before."""
    asked_s = 5.0
    fresh = [trial.coarse.get(k, np.inf) - t for k, t in trial.given.items()
             if trial.joined_s + 1.0 < t < trial.ended_s - asked_s]  # fmt: skip
    worst = max(fresh, default=np.inf)
    before = [k for k, t in trial.given.items() if t < trial.joined_s]
    there = [k for k in before if k in trial.coarse]
    return [
        ("new views there", f"{worst:.1f} s", f"{asked_s:g} s", worst <= asked_s),
        ("views from before, there at the end", f"{len(there)} of {len(before)}", "-", True),
    ]  # fmt: skip


CUT, STOP = (60.0, 90.0), (20.0, 80.0)
LINKS = (
    Link("20 Mbit/s, 10 ms", 20_000, 10, 0.0, 60, good),
    Link("2 Mbit/s, 60 ms, 2 % loss", 2_000, 60, 0.02, 60, fair),
    Link("500 kbit/s, 150 ms, 5 % loss", 500, 150, 0.05, 60, poor, budget_kbit_s=400),
    Link("30 s outage at minute 1", 2_000, 60, 0.0, 112, outage, from_s=CUT[0], until_s=CUT[1]),
    Link("viewer stopped for 60 s", 20_000, 10, 0.0, 100, stopped, from_s=STOP[0],
         until_s=STOP[1], stops_viewer=True),
    Link("joins after a minute, 20 Mbit/s", 20_000, 10, 0.0, 80, late, joins_s=60.0),
    Link("joins after a minute, 500 kbit/s, 5 % loss", 500, 150, 0.05, 90, late_and_thin,
         budget_kbit_s=400, joins_s=60.0),
)  # fmt: skip


def span(trial: Trial) -> tuple[float, float]:
    """Of a trial, the part that counts."""
    return trial.began_s + SETTLE_S, trial.ended_s - MARGIN_S


def pose_row(trial: Trial, asked_s: float) -> Row:
    p95 = float(np.percentile(trial.pose_age_s(*span(trial)), 95))
    return "pose on screen, p95", f"{p95:.2f} s old", f"{asked_s} s", p95 <= asked_s


def behind_row(trial: Trial, level: str, asked_s: float) -> Row:
    p95 = float(np.percentile(trial.behind_s(level, *span(trial)), 95))
    drawn = len(getattr(trial, level))
    text = f"{p95:.1f} s ({drawn} of {len(trial.given)} views)"
    return f"{level} cloud behind, p95", text, f"{asked_s:g} s", p95 <= asked_s


def memory_mib(trial: Trial, since_s: float, until_s: float) -> float:
    """Most that the exporter had between two times since the start."""
    return max(m for at, m in trial.exporter_mib if since_s <= at - trial.began_s <= until_s)


def measured(link: Link, log: Path) -> list[Row]:
    """The rows of one link."""

    def meanwhile(now_s: float, ground: subprocess.Popen[bytes]) -> None:
        away = bool(link.until_s) and link.from_s <= now_s < link.until_s
        if link.stops_viewer:
            ground.send_signal(signal.SIGSTOP if away else signal.SIGCONT)
        else:
            air.cut(away)

    with (
        TwoNamespaces(link.kbit_s, link.delay_ms, link.loss) as air,
        tempfile.TemporaryDirectory() as folder,
    ):
        trial = fly(
            air, log, Path(folder), link.seconds, link.budget_kbit_s, meanwhile, link.joins_s
        )
    rate = sum(n for _, n in trial.bytes_per_s) / len(trial.bytes_per_s) / 125
    return [*link.rows(trial), ("on the air, mean", f"{rate:.0f} kbit/s", "-", True)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--flight", type=Path, help="folder of the flight")
    parser.add_argument("--log", type=Path, help="the message log; made where it is missing")
    parser.add_argument("--only", help="links whose name has this in it")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--rounds", type=int, default=3, help="of the pose beside viewers")
    arguments = parser.parse_args()
    reason = why_not()
    if reason:
        print(f"links_table: {reason}", file=sys.stderr)
        return 2
    log = arguments.log or Path(tempfile.mkdtemp()) / "flight.log"
    if not log.exists():
        if arguments.flight is None:
            parser.error("--flight is missing: there is no message log yet")
        write_message_log(arguments.flight, log, Config())
    table: dict[str, list[Row]] = {}
    print(HEAD)
    for link in LINKS:
        if not arguments.only or arguments.only in link.name:
            table[link.name] = measured(link, log)
            print(as_text(link.name, table[link.name]), flush=True)
    if not arguments.only or arguments.only in VIEWERS:
        found = viewers_and_pose.measured(None, arguments.rounds)
        table[VIEWERS] = viewers_and_pose.rows_of(found)
        print(as_text(VIEWERS, table[VIEWERS]), flush=True)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(table, indent=1))
    asked = [row for rows in table.values() for row in rows if row[2] != "-"]
    n_held = sum(row[3] for row in asked)
    print(f"\n{n_held} of {len(asked)} rows hold that are asked for")
    return 0 if n_held == len(asked) else 1


def as_text(name: str, rows: list[Row]) -> str:
    """Rows of the table in Markdown."""
    verdicts = [("-" if asked == "-" else "yes" if holds else "NO") for _, _, asked, holds in rows]
    return "\n".join(
        f"| {name} | {what} | {value} | {asked} | {verdict} |"
        for (what, value, asked, _), verdict in zip(rows, verdicts, strict=True)
    )


if __name__ == "__main__":
    sys.exit(main())
