"""The landing stage in a replay: the same bytes each time, and those that were recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.app.replay.landing_sent import LANDING_SENT, LandingSent
from companion.config import CameraConfig, Config, LandingConfig, RecorderConfig, TelemetryConfig
from companion.estimation.landing.marker_detector import MarkerDetector
from companion.geometry.camera import Camera
from companion.geometry.transforms import Pose, quaternion_from_rotation
from companion.messages import Frame, LandingTarget, Message
from companion.runtime.in_order import InOrder
from companion.runtime.parcel import Parcel
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stage_start import start_alone
from companion.runtime.stages import stage_named
from companion.telemetry import AttitudeSample
from drivers.recording.flights_folder import RECORDING
from drivers.recording.recorder import Recorder
from drivers.recording.recording_as_flight import open_recording
from drivers.recording.recording_codec import decision_bytes
from drivers.recording.recording_topics import LANDING
from tests.support.flights.marker_ground import MarkerGround, looking_at_marker
from tests.support.processes.stage_heard import SOON_S, Heard

CONFIG = Config(
    landing=LandingConfig("aruco_5x5_100", 3, 0.4), recorder=RecorderConfig(codec="raw")
)
CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5, body_from_camera=Pose.identity())
START_NS = 1_795_000_000 * 10**9


def descent() -> list[Message]:
    """Down to a marker from 6 m, camera and body alike; attitudes as in the images."""
    ground = MarkerGround("aruco_5x5_100", 3, 0.4)
    out: list[Message] = []
    for seq in range(10):
        t_ns = START_NS + seq * 100_000_000
        pose = looking_at_marker(6.0 - 0.4 * seq, 4.0, 30.0, 15.0)
        quaternion = quaternion_from_rotation(pose.rotation)
        grey = ground.picture(CAMERA, pose)
        out.append(AttitudeSample(t_ns, quaternion, np.zeros(3)))
        out.append(Frame(seq, t_ns, grey, np.repeat(grey[..., None], 3, 2)))
    return out


def replayed(messages: list[Message], out: Path) -> list[LandingTarget]:
    found: list[LandingTarget] = []
    sent = LandingSent(CONFIG)

    def watch(message: Message) -> None:
        sent.take(message)
        if isinstance(message, LandingTarget):
            found.append(message)

    setup = Setup(CONFIG, CAMERA, out, is_live=False)
    stages = InOrder([stage_named("landing")], setup, watch, lambda _: None)
    for message in messages:
        stages.feed(message)
    stages.finish(lambda _: Finish(hurry=False))
    out.mkdir(exist_ok=True)
    sent.write(out)
    return found


def test_two_replays_give_the_same_bytes(tmp_path: Path) -> None:
    messages = descent()
    one, other = replayed(messages, tmp_path / "1"), replayed(messages, tmp_path / "2")
    assert [decision_bytes(each) for each in one] == [decision_bytes(each) for each in other]
    text = (tmp_path / "1" / LANDING_SENT).read_text()
    assert text == (tmp_path / "2" / LANDING_SENT).read_text()
    lines = text.splitlines()[1:]
    assert len(lines) == len(one) - 2  # two prove the first
    down_m = [float(line.split(",")[6]) for line in lines]
    truth_m = [(6.0 - 0.4 * seq) * np.cos(np.radians(4.0)) for seq in range(2, 10)]
    assert down_m == list(np.clip(down_m, np.array(truth_m) - 0.25, np.array(truth_m) + 0.25))


def test_a_recording_holds_it_and_its_images_give_it_again(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, CONFIG, CAMERA, {"companion": "1"})
    messages = descent()
    for message in [*messages, *replayed(messages, tmp_path / "1")]:
        recorder.take(message)
    recorder.close()
    flight = open_recording(tmp_path / RECORDING, CameraConfig(), TelemetryConfig())
    try:
        recorded = [
            bytes(each.data)
            for number in range(len(flight.recording.found.chunks))
            for each in flight.recording.messages(number)
            if each.channel.topic == LANDING
        ]
        again: list[Message] = [
            each for each in flight.frames(flight.start_ns, flight.stop_ns)
            if isinstance(each, Frame)
        ]  # fmt: skip
    finally:
        flight.recording.close()
    assert len(recorded) == 10
    assert [decision_bytes(each) for each in replayed(again, tmp_path / "2")] == recorded


def test_in_a_process_of_its_own_it_finds_the_same() -> None:
    """As in flight: frames come through shared memory, which cannot be written to."""
    heard, ended = Heard(), Heard()
    process = StageProcess(stage_named("landing"), start_alone, heard.parcel, ended.note)
    frames = [each for each in descent() if isinstance(each, Frame)][:3]
    try:
        process.begin(Setup(CONFIG, CAMERA))
        for n, frame in enumerate(frames):
            process.offer(Parcel.of(frame))
            heard.until(lambda n=n: len(heard.all) > n)  # type: ignore[misc]
        process.ask_to_finish(Finish(hurry=False))
        assert process.wait(SOON_S)
    finally:
        process.kill()
    detector = MarkerDetector(CONFIG.landing, CAMERA)
    wanted = [decision_bytes(detector.step(frame)) for frame in frames]
    assert [decision_bytes(each) for each in heard.all] == wanted
    assert ended.all == [""]
