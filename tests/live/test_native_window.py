"""`companion view` opens a window that shows the map."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from companion.config import StreamConfig, ViewerConfig
from companion.messages import Bytes
from companion.streaming.live_viewer import LiveViewer
from companion.streaming.viewer.drawing import COLOUR_AUTOPILOT, COLOUR_PATH
from companion.streaming.viewer.layout import BACKGROUND
from companion.streaming.viewer.screen import GRPC_PORT, listens
from companion.streaming.viewer.web_proxy import LOOPBACK, free_ports
from tests.support.flights import flown
from tests.support.processes.virtual_display import VirtualDisplay, why_not
from tests.unit.streaming.test_viewer_recording import CAMERA

PATIENCE_S = 150.0
"""A first picture by processor only, on a machine that has other work."""


def test_the_window_opens_with_the_map_and_both_paths(tmp_path: Path) -> None:
    reason = why_not()
    if listens(LOOPBACK, GRPC_PORT):
        reason = "a viewer is open here already"
    if reason and "window" in os.environ.get("COMPANION_REQUIRE", ""):
        pytest.fail(reason)
    if reason:
        pytest.skip(reason)
    (port,) = free_ports(1)
    stream = StreamConfig(listen=f"{LOOPBACK}:{port}")
    command = [sys.executable, "-m", "companion", "view", f"{LOOPBACK}:{port}"]
    with (
        VirtualDisplay(tmp_path) as display,
        LiveViewer(ViewerConfig(), CAMERA, name="window", stream=stream) as live,
    ):
        for message in (flown.update(), *flown.messages()[:-1]):
            live.take(message)
        view = subprocess.Popen(command, env=display.environment, stderr=subprocess.PIPE)
        try:
            until_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < until_s and not shows_map(display.picture()):
                assert view.poll() is None, view.communicate()[1].decode()
                time.sleep(1.0)
            assert shows_map(display.picture())
        finally:
            # the window is detached, and stays open when `view` ends
            for process in [*psutil.Process(view.pid).children(recursive=True), view]:
                process.kill()
            view.communicate()


def shows_map(picture: Bytes) -> bool:
    """Whether a good part of the screen is the map's background, with both paths on it."""

    def share(colour: list[int]) -> float:
        off = np.abs(picture.astype(np.int16) - np.array(colour, np.int16)).max(axis=2)
        return float((off <= 8).mean())

    paths = share(COLOUR_PATH), share(COLOUR_AUTOPILOT)
    return share(BACKGROUND) > 0.1 and min(paths) > 5e-5
