"""GPMF track of a GoPro video: blocks, each of a span of the video."""

from __future__ import annotations

from pathlib import Path

import av
import av.error

HANDLER = "GoPro MET"


def blocks_of(video: Path) -> list[tuple[int, int, bytes]]:
    """Begin and end in ns of the video's time, and content of each; none without a track."""
    out = []
    try:
        with av.open(str(video)) as container:
            stream = next(
                (
                    s
                    for s in container.streams
                    if s.type == "data" and HANDLER in s.metadata.get("handler_name", "")
                ),
                None,
            )
            if stream is None or stream.time_base is None:
                return []
            unit_ns = stream.time_base * 1_000_000_000
            for packet in container.demux(stream):
                if packet.pts is not None and packet.size:
                    begin_ns = round(packet.pts * unit_ns)
                    end_ns = begin_ns + round((packet.duration or 0) * unit_ns)
                    out.append((begin_ns, end_ns, bytes(packet)))
    except av.error.FFmpegError:
        pass  # the video is cut short: the part before counts
    return out
