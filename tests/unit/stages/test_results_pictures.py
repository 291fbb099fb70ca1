"""Pictures in the viewer file: as many as viewers get."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from companion.config import Config
from companion.geometry.camera import Camera
from companion.runtime.stage_protocol import Finish, Setup
from companion.stages.results_work import work
from tests.support.flights import flown

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
PERIOD_NS = 33_333_333
N_FRAMES = 30


def n_pictures(path: Path) -> int:
    """Pictures of the camera in a viewer file."""
    batches = [chunk.to_record_batch() for chunk in RrdReader(path).stream().to_chunks()]
    blobs = [
        b.column("EncodedImage:blob") for b in batches if "EncodedImage:blob" in b.schema.names
    ]
    return sum(len(blob) - blob.null_count for blob in blobs)


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # it is for long flights
@pytest.mark.parametrize("is_live", [True, False])
def test_a_second_of_pictures(tmp_path: Path, is_live: bool) -> None:
    stage = work(Setup(Config(), CAMERA, tmp_path, is_live=is_live))
    for k in range(N_FRAMES):
        list(stage.step(replace(flown.frame(k), t_ns=k * PERIOD_NS)))
    list(stage.finish(Finish(hurry=True)))
    assert n_pictures(tmp_path / "flight.rrd") == N_FRAMES // 2
