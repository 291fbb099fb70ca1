"""An OpenCL device that fails in flight, and the daemon around its stage."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from companion.dense.device_takeover import FAILED_OVER, NO_DEVICE_LEFT
from companion.pilot_messages import MAP_OTHER_DEVICE
from drivers.recording.recording_reader import RecordingReader
from drivers.recording.recording_topics import EVENTS
from tests.support.processes.daemon_process import UNGOVERNED
from tests.support.processes.flying import Flying
from tests.support.reference.failing_driver import fail, two_devices

LONG_S = 150.0
"""A first depth map, on a machine that may have much else to do."""


def test_in_flight_the_next_device_takes_over_and_the_pose_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As journal, pilot, status and recording have it."""
    first, second = two_devices(monkeypatch, tmp_path)
    now = tmp_path / "now"
    fail(monkeypatch, tmp_path, "abort", first, when=now)
    with Flying(
        tmp_path, "depth.enabled=true", "expert.depth.stride=8", program=UNGOVERNED
    ) as flying:
        flying.until_source("camera", "running")
        flying.until_source("autopilot", "running")
        flying.autopilot.arm()
        flying.until_stage("depth", lambda it: it["detail"].startswith(first.named), LONG_S)
        flying.until_stage("depth", lambda it: it["rate_hz"] > 0, LONG_S)
        failed_ns = time.monotonic_ns()
        now.touch()
        flying.daemon.line(
            "started again: depth: killed by SIGABRT", after_ns=failed_ns, timeout_s=LONG_S
        )
        flying.until_stage("depth", lambda it: it["detail"].startswith(second.named), LONG_S)
        flying.daemon.line(FAILED_OVER, after_ns=failed_ns, timeout_s=LONG_S)
        flying.until_told(MAP_OTHER_DEVICE.text, failed_ns)
        health = flying.until_stage("depth", lambda it: it["alive"] and it["rate_hz"] > 0, LONG_S)
        assert health["n_restarted"] == 1
        assert f"failed: {first.named}: killed by SIGABRT" in health["detail"]
        flying.until_stage("localisation", lambda it: it["rate_hz"] > 0 and not it["n_restarted"])
        flying.assert_stops()
        (folder,) = flying.daemon.flown()
    recording = RecordingReader(folder / "flight.mcap")
    chunks = range(len(recording.found.chunks))
    events = b"".join(
        bytes(each.data) for n in chunks for each in recording.messages(n)
        if each.channel.topic == EVENTS
    )  # fmt: skip
    recording.close()
    assert f"{second.named}; {first.named}: killed by SIGABRT".encode() in events
    assert events.count(FAILED_OVER.encode()) == 1 and NO_DEVICE_LEFT.encode() not in events
