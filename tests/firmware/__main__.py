"""Trials by hand: the companion flown by the real firmwares in their simulators.

    ARDUCOPTER=…/arducopter PX4=…/px4 python -m tests.firmware EXPERIMENT … [--firmware px4]

Each trial is in real time, and wants the whole computer: firmware, camera and companion share two
cores. `--slowed 2` is for a computer too slow for it: time passes at half its rate for all of them.
All that happened is left under --out, a folder a trial; runs.json gathers all figures, and
index.html shows them.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import sys
import time
from pathlib import Path

from tests.firmware.experiments import EXPERIMENTS
from tests.firmware.figures import Figures, append_to
from tests.firmware.page import write_page
from tests.firmware.sent_poses import add_poses
from tests.firmware.slowed_time import run_again_slowed, slowed_by
from tests.firmware.trial import Conditions, Trial

FIRMWARES = {"arducopter": "ARDUCOPTER", "px4": "PX4"}


def fly(
    experiment: str, firmware: str, out: Path, conditions: Conditions, words: list[str]
) -> Figures:
    """One trial; its figures, which are added to runs.json."""
    flown, _ = EXPERIMENTS[experiment]
    binary = Path(os.environ[FIRMWARES[firmware]])
    folder = out / f"{experiment}-{firmware}-{time.strftime('%H%M%S')}"
    figures = Figures()
    print(f"{folder.name}: {conditions}", flush=True)
    with Trial(binary, folder, conditions, words) as trial:
        try:
            flown(trial, figures)
        finally:
            trial.mark("over")
            version = f"{trial.firmware.name} {trial.firmware.version()}"
    add_poses(figures, folder / "cable.tlog", trial.ground.true)
    told = {"folder": folder.name, "version": version, "seed": conditions.seed,
            "wind_m_s": conditions.wind_m_s, "look": conditions.look, "perfect": conditions.perfect,
            "slowed_by": slowed_by(), "parameters": dict(conditions.parameters)}  # fmt: skip
    append_to(out / "runs.json", experiment, firmware, told, figures.rows)
    write_page(out)
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("experiments", nargs="+", choices=list(EXPERIMENTS))
    parser.add_argument("--firmware", choices=list(FIRMWARES), default="arducopter")
    parser.add_argument("--out", type=Path, default=Path("out/firmware"))
    parser.add_argument("--seed", type=int)
    parser.add_argument("--wind", type=float, metavar="M_S", dest="wind_m_s")
    parser.add_argument("--pitch", type=float, metavar="DEG", dest="pitch_deg")
    parser.add_argument("--look")
    parser.add_argument("--perfect", action="store_true", default=None,
                        help="the truth is sent instead of the companion's poses")  # fmt: skip
    parser.add_argument("--backend")
    parser.add_argument("--parameter", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--slowed", type=float, default=1.0, metavar="FACTOR",
                        help="time passes slower by this factor (default 1)")  # fmt: skip
    parser.add_argument("--only", action="append", default=[], metavar="FAULT")
    options = parser.parse_args()
    missing = [each for each in (FIRMWARES[options.firmware],) if not os.environ.get(each)]
    if missing:
        sys.exit(f"${missing[0]} names no firmware built for its simulator")
    run_again_slowed(options.slowed, options.out)
    given = {
        each.name: getattr(options, each.name)
        for each in dataclasses.fields(Conditions)
        if getattr(options, each.name, None) is not None
    }
    pairs = (each.partition("=") for each in options.parameter)
    parameters = {name: float(value) for name, _, value in pairs}
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # its children end with it
    holds = True
    for name in options.experiments:
        usual = EXPERIMENTS[name][1]
        given["parameters"] = {**usual.parameters, **parameters}
        given["settings"] = (*usual.settings, *options.set)
        conditions = dataclasses.replace(usual, **given)
        words = [f"fault={each}" for each in options.only]
        holds &= fly(name, options.firmware, options.out, conditions, words).hold
    return 0 if holds else 1


if __name__ == "__main__":
    raise SystemExit(main())
