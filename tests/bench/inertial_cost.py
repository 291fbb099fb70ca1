"""Cost of inertial body: processor time for each IMU sample and for each frame.

    python -m tests.bench.inertial_cost [--imu-hz 200] [--seconds 120]

A made-up weaving flight with attitudes at 50 Hz and frames at 30. The first line has all that takes
samples: integration, verdict, standing. The second, what a frame asks of body: one place that
aids it, and the predictions.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from companion.estimation.body.aiding import AidedPlace
from companion.estimation.body.body_filter import BodyFilter
from companion.estimation.inertial.acceleration_integral import AccelerationIntegral
from companion.estimation.inertial.judged_acceleration import JudgedAcceleration
from companion.estimation.lift_off.standing import Standing
from companion.telemetry import AttitudeSample, ImuSample
from tests.support.flights.measured_motion import MeasuredMotion, weaving

FRAME_HZ = 30.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--imu-hz", type=float, default=200.0)
    parser.add_argument("--seconds", type=float, default=120.0)
    options = parser.parse_args()
    integral, standing = AccelerationIntegral(), Standing()
    judged, body = JudgedAcceleration([integral], lambda _: None), BodyFilter(integral)
    samples_s = frames_s = 0.0
    n_frames, next_frame_s = 0, 1.0
    # those of 100 Hz, told so much faster
    faster = options.imu_hz / 100.0
    motion = MeasuredMotion(weaving, np.random.default_rng(0), options.seconds * faster)
    for sample in motion.samples():
        t_ns = round(sample.t_ns / faster)
        told: ImuSample | AttitudeSample = (
            ImuSample(t_ns, sample.gyro_rad_s, sample.accel_m_s2)
            if isinstance(sample, ImuSample)
            else AttitudeSample(t_ns, sample.ned_from_body)
        )
        begun_s = time.process_time()
        judged.take(told)
        standing.take(told)
        samples_s += time.process_time() - begun_s
        if t_ns * 1e-9 < next_frame_s or isinstance(told, AttitudeSample):
            continue
        next_frame_s += 1.0 / FRAME_HZ
        n_frames += 1
        begun_s = time.process_time()
        place = AidedPlace(t_ns, weaving(t_ns * faster * 1e-9), np.eye(3), 0.05)
        body.aid(place)
        body.at(t_ns)
        body.at(t_ns + 20_000_000)
        frames_s += time.process_time() - begun_s
    core = 100.0 * samples_s / options.seconds
    print(f"samples at {options.imu_hz:.0f} Hz, attitudes beside: {core:.1f} % of a core")
    print(f"a frame: {1e3 * frames_s / n_frames:.2f} ms")


if __name__ == "__main__":
    main()
