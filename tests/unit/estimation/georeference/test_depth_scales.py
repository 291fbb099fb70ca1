"""Scale of a map by the depths of a stereo pair, and what is said of a wrong baseline."""

from __future__ import annotations

import pytest

from companion.estimation.georeference.depth_verdict import (
    AGREES_AGAIN,
    CONTRADICTED,
    N_AGREEING,
    DepthVerdict,
)
from companion.estimation.georeference.trajectory_alignment import Scale
from tests.support.flights.rendered_flight import Flown, fly
from tests.support.flights.stereo_flight import (
    FIRST,
    ground,
    ned_from_body,
    stereo_depths,
    with_baseline,
)

SECONDS, RATE_HZ, MEASURED_HZ = 8.0, 10.0, 2.5


def flown(use: str, stretched: float = 1.0) -> Flown:
    depths = stereo_depths(with_baseline(stretched), SECONDS, MEASURED_HZ)
    return fly(
        FIRST, ned_from_body, ground(), SECONDS, RATE_HZ, imu_seed=3, beside=depths,
        settings=[f"telemetry.use=[{use}]"],
    )  # fmt: skip


@pytest.mark.parametrize("use", ['"attitude","depth"', '"attitude","imu","depth"'])
def test_depths_give_the_scale_from_the_first_map_on(use: str) -> None:
    flight = flown(use)
    errors, found = flight.errors(), flight.result.georeference
    assert found is not None
    print(f"{100 * errors.scale_error:.2f} % off, {100 * found.sigma_scale:.2f} % stated")
    assert found.method in ("measured depths", "accelerometers"), "whichever is more certain"
    assert errors.scale_error < 0.01
    assert errors.scale_error < 3.0 * found.sigma_scale
    metric = next(o for o in flight.odometry if o.world_from_body is not None)
    first_map_s = flight.keyframes_s[1]
    assert metric.t_ns - flight.frames_ns[0] < (first_map_s + 0.5) * 1e9
    assert CONTRADICTED not in flight.warnings


def test_a_wrong_baseline_contradicts_positions_and_is_said() -> None:
    flight = flown('"attitude","position","depth"', stretched=1.1)
    assert CONTRADICTED in flight.warnings
    assert flight.errors().scale_error < 0.03


def test_a_wrong_baseline_contradicts_accelerometers_and_is_said() -> None:
    flight = flown('"attitude","imu","depth"', stretched=1.1)
    assert CONTRADICTED in flight.warnings
    found = flight.result.georeference
    assert found is not None
    assert found.sigma_scale > 0.05, "it is not certain which of them is right"


def test_a_verdict_is_of_several_comparisons() -> None:
    verdict, others = DepthVerdict(), Scale(10.0, 0.01, "GPS", 9)
    wrong, right = Scale(11.0, 0.01, "", 9), Scale(10.1, 0.01, "", 9)
    said = [verdict.compare(k, wrong, others) for k in range(N_AGREEING)]
    assert [len(each) for each in said] == [0] * (N_AGREEING - 1) + [1]
    (warned,) = said[-1]
    assert (warned.what, warned.good) == (CONTRADICTED, False)
    assert "+9.5 % longer than by GPS" in warned.detail
    assert not any(verdict.compare(k, wrong, None) for k in range(9))
    assert not verdict.compare(1, right, others)
    said = [verdict.compare(k, right, others) for k in range(N_AGREEING - 1)]
    assert [each.what for each in said[-1]] == [AGREES_AGAIN]
