"""Fuzzing of log and flight readers with damaged files: crashes, hangs, memory.

    python -m tests.bench.damaged_files SOURCE… [--seeds 100] [--limit-s 60] [--memory-mb 3000]

Every source, a log, a video, a bag or a folder, is cut, has bits flipped and stretches zeroed, for
each seed; each copy is read in a process of its own. Prints a line for each source; the exit status
is 1 where something was worse than refused. `--made DIR` writes small flights of every format
there first, from the sample, and takes them too.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.support.cameras.photos import write_photo
from tests.support.flights.bags import write_bag
from tests.support.flights.damage import KINDS, damage_source, in_limits, read_all
from tests.support.flights.sequences import (
    piece,
    write_euroc,
    write_flight_folder,
    write_kitti,
    write_posed_video,
    write_remode,
    write_tum_rgbd,
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sources", type=Path, nargs="*")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--limit-s", type=int, default=60)
    parser.add_argument("--memory-mb", type=int, default=3000)
    parser.add_argument("--made", type=Path)
    arguments = parser.parse_args()
    sources = [*arguments.sources, *(made(arguments.made) if arguments.made else [])]
    bad = 0
    for source in sources:
        bad += try_source(source, arguments)
    return 1 if bad else 0


def try_source(source: Path, arguments: argparse.Namespace) -> int:
    """Read damaged copies of a source; return how many were worse than refused."""
    began = time.monotonic()
    outcomes: Counter[str] = Counter()
    worst_s, worst_cpu_s, worst_mb, bad = 0.0, 0.0, 0.0, 0
    for seed in range(arguments.seeds):
        for kind in KINDS:
            with tempfile.TemporaryDirectory(dir=arguments.made) as place:
                copy = damage_source(source, Path(place) / "copy", kind, seed)
                one = time.monotonic()
                said, cpu_s, peak_mb = in_limits(
                    lambda copy=copy: read_all(copy),  # type: ignore[misc]
                    arguments.limit_s, arguments.memory_mb,
                )  # fmt: skip
                worst_s = max(worst_s, time.monotonic() - one)
                worst_cpu_s, worst_mb = max(worst_cpu_s, cpu_s), max(worst_mb, peak_mb)
            outcome = said.split(":")[0]
            outcomes[outcome] += 1
            if outcome not in ("read", "refused"):
                bad += 1
                print(f"  {source.name}, {kind} {seed}: {said[:1500]}", flush=True)
    counts = ", ".join(f"{outcome} {n}" for outcome, n in sorted(outcomes.items()))
    took_s = time.monotonic() - began
    print(
        f"{source.name}: {counts}; at most {worst_s:.1f} s, {worst_cpu_s:.1f} s of a processor and "
        f"{worst_mb:.0f} MB for one; {took_s:.0f} s for all",
        flush=True,
    )
    return bad


def made(folder: Path) -> list[Path]:
    """Small flights of every format."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    flown = piece().part(5)
    write_flight_folder(folder / "flight", flown)
    write_euroc(folder / "euroc", flown)
    write_tum_rgbd(folder / "tum", flown)
    kitti = write_kitti(folder / "kitti", flown)
    write_remode(folder / "remode", flown)
    write_posed_video(folder / "posed", flown)
    for kind, name in (("ros1", "flight.bag"), ("sqlite", "sqlite"), ("mcap", "mcap")):
        write_bag(folder / name, kind, flown)
    write_bag(folder / "pictures.bag", "ros1", flown, compressed=True)
    for kind, name in (("ros1", "packed.bag"), ("sqlite", "packed"), ("mcap", "packed_mcap")):
        write_bag(folder / name, kind, flown, packed=True)
    (folder / "photos").mkdir()
    for k in range(6):
        write_photo(
            folder / "photos" / f"a{k}.jpg", k, local=f"2025:11:01 12:26:{40 + k}",
            place=(47.0 + k * 1e-4, 8.5, 500.0),
        )  # fmt: skip
    names = ["flight", "euroc", "tum", "remode", "posed", "flight.bag", "sqlite", "mcap",
             "pictures.bag", "packed.bag", "packed", "packed_mcap", "photos"]  # fmt: skip
    return [*(folder / name for name in names), kitti]


if __name__ == "__main__":
    sys.exit(main())
