"""The drone of the link table: plays a message log to an exporter. LOG LISTEN KBIT_S SECONDS OUT.

OUT: JSON with the time at which each chunk of points was given and the memory of the exporter.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import psutil

from companion.config import StreamConfig, ViewerConfig
from companion.messages import PointChunk
from companion.streaming.live_viewer import LiveViewer
from tests.support.flights.message_log import MessageLog


def main() -> None:
    log, listen, kbit_s, seconds, out = sys.argv[1:6]
    flight = MessageLog(Path(log))
    stream = StreamConfig(listen=listen, budget_kbit_s=float(kbit_s))
    given: dict[str, float] = {}
    memory: list[tuple[float, float]] = []
    slowest_ms = 0.0
    with LiveViewer(
        ViewerConfig(), flight.camera, name="orbit", stream=stream, origin=flight.origin
    ) as viewer:
        process = psutil.Process(viewer.stage.pid)
        for message in flight.messages(float(seconds)):
            began = time.perf_counter()
            viewer.take(message)
            slowest_ms = max(slowest_ms, 1e3 * (time.perf_counter() - began))
            now_s = time.time()
            if isinstance(message, PointChunk) and len(message.points_camera):
                given.setdefault(str(message.keyframe_id), now_s)
            if not memory or now_s - memory[-1][0] > 1.0:
                memory.append((now_s, process.memory_info().rss / 2**20))
        document = {
            "given": given, "memory_mib": memory, "dropped": viewer.n_dropped,
            "slowest_take_ms": slowest_ms, "report": dict(viewer.report),
            "processor_s": sum(process.cpu_times()[:2]),
        }  # fmt: skip
        Path(out).write_text(json.dumps(document))


if __name__ == "__main__":
    main()
