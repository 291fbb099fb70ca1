"""Dense map of a depth node, compared to the one made on board."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from companion.config import Config, DistributedConfig
from companion.dense.depth_stage import DepthStage
from companion.estimation.localisation import LocalisationStage
from companion.messages import Frame, KeyframeAdded, MapUpdate, Message, Track
from companion.products.flight_result import FlightResult
from companion.runtime.in_order import in_order_of_time
from companion.timing.clock import StageTimes
from companion.topics.envelope import unpack
from companion.topics.gatherer import Gatherer
from companion.topics.keyframe_bundle import MapMirror, bundle_of, frame_of
from drivers.open_flight import open_flight
from tests.support.reference import opencl_devices

FLIGHT = Path(__file__).parents[2] / "sample" / "survey"
STOP_S = 8.0
VOXEL_M = 0.25
BYTES_S = 0.75 * 125 * DistributedConfig().budget_kbit_s


@dataclass
class Made:
    on_board: FlightResult
    elsewhere: FlightResult
    n_bytes: int


class _Stage:
    def __init__(self, stage: DepthStage) -> None:
        self._stage, self.result = stage, FlightResult()

    def take(self, message: Message) -> None:
        self.result.take(message)
        for out in self._stage.step(message):
            self.result.take(out)

    def finish(self) -> None:
        for out in self._stage.flush():
            self.result.take(out)


@pytest.fixture(scope="module")
def made() -> Made:
    config = Config()
    flight = open_flight(FLIGHT, config.camera, config.telemetry)
    stop_ns = flight.start_ns + int(STOP_S * 1e9)
    devices = opencl_devices.devices()
    here, there = (
        _Stage(DepthStage(config.depth, config.cloud, flight.camera, devices, StageTimes()))
        for _ in range(2)
    )
    localisation = LocalisationStage(config, flight.camera, StageTimes())
    gatherer = Gatherer("run", BYTES_S, DistributedConfig().jpeg_quality)
    mirror = MapMirror()
    n_bytes = 0

    def take(message: Message) -> None:
        nonlocal n_bytes
        if not isinstance(message, (Frame, Track, KeyframeAdded, MapUpdate)):
            return
        here.take(message)
        bundle = gatherer.take(message)
        if bundle is None:
            return
        data = bundle.pack()
        n_bytes += len(data)
        bundle = bundle_of(unpack(data))
        for picture in bundle.pictures:
            there.take(frame_of(picture, flight.camera))
        told: list[Message] = [*bundle.tracks, *bundle.keyframes]
        for each in told:
            there.take(each)
        if bundle.change is not None:
            there.take(mirror.take(bundle.change))

    samples = [s for s in flight.telemetry().samples if s.t_ns <= stop_ns]
    for message in in_order_of_time(samples, flight.frames(flight.start_ns, stop_ns)):
        take(message)
        for out in localisation.step(message):
            take(out)
    for out in localisation.finish():
        take(out)
    here.finish()
    there.finish()
    return Made(here.result, there.result, n_bytes)


def test_the_cloud_is_the_same_but_for_what_jpeg_loses(made: Made) -> None:
    assert made.on_board.n_depth_maps == made.elsewhere.n_depth_maps > 4
    here, there = made.on_board.cloud(VOXEL_M), made.elsewhere.cloud(VOXEL_M)
    assert len(there) > 0.9 * len(here) > 1000
    for one, other in ((here, there), (there, here)):
        apart_m, _ = cKDTree(one.points).query(other.points)
        assert np.median(apart_m) < 0.5 * VOXEL_M
        assert np.percentile(apart_m, 95) < VOXEL_M


def test_poses_and_map_are_the_same(made: Made) -> None:
    here, there = made.on_board.poses(), made.elsewhere.poses()
    true = {pose.seq: pose.world_from_camera for pose in here}
    assert len(there) > 0.9 * len(here)
    for pose in there:
        apart = pose.world_from_camera.translation - true[pose.seq].translation
        assert np.linalg.norm(apart) < 1e-6


def test_it_takes_less_than_the_budget(made: Made) -> None:
    assert made.n_bytes < BYTES_S * (STOP_S + 3.0)
