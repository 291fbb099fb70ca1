"""Draws items of a link on a screen. A slow screen slows the link, and nothing else.

A call into Rerun whose peer hangs does not return. Then this process hangs, on the ground; the
drone gets no acknowledgements any more, and sends nothing.
"""

from __future__ import annotations

import threading

import rerun as rr

from companion.streaming.ground_link import GroundLink
from companion.streaming.items import FlightItem, PoseItem, StatusItem
from companion.streaming.viewer.colours import Colours
from companion.streaming.viewer.drawing import Drawing
from companion.streaming.viewer.layout import layout
from companion.streaming.viewer.rrd_files import APPLICATION
from companion.streaming.viewer.screen import Screen

FLUSH_S = 2.0


def show(link: GroundLink, screen: Screen, colours: Colours, stop: threading.Event) -> None:
    """Draw the items of a link, each flight in a recording of its own."""
    recording: rr.RecordingStream | None = None
    drawing: Drawing | None = None
    flight_id = None
    for item in link.items(stop):
        if isinstance(item, FlightItem) and item.flight_id != flight_id:
            if recording is not None:
                recording.flush(timeout_sec=FLUSH_S)
                recording.disconnect()
            flight_id = item.flight_id
            recording = rr.RecordingStream(
                APPLICATION, batcher_config=rr.ChunkBatcherConfig.LOW_LATENCY()
            )
            recording.connect_grpc(screen.address, default_blueprint=layout(live=True))
            drawing = Drawing(recording, live=True, colours=colours)
        if screen.proxy is not None and not isinstance(item, (PoseItem, StatusItem)):
            screen.proxy.wait_for_browsers(stop)
        if drawing is not None:
            drawing.draw(item)
    if recording is not None:
        recording.flush(timeout_sec=FLUSH_S)
