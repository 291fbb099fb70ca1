"""A replay as flown of a recording that lacks an image or telemetry says which, and why."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.app.progress import Progress
from companion.app.replay.as_flown import replay_as_flown
from companion.config import Config, RecorderConfig
from companion.errors import FlightError
from companion.flight_notes import HealthNote
from companion.health import Health, StageHealth
from companion.messages import FrameTracked
from drivers.recording.recorder import Recorder
from tests.support.flights.recorded import camera, frames, samples

LACKING = 7


@pytest.mark.parametrize(
    ("n_dropped", "why"),
    [(0, ""), (12, ": the recorder could not keep up, and dropped 12 messages")],
)
@pytest.mark.parametrize("what", ["its image", "telemetry before it"])
def test_what_is_missing_is_named(tmp_path: Path, what: str, n_dropped: int, why: str) -> None:
    config = Config(recorder=RecorderConfig(codec="png"))
    recorder = Recorder(tmp_path, config, camera(), {"companion": "1"})
    told = samples(2)
    for frame in frames(4):
        if what != "its image" or frame.seq != LACKING:
            recorder.take(frame)
        n_samples = len(told) + (frame.seq == LACKING and what != "its image")
        recorder.take(FrameTracked(frame.t_ns, frame.seq, n_samples, 0, 1.0))
    for sample in told:
        recorder.take(sample)
    health = Health(0, 1.0, (), (StageHealth("recorder", n_dropped=n_dropped),))
    recorder.take(HealthNote(told[0].t_ns, {"health": health.to_json()}))
    recorder.close()
    with pytest.raises(FlightError) as caught:
        replay_as_flown(tmp_path, tmp_path / "out", Config(), Progress(), print)
    said = f"frame {LACKING} was tracked, but {what} is missing in the recording{why}"
    assert str(caught.value) == said
