"""Two hours of one flight with a process per stage: growth of the pose's cost and of memory.

    python -m tests.bench.one_process [--flight sample/survey] [--minutes 120] [--rate-hz 10]
        [--part-s 20] [--shrink 2] [--out FOLDER] [--set SECTION.KEY=VALUE ...]

`soak` flies laps, each of which has processes of its own. Here a short flight is flown in forward
and return passes as one long one, with rising time stamps, as fast as localisation answers: the
next frame is given when the pose of the last has come. All else is as in flight: LiveFlight with
localisation, results, recorder and exporter as processes; health is read once a second of flight.
Depth is off unless set.

A row for every minute of flight: processor time of localisation's main thread for a frame (50 and
99 %), which other programs on the machine hardly touch, and memory of every process
(proportional set size, without files). Exit status 1 where the last quarter's p99 is more than 20 %
above the first warm quarter's, or a process grows by more than 30 MB an hour once warm.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import psutil
from matplotlib.figure import Figure

from companion.config import Config
from companion.config_file import load_config
from companion.daemon.flights.flight_dates import FlightDates
from companion.daemon.flights.flights import Flights
from companion.daemon.flights.live_flight import Given, Listener, LiveFlight
from companion.daemon.health_watch import HealthWatch
from companion.geometry.camera import Camera
from companion.messages import (
    DepthMap,
    Frame,
    Georeferenced,
    MapUpdate,
    Odometry,
    PointChunk,
    Track,
    Warned,
)
from companion.messages.run_facts import RunFacts
from companion.meters import LatencyMeter
from companion.runtime.fork_server import ForkServer
from companion.telemetry import Telemetry
from companion.timing.clock import FlightClock
from drivers.camera.camera_feed import CameraFeed
from drivers.camera.camera_registry import camera_source
from drivers.open_flight import open_flight
from drivers.system.journal import Journal
from tests.support.flights.return_pass import back_and_forth, reordered

ROW_NS, SECOND_NS = 60_000_000_000, 1_000_000_000
ANSWER_S, START_S = 60.0, 180.0
LEAST_FRAME_S = 0.012
"""The mapper, which works beside, gets at least so long for each frame."""
WARM_SHARE = 0.25
MOST_SLOWER, MOST_MB_PER_HOUR = 1.2, 30.0


@dataclass
class Seen:
    """Rows so far, and what the flight has told since the last."""

    rows: list[dict[str, float]] = field(default_factory=list)
    frame_ms: list[list[float]] = field(default_factory=lambda: [[]])
    update: MapUpdate | None = None
    n_tracked: int = 0


class Flown:
    """A live flight whose frames are given one by one."""

    def __init__(self, config: Config, camera: Camera, seen: Seen) -> None:
        self.clock, self.journal, self._seen = FlightClock(), Journal({}), seen
        self._answered = threading.Event()
        self._seq = -1
        dates = FlightDates(self.clock, lambda: None, lambda: True)
        self.server = ForkServer()
        self.flights = Flights(
            self.clock, self.journal, self._listener, self._facts, dates, self.server.start
        )
        self.feed = CameraFeed(
            camera_source(config.camera), self.clock, config.camera, lambda f: None, self._warned
        )
        self.watch = HealthWatch(
            config,
            self.clock,
            self.journal,
            self.feed,
            None,
            None,
            self.flights,
            LatencyMeter(),
        )
        self.flight = self.flights.begin(config, camera)
        until_s = time.monotonic() + START_S
        while not (self.flight.ready and self.flight.stages_up):
            assert time.monotonic() < until_s, "stages do not come up"
            time.sleep(0.1)
        self.pids = self.flight.pids
        self._main = Path(f"/proc/{self.pids['localisation']}/schedstat")

    def cpu_ms(self) -> float:
        """Processor time of the thread that takes frames."""
        return int(self._main.read_text().split()[0]) * 1e-6

    def frame(self, frame: Frame) -> None:
        """Give a frame, and wait for its pose."""
        began_s = time.monotonic()
        self._seq = frame.seq
        self._answered.clear()
        self.watch.frame_came(frame.t_ns)
        self.flight.frame(frame)
        assert self._answered.wait(ANSWER_S), f"no answer to frame {frame.seq}"
        time.sleep(max(0.0, began_s + LEAST_FRAME_S - time.monotonic()))

    def _given(self, message: Given) -> None:
        if isinstance(message, Georeferenced):
            self.watch.take_georeference(message)
        elif isinstance(message, Odometry):
            self.watch.take_odometry(message)
            self._seen.n_tracked += message.quality > 0
            if message.seq >= self._seq:
                self._answered.set()

    def _mapped(self, message: Track | MapUpdate | DepthMap | PointChunk) -> None:
        if isinstance(message, MapUpdate):
            self._seen.update = message

    def _warned(self, warning: Warned) -> None:
        self.journal.warn(warning)

    def _listener(self, flight: LiveFlight) -> Listener:
        def died() -> None:
            raise AssertionError("localisation has died")

        return Listener(
            self._given,
            self._warned,
            died,
            lambda why: None,
            points_made=self.watch.points_made,
            mapped=self._mapped,
        )

    def _facts(self, flight: LiveFlight) -> RunFacts:
        raise AssertionError("its results are not written")


def row_of(flown: Flown, seen: Seen, t_s: float) -> dict[str, float]:
    """One row; begins another list of times."""
    ms = np.array(seen.frame_ms[-1])
    seen.frame_ms.append([])
    processes = {"own": psutil.Process()}
    for kind, pid in flown.pids.items():
        processes[kind] = psutil.Process(pid)
    update = seen.update
    row: dict[str, float] = {
        "minute": round(t_s / 60, 1), "p50_ms": round(float(np.percentile(ms, 50)), 2),
        "p99_ms": round(float(np.percentile(ms, 99)), 2), "tracked": seen.n_tracked,
        "keyframes": update.n_keyframes if update else 0,
        "retired": update.n_retired if update else 0,
        "points": len(update.points_map) if update else 0,
        "restarts": sum(flown.flight.n_restarted.values()),
    }  # fmt: skip
    seen.n_tracked = 0
    for name, process in processes.items():
        row[f"{name}_mb"] = round(memory_mb(process.pid), 1)
    return row


def memory_mb(pid: int) -> float:
    """Memory that the process has written, its part of what it shares with others included.

    Pages of files are left out: how many of a library's pages count as its own hangs on which other
    programs run just then, by 70 MB for localisation.
    """
    rollup = Path(f"/proc/{pid}/smaps_rollup").read_text("ascii")
    fields = dict(line.split(":", 1) for line in rollup.splitlines()[1:])
    kib = sum(int(fields[name].split()[0]) for name in ("Pss_Anon", "Pss_Shmem"))
    return kib * 1024 / 1e6


def shrunk(frame: Frame, times: int) -> Frame:
    """A frame whose sides are so many times shorter."""
    if times == 1:
        return frame
    height, width = (n // times for n in frame.grey.shape)
    rgb = cv2.resize(frame.rgb, (width, height), interpolation=cv2.INTER_AREA)
    grey = cv2.resize(frame.grey, (width, height), interpolation=cv2.INTER_AREA)
    return Frame(frame.seq, frame.t_ns, np.asarray(grey, np.uint8), np.asarray(rgb, np.uint8))


def shrunk_camera(camera: Camera, times: int) -> Camera:
    """The camera of such frames; pixel centres are at integers."""
    return replace(
        camera, width=camera.width // times, height=camera.height // times,
        fx=camera.fx / times, fy=camera.fy / times,
        cx=(camera.cx + 0.5) / times - 0.5, cy=(camera.cy + 0.5) / times - 0.5,
    )  # fmt: skip


def messages_of(arguments: argparse.Namespace, config: Config) -> Iterator[Frame | Telemetry]:
    flight = open_flight(arguments.flight, config.camera, config.telemetry)
    frames: list[Frame] = []
    for f in flight.frames():
        if frames and f.t_ns - frames[0].t_ns > arguments.part_s * 1e9:
            break
        if isinstance(f, Frame) and (
            not frames or f.t_ns - frames[-1].t_ns > 0.9e9 / arguments.rate_hz
        ):
            frames.append(shrunk(f, arguments.shrink))
    each_s = (frames[-1].t_ns - frames[0].t_ns) * 1e-9 / (len(frames) - 1)
    n = int(arguments.minutes * 60 / each_s)
    return reordered(frames, flight.telemetry().samples, back_and_forth(0, len(frames) - 1, n))


def fly(arguments: argparse.Namespace, config: Config, seen: Seen, rows_file: Path) -> None:
    camera = open_flight(arguments.flight, config.camera, config.telemetry).camera
    camera = shrunk_camera(camera, arguments.shrink)
    flown = Flown(config, camera, seen)
    start_ns, row_ns, second_ns = -1, 0, 0
    before_ms = flown.cpu_ms()
    for message in messages_of(arguments, config):
        if not isinstance(message, Frame):
            flown.flight.take(message)
            continue
        if start_ns < 0:
            start_ns = second_ns = message.t_ns
            row_ns = start_ns + ROW_NS
        flown.frame(message)
        now_ms = flown.cpu_ms()
        seen.frame_ms[-1].append(now_ms - before_ms)
        before_ms = now_ms
        if message.t_ns >= second_ns:
            second_ns += SECOND_NS
            flown.watch.document()
            health = flown.watch.health()
            line = flown.watch.line_due(health)
            if line:
                flown.journal.say(line)
            flown.flight.publish_health(health, None)
        if message.t_ns >= row_ns:
            row_ns += ROW_NS
            seen.rows.append(row_of(flown, seen, (message.t_ns - start_ns) * 1e-9))
            with rows_file.open("w", newline="") as file:
                writer = csv.DictWriter(file, list(seen.rows[0]))
                writer.writeheader()
                writer.writerows(seen.rows)
            print(seen.rows[-1], flush=True)
    for stage in flown.flight.stages.values():
        stage.kill()
    flown.server.close()


def verdict(seen: Seen) -> tuple[list[str], list[str]]:
    """What is to be said, and what is wrong."""
    rows, wrong = seen.rows, []
    n = max(1, int(len(rows) * WARM_SHARE))
    times = [ms for ms in seen.frame_ms if ms]
    first = float(np.percentile(np.concatenate(times[n : 2 * n]), 99))
    last = float(np.percentile(np.concatenate(times[-n:]), 99))
    said = [
        f"{rows[-1]['minute']:.0f} minutes of flight, {sum(map(len, times))} frames",
        f"a frame's processor time, p99: {first:.1f} ms in the second quarter, "
        f"{last:.1f} in the last",
    ]
    if last > MOST_SLOWER * first:
        wrong.append(f"a frame takes {last / first:.2f} times as long in the end")
    warm = rows[n:]
    hours = [row["minute"] / 60 for row in warm]
    for key in [key for key in rows[0] if key.endswith("_mb")]:
        grown = float(np.polyfit(hours, [row[key] for row in warm], 1)[0])
        name = key.removesuffix("_mb")
        said.append(f"{name}: {rows[-1][key]:.0f} MB at the end, {grown:+.1f} MB/h")
        if grown > MOST_MB_PER_HOUR:
            wrong.append(f"{name} grows by {grown:.0f} MB an hour")
    if rows[-1]["restarts"]:
        wrong.append("a stage was started again")
    return said, wrong


def picture(rows: list[dict[str, float]], path: Path) -> None:
    """All over time."""
    figure = Figure(figsize=(9, 8), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    minutes = [row["minute"] for row in rows]
    memory = tuple(key for key in rows[0] if key.endswith("_mb"))
    for axes, keys, unit in zip(
        panels, (("p50_ms", "p99_ms"), memory, ("keyframes", "retired")), ("ms", "MB", ""),
        strict=True,
    ):  # fmt: skip
        for key in keys:
            axes.plot(minutes, [row[key] for row in rows], lw=0.9, label=key)
        axes.set_ylabel(unit)
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper left", frameon=False, ncols=4)
    panels[-1].set_xlabel("minutes of flight")
    figure.savefig(path)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--flight", type=Path, default=Path("sample/survey"))
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--part-s", type=float, default=1e9, help="only so much of the flight")
    parser.add_argument("--shrink", type=int, default=1, help="so many times smaller pictures")
    parser.add_argument("--out", type=Path, default=Path("one_process"))
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    flights = arguments.out / "flights"
    settings = ["depth.enabled=false", f"daemon.flights={flights}", "stream.listen=127.0.0.1:0"]
    config = load_config(None, [*settings, *arguments.set])
    seen = Seen()
    try:
        fly(arguments, config, seen, arguments.out / "rows.csv")
    except KeyboardInterrupt:
        pass  # what was seen so far is told all the same
    finally:
        shutil.rmtree(flights, ignore_errors=True)
    said, wrong = verdict(seen)
    picture(seen.rows, arguments.out / "one_process.svg")
    print("\n".join([*said, *(f"WRONG: {each}" for each in wrong)]))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
