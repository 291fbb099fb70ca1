"""The ground of the link table: `companion view` into a file. HOST:PORT OUT RRD.

OUT gets when each pose and each chunk of points was drawn, as JSON, when it is told to end.
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from pathlib import Path

import psutil
import rerun as rr

from companion.streaming.ground_link import GroundLink, host_and_port
from companion.streaming.items import PictureItem, PointsItem, PoseItem, StatusItem
from companion.streaming.viewer.colours import Colours
from companion.streaming.viewer.drawing import Drawing


def main() -> None:
    address, out, rrd = sys.argv[1:4]
    stop = threading.Event()
    # by a thread: a handler would wait for the event's lock, which this thread may hold. And not by
    # sigwait: threads that libraries began when they were imported do not block the signal
    signal.signal(signal.SIGTERM, lambda *_: threading.Thread(target=stop.set).start())
    recording = rr.RecordingStream("links")
    recording.save(rrd)
    drawing = Drawing(recording, live=True, colours=Colours.PICTURE)
    link = GroundLink(*host_and_port(address), lambda text: print(text, file=sys.stderr))
    poses: list[tuple[float, float]] = []
    points: dict[str, list[tuple[str, float]]] = {"coarse": [], "fine": []}
    pictures: list[tuple[float, float, int]] = []
    facts: dict[str, object] = {}
    memory: list[tuple[float, float]] = []
    first_s: float | None = None
    came: list[tuple[float, int]] = []
    for item in link.items(stop):
        drawing.draw(item)
        now_s = time.time()
        first_s = first_s or now_s
        came.append((now_s, link.n_bytes))
        if isinstance(item, PoseItem):
            poses.append((now_s, item.t_ns * 1e-9))
        elif isinstance(item, PointsItem):
            points[item.level].append((str(item.keyframe_id), now_s))
        elif isinstance(item, PictureItem):
            pictures.append((now_s, item.t_ns * 1e-9, item.width))
        elif isinstance(item, StatusItem):
            facts = dict(item.facts)
            memory.append((now_s, psutil.Process().memory_info().rss / 2**20))
    document = {
        "poses": poses, "points": points, "pictures": pictures, "facts": facts,
        "memory_mib": memory, "connections": link.n_connections, "bytes": link.n_bytes,
        "first_s": first_s, "came": came,
    }  # fmt: skip
    Path(out).write_text(json.dumps(document))


if __name__ == "__main__":
    main()
