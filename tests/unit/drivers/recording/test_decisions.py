"""What a recording says of the poses that were sent."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from companion.config import Config
from companion.estimation.gate.gate_journal import POSE as POSES
from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.transforms import Pose
from companion.messages import FrameTracked, Odometry, TrackState
from drivers.mavlink.measurements.pose_messages import pose_messages
from drivers.mavlink.vehicle import Firmware
from drivers.recording import recorder
from drivers.recording.decisions import Decisions, decisions_of, payloads_of
from drivers.recording.recorder import Recorder
from drivers.recording.recording_codec import odometry_bytes
from drivers.recording.recording_reader import RecordingReader
from tests.support.flights.recorded import camera, odometry

POSE = PoseToSend(
    10**12, Pose(np.eye(3), np.array([1.0, 2.0, -3.0])), np.array([0.5, 0.0, 0.1]),
    0.1, 0.2, 0.01, 0.05, 80, 0,
)  # fmt: skip


@pytest.mark.parametrize("firmware", ["ardupilot", "px4", "other"])
@pytest.mark.parametrize("mode", ["odometry", "vision_position", "velocity"])
def test_poses_are_made_again_for_the_firmware_that_they_were_sent_to(
    firmware: Firmware, mode: str
) -> None:
    sent = payloads_of(pose_messages(POSE, mode, firmware))
    told = Decisions(Config(), lossless=True, sent={POSES: sent})
    assert payloads_of(pose_messages(POSE, mode, told.firmware)) == sent


def test_what_one_firmware_gets_another_does_not() -> None:
    def sent(firmware: Firmware) -> list[tuple[int, bytes]]:
        return payloads_of(pose_messages(POSE, "odometry", firmware))

    assert sent("px4") != sent("ardupilot")


def test_dead_reckoning_is_read_under_its_earlier_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def as_before(odometry: Odometry) -> bytes:
        return odometry_bytes(odometry).replace(b'"tracking"', b'"coasting"')

    monkeypatch.setattr(recorder, "odometry_bytes", as_before)
    writing = Recorder(tmp_path, Config(), camera(), {"companion": "1"})
    tracked = odometry(5)
    writing.take(FrameTracked(tracked.t_ns, tracked.seq, 0, 0, 1.0))
    writing.take(tracked)
    writing.close()
    recording = RecordingReader(tmp_path / "flight.mcap")
    assert decisions_of(recording).odometry[5].state is TrackState.DEAD_RECKONING
    recording.close()
