"""Cost of the live daemon with everything on: processor, memory, copies, latency of the pose.

    python -m tests.bench.live_cost [--seconds 60] [--rounds 1] [--against CLONE] [--seen | --plain]

The test pattern at 640x480 and 30 frames/s, dense map, recorder, exporter for viewers, an autopilot
to which poses are sent. With --seen page and video are on too, and somebody looks at both; with
--plain it is 320x240 and 15 frames/s, without dense map and exporter. CLONE is another working
tree, of an earlier version say: both are measured in turn. What is left out where there is too
much to do is not left out here. Memory is the sum of proportional set sizes (PSS), without pandas,
which an installed program does not have. "Pickled" is what the daemon's own process turns into
bytes and back. The camera's thread, in the daemon, draws the pattern, and closes each frame for
the stages.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_wire import free_port
from tests.support.processes.daemon_process import Daemon

COUNTING = """
import os, sys, threading, time, pickle
from companion.__main__ import main  # before numpy, whose threads it bounds
from multiprocessing import connection
n = [0]
def counted(function, length):
    def call(*given, **options):
        out = function(*given, **options)
        n[0] += length(given, out)
        return out
    return call
pickle.dumps = counted(pickle.dumps, lambda given, out: len(out))
pickle.loads = counted(pickle.loads, lambda given, out: len(given[0]))
loads = connection._ForkingPickler.loads
connection._ForkingPickler.loads = staticmethod(
    counted(loads, lambda given, out: len(given[0]))
)
dump = pickle.dump
def dump_counted(message, file, **options):
    data = pickle.dumps(message, **options)
    file.write(data)
pickle.dump = dump_counted
class CountedPickler(pickle.Pickler):
    def __init__(self, file, *given, **options):
        super().__init__(file, *given, **options)
        self.file = file
    def dump(self, message):
        before = self.file.tell()
        super().dump(message)
        n[0] += self.file.tell() - before
pickle.Pickler = CountedPickler
def drawing_s():
    found = [each.native_id for each in threading.enumerate() if each.name == "camera"]
    stat = open(f"/proc/self/task/{{found[0]}}/stat").read() if found else ") 0" + 12 * " 0"
    user, system = stat.rsplit(")", 1)[1].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
def tell():
    while True:
        time.sleep(0.5)
        with open({path!r} + ".new", "w") as file:
            file.write(f"{{n[0]}} {{drawing_s()}}")
        os.replace({path!r} + ".new", {path!r})
telling = threading.Thread(target=tell, daemon=True)
try:
    from companion.runtime.fork_server import ForkServer
    begin = ForkServer.__init__
    def begun(self, *given, **options):  # a server is copied off a program of one thread
        begin(self, *given, **options)
        telling.start()
    ForkServer.__init__ = begun
except ImportError:  # version 0.1
    telling.start()
from companion.runtime.governor import Governor
Governor.step = lambda self, t_ns, pressure: False
sys.exit(main())
"""
NO_PANDAS = "raise ModuleNotFoundError(name='pandas')"
"""A test's library wants pandas, and where it is installed Rerun's arrays import it: 45 MB."""
SETTLE_S, UP_S = 15.0, 180.0
WHOLE = "camera.rate_hz=30", "camera.width=640", "camera.height=480"
PLAIN = "camera.rate_hz=15", "camera.width=320", "camera.height=240", "depth.enabled=false"
NAMES = {"companion.streaming.export_process": "viewers"}


WATCHING = """
import sys, av
while True:
    try:
        with av.open(sys.argv[1], options={"rtsp_transport": "tcp"}, timeout=20) as stream:
            for _ in stream.decode(video=0):
                pass
    except av.error.FFmpegError:
        pass
"""
LOOKED_AT_S = (("/now/panel", 1.0), ("/now/above", 1.0), ("/now/picture", 0.2))


@contextlib.contextmanager
def onlookers(page: int, video: int) -> Iterator[None]:
    """Somebody who has the view Now open, and somebody who watches the video; ports."""
    over = threading.Event()

    def look() -> None:
        due_s = {path: 0.0 for path, _ in LOOKED_AT_S}
        while not over.wait(0.02):
            for path, every_s in LOOKED_AT_S:
                if time.monotonic() >= due_s[path]:
                    due_s[path] = time.monotonic() + every_s
                    with (
                        contextlib.suppress(OSError),
                        urllib.request.urlopen(
                            f"http://127.0.0.1:{page}{path}", timeout=20
                        ) as answer,
                    ):
                        answer.read()

    looking = threading.Thread(target=look)
    watching = subprocess.Popen(
        [sys.executable, "-c", WATCHING, f"rtsp://127.0.0.1:{video}/camera"]
    )
    looking.start()
    try:
        yield
    finally:
        over.set()
        watching.kill()
        watching.wait()
        looking.join()


def name_of(process: psutil.Process) -> str:
    """Stage of a child of the daemon."""
    name = str(process.name())
    if not name.startswith("python"):
        return name
    line = process.cmdline()  # before they had names of their own
    if "-m" not in line:  # a script: not to be taken for the daemon, whose row it would overwrite
        return next((Path(word).name for word in line[1:] if word.endswith(".py")), "daemon")
    at = line.index("-m")
    return str(NAMES.get(line[at + 1], line[at + 2] if len(line) > at + 2 else line[at + 1]))


def cpu_and_memory(daemon: psutil.Process) -> dict[str, tuple[float, float]]:
    """By process: processor seconds so far, and PSS in MB."""
    found: dict[str, tuple[float, float]] = {}
    for each in [daemon, *daemon.children(recursive=True)]:
        with contextlib.suppress(psutil.Error):
            times = each.cpu_times()
            name = "daemon" if each.pid == daemon.pid else name_of(each)
            cpu_s, mb = found.get(name, (0.0, 0.0))  # of a name that two have, the sum
            cpu_s += times.user + times.system
            found[name] = cpu_s, mb + each.memory_full_info().pss / 1e6
    return found


def own(path: Path) -> tuple[int, float]:
    """Bytes pickled by the daemon so far, and processor seconds of its camera's thread."""
    n, seconds = path.read_text().split()
    return int(n), float(seconds)


def measured(
    tree: Path, seconds: float, seen: bool = False, plain: bool = False
) -> dict[str, float]:
    """Figures of one run of the program in a working tree."""
    port = free_port()
    os.chdir(tree)  # from where the program is imported
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "pandas.py").write_text(NO_PANDAS)
        os.environ["PYTHONPATH"] = f"{tree}:{folder}"
        pickled = folder / "pickled"
        settings = (
            "camera.source=pattern", "daemon.flight=always", f"link.url=udpin:127.0.0.1:{port}",
            "feedback.mode=odometry",
            *(PLAIN if plain else (*WHOLE, f"stream.listen=127.0.0.1:{free_port()}")),
        )  # fmt: skip
        page, video = free_port(), free_port()
        shown = f"page.listen=127.0.0.1:{page}", f"video.listen=127.0.0.1:{video}"
        autopilot = FakeAutopilot("ardupilot", f"udpout:127.0.0.1:{port}")
        program = "-c", COUNTING.format(path=str(pickled))
        daemon = Daemon(folder, *settings, *shown * seen, program=program)
        # names of version 0.1, which both read
        daemon._command = [each.replace("expert.", "") for each in daemon._command]
        if not (tree / "companion" / "page").is_dir():  # a version without a page
            at = daemon._command.index("page.listen=")
            del daemon._command[at - 1 : at + 1]
        with ExitStack() as running:
            for part in (contextlib.redirect_stdout(sys.stderr), daemon, autopilot):
                running.enter_context(part)
            daemon.until(lambda health: health["tracker"] == "tracking", timeout_s=UP_S)
            if seen:
                running.enter_context(onlookers(page, video))
            time.sleep(SETTLE_S)
            process = psutil.Process(daemon._running.pid)
            first, first_own = cpu_and_memory(process), own(pickled)
            began_s = time.monotonic()
            rows: list[dict[str, Any]] = []
            while time.monotonic() < began_s + seconds:
                time.sleep(5.0)
                rows.append(daemon.status())
            last, last_own = cpu_and_memory(process), own(pickled)
            took_s = time.monotonic() - began_s
            for each, (cpu_s, mb) in last.items():
                figures[f"{each}: cores"] = (cpu_s - first.get(each, (0, 0))[0]) / took_s
                figures[f"{each}: MB"] = mb
            figures["all: cores"] = sum(v for k, v in figures.items() if k.endswith("cores"))
            figures["all: MB"] = sum(v for k, v in figures.items() if k.endswith("MB"))
            figures["daemon pickles, MB/s"] = (last_own[0] - first_own[0]) / took_s / 1e6
            figures["camera: cores"] = (last_own[1] - first_own[1]) / took_s
            rest = figures["daemon: cores"] - figures["camera: cores"]
            figures["daemon without camera: cores"] = rest
            stages = [stage for row in rows for stage in row["stages"]]
            pose = [stage for stage in stages if stage["name"] == "localisation"]
            for key in ("rate_hz", "latency_p50_ms", "latency_p95_ms"):
                figures[f"pose {key}"] = float(np.median([each[key] for each in pose]))
            figures["loop p99 ms"] = float(np.median([row["loop_delay_p99_ms"] for row in rows]))
            figures["dropped"] = sum(stage["n_dropped"] for stage in rows[-1]["stages"])
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--against", type=Path)
    looked_at = parser.add_mutually_exclusive_group()
    looked_at.add_argument("--seen", action="store_true")
    looked_at.add_argument("--plain", action="store_true")
    arguments = parser.parse_args()
    trees = [Path(__file__).parents[2]] + ([arguments.against] if arguments.against else [])
    found: dict[Path, list[dict[str, float]]] = {tree: [] for tree in trees}
    for _ in range(arguments.rounds):
        for tree in trees:
            found[tree].append(
                measured(tree.absolute(), arguments.seconds, arguments.seen, arguments.plain)
            )
    keys = sorted({key for runs in found.values() for run in runs for key in run})
    print("| |" + " | ".join(tree.absolute().name for tree in trees) + " |")
    for key in keys:
        cells = []
        for tree in trees:
            values = [run[key] for run in found[tree] if key in run]
            cells.append(f"{np.median(values):.3g}" if values else "")
        print(f"| {key} | " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
