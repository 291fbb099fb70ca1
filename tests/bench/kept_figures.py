"""Speed of what computes, beside what is kept of the same machine; `make bench`.

    python -m tests.bench.kept_figures [--short] [--keep]

Figures are processor milliseconds of the threads that do the work. Before and after each round a
yardstick is measured, fixed work of numpy and OpenCV; figures are compared by their ratio to it,
so that a slower clock or a busy neighbour does not pass for a slower program. Of the rounds the
fastest counts, and the spread is shown. The first run on a machine is kept, by the processor's
model and the number of cores, in $XDG_CACHE_HOME/companion/bench; --keep replaces it. One that is
more than 15 % slower is a warning, never an error.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(variable, "1")  # as the program does, before numpy loads

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from companion.app.computer_speed import localised  # noqa: E402
from companion.compute.device_verdict import processor  # noqa: E402
from companion.config import DepthConfig  # noqa: E402
from companion.dense.engine import DepthEngine  # noqa: E402
from companion.dense.opencl import devices_of, open_device, platform_names  # noqa: E402
from companion.dense.view_selection import Intrinsics  # noqa: E402
from tests.bench.depth_kernels import FOCAL_PX, SIZE, keyframe, views  # noqa: E402

SLOWER = 1.15
ROUNDS, SHORT_ROUNDS = 5, 2
N_KEYFRAMES = 5
FLIGHT = Path(__file__).parents[2] / "sample/survey"
Figures = dict[str, float]


def yardstick_ms() -> float:
    """Fastest of some times of fixed work: sorting, a product of matrices, a blur."""
    random = np.random.default_rng(1)
    numbers, matrix = random.random(200_000), random.random((200, 200))
    image = random.integers(0, 256, (480, 640)).astype(np.uint8)

    def work() -> None:
        np.sort(numbers)
        for _ in range(4):
            matrix @ matrix
            cv2.GaussianBlur(image, (0, 0), 3.0)

    return min(_thread_ms(work) for _ in range(10))


def _thread_ms(work: Callable[[], object]) -> float:
    began_s = time.thread_time()
    work()
    return (time.thread_time() - began_s) * 1e3


def of_localisation() -> Figures:
    """The sample flight's first 200 frames."""
    frames, keyframes, _ = localised()
    return {
        "localisation: frame, median": float(np.median(frames)),
        "localisation: frame, 95th percentile": float(np.percentile(frames, 95)),
        "localisation: keyframe with mapping": float(np.median(keyframes)),
    }


def of_depth(stride: int) -> Figures:
    """A keyframe's dense depth, by the time of all threads of this process."""
    listed = [each for i in range(len(platform_names())) for each in devices_of(i)]
    camera = Intrinsics(FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2)
    config = DepthConfig(stride=stride)
    engine = DepthEngine(open_device(listed[0]), *SIZE, camera, config, eager=False)
    reference, others = views()
    keyframe(engine, reference, others)  # kernels are compiled
    times = []
    for _ in range(N_KEYFRAMES):
        began_s = time.process_time()
        keyframe(engine, reference, others)
        times.append((time.process_time() - began_s) * 1e3)
    return {f"dense map: keyframe, stride {stride}": min(times)}


def of_replay(stop_s: int) -> Figures:
    """A replay of the sample with everything, by the time of all its processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as out:
        subprocess.run(
            [sys.executable, "-m", "companion", "replay", FLIGHT, "--stop", str(stop_s),
             "--out", out],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {f"replay of the sample's first {stop_s} s": spent_s * 1e3}


def measured(rounds: int, short: bool) -> dict[str, list[float]]:
    """Ratio of each figure to the yardstick, of each round; the yardstick itself in ms."""
    parts: list[Callable[[], Figures]] = [of_localisation, lambda: of_depth(2)]
    if not short:
        parts += [lambda: of_depth(1), lambda: of_replay(1), lambda: of_replay(20)]
    ratios: dict[str, list[float]] = defaultdict(list)
    for _ in range(rounds):
        for part in parts:
            before_ms = yardstick_ms()
            found = part()
            yard_ms = 0.5 * (before_ms + yardstick_ms())
            for name, ms in found.items():
                ratios[name].append(ms / yard_ms)
            ratios["yardstick"].append(yard_ms)
    return dict(ratios)


def verdict(
    ratios: Mapping[str, list[float]], kept: Mapping[str, float]
) -> tuple[list[str], list[str]]:
    """A line for each figure, and warnings: figures slower than what is kept of them."""
    yard_ms = min(ratios["yardstick"])
    lines, warnings = [f"{'processor ms':45}{'fastest':>9}{'spread':>9}{'kept':>9}{'ratio':>8}"], []
    for name, found in ratios.items():
        if name == "yardstick":
            continue
        best, before = min(found), kept.get(name)
        spread = 100 * (max(found) / best - 1)
        row = f"{name:45}{best * yard_ms:9.1f}{spread:7.0f} %"
        if before is not None:
            row += f"{before * yard_ms:9.1f}{best / before:8.2f}"
            if best > SLOWER * before:
                slower = 100 * (best / before - 1)
                warnings.append(
                    f"{name}: {slower:.0f} % slower than kept; its rounds differ by {spread:.0f} %"
                )
        lines.append(row)
    return lines, warnings


def machine() -> str:
    """Name for a file: the processor and the number of cores."""
    models = [line for line in processor() if line.startswith(("model name", "CPU part"))]
    text = "-".join([os.uname().machine, *models, f"{os.cpu_count()} cores"])
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--short", action="store_true", help="what takes less than a minute")
    parser.add_argument("--keep", action="store_true", help="keep these figures instead")
    options = parser.parse_args()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    path = cache / "companion/bench" / f"{machine()}.json"
    kept: Figures = json.loads(path.read_bytes()) if path.exists() else {}
    ratios = measured(SHORT_ROUNDS if options.short else ROUNDS, options.short)
    lines, warnings = verdict(ratios, kept)
    print("\n".join(lines))
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    best = {name: min(found) for name, found in ratios.items() if name != "yardstick"}
    wanted = {**kept, **best} if options.keep else {**best, **kept}
    if wanted != kept:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(wanted, indent=1))
    print(f"kept: {path}")


if __name__ == "__main__":
    main()
