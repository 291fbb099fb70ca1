"""Telemetry between two frames: what is believed of it, and which estimate takes it."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from companion.config import Measurement
from companion.estimation.attitude.camera_attitude import CameraAttitude
from companion.estimation.georeference.depth_scales import DepthScales
from companion.estimation.georeference.georeferencer import Georeferencer
from companion.estimation.gimbal.gimbal_head import GimbalHead
from companion.estimation.inertial.judged_acceleration import JudgedAcceleration
from companion.estimation.lift_off.ground_aiding import GroundAiding
from companion.estimation.lift_off.optical_flow import FlowMeter
from companion.estimation.lift_off.standing import Standing
from companion.estimation.satellites.satellite_watch import SatelliteWatch
from companion.geometry.transforms import Array
from companion.slam.map.sparse_map import SlamMap
from companion.telemetry import (
    AttitudeSample,
    DepthSample,
    GimbalSample,
    HeightSample,
    ImuSample,
    PositionSample,
    RangeSample,
    Telemetry,
    is_believed,
)

KEPT_NS, PRUNED_EVERY_NS = 600_000_000_000, 60_000_000_000
"""Older telemetry is only needed at the times of keyframes."""


class TelemetryIntake:
    """Keeps samples until the next frame, when nothing is mapped, and passes them on then.

    `use` names what is believed.
    """

    def __init__(
        self, use: Collection[Measurement], gimbal: GimbalHead | None, standing: Standing,
        flow: FlowMeter, ground: GroundAiding, imu: JudgedAcceleration, satellites: SatelliteWatch,
        attitude: CameraAttitude, georeferencer: Georeferencer, depths: DepthScales,
    ) -> None:  # fmt: skip
        self._use, self._gimbal = use, gimbal
        self._standing, self._flow, self._ground = standing, flow, ground
        self._imu, self._satellites = imu, satellites
        self._attitude, self._georeferencer, self._depths = attitude, georeferencer, depths
        self._samples: list[Telemetry] = []
        self.n_samples = 0
        """Number of samples that were passed on, or not believed."""
        self._pruned_ns: int | None = None

    def add(self, sample: Telemetry) -> None:
        """Keep a sample."""
        self._samples.append(sample)

    def pass_on(self) -> None:
        """Pass on what has come."""
        for sample in self._samples:
            if is_believed(sample, self._use):
                self._take(sample)
        self.n_samples += len(self._samples)
        self._samples.clear()

    def prune(self, t_ns: int, segments: Iterable[SlamMap]) -> None:
        """Drop, from time to time, what none of the segments of the map needs any more."""
        if self._pruned_ns is not None and t_ns < self._pruned_ns + PRUNED_EVERY_NS:
            return
        self._pruned_ns = t_ns
        living = {k.keyframe_id: k.t_ns for s in segments for k in s.keyframes.values()}
        self._attitude.prune(living.keys())
        when_ns: Array = np.array(sorted(living.values()))
        self._georeferencer.prune(t_ns - KEPT_NS, when_ns)
        self._imu.prune(t_ns - KEPT_NS, when_ns)

    def _take(self, sample: Telemetry) -> None:
        if isinstance(sample, PositionSample) and self._gimbal is not None:
            sample = self._gimbal.of_head(sample)
        if isinstance(sample, PositionSample) and not self._satellites.may_use(
            sample, self._georeferencer.path.velocity_unproved(sample.t_ns)
        ):
            return
        self._standing.take(sample)
        self._flow.take(sample)
        if isinstance(sample, HeightSample):
            self._ground.take_height(sample.t_ns, sample.height_m, self._standing.armed)
        if isinstance(sample, RangeSample):
            self._take_range(sample)
        if isinstance(sample, AttitudeSample | ImuSample):
            self._imu.take(sample)
        if isinstance(sample, AttitudeSample):
            self._satellites.take_time(sample.t_ns)
        for each in self._of_head(sample):
            if isinstance(each, AttitudeSample):
                self._attitude.add(each)
            elif isinstance(each, DepthSample):
                self._depths.take(each)
            else:
                self._georeferencer.take(each)

    def _take_range(self, sample: RangeSample) -> None:
        """A range is along the body's axis, also where the frames' attitude is a gimbal head's."""
        upright = None
        if self._gimbal is not None:
            upright = self._gimbal.body_upright(sample.t_ns)
            if upright is None:
                return
        self._ground.take_range(sample.t_ns, sample.distance_m, upright)

    def _of_head(self, sample: Telemetry) -> Iterable[Telemetry]:
        """A sample as it is of what the camera is fixed to: the body, or a gimbal's head."""
        if self._gimbal is None:
            return (sample,)
        if isinstance(sample, AttitudeSample | GimbalSample):
            return self._gimbal.take(sample, self._attitude.correction[1])
        # a rangefinder looks down from the body
        return () if isinstance(sample, RangeSample) else (sample,)
