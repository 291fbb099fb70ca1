"""The bench of consistency, given errors that are as large as is stated, and others."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest

from companion.estimation.gate.pose_to_send import PoseToSend
from companion.geometry.transforms import Pose
from companion.telemetry import AttitudeSample, ImuSample
from tests.bench.consistency import KINDS, Truth, compare, told
from tests.support.flights.noisy_telemetry import BIAS_ACCEL_M_S2, SIGMA_ACCEL_M_S2, with_noise

SAMPLE = Path(__file__).parents[3] / "sample" / "survey"
SIGMA_M, SIGMA_M_S, SIGMA_YAW_RAD = 0.1, 0.05, 0.001


def sent_with_errors(truth: Truth, times_ns: np.ndarray, inflation: float) -> list[PoseToSend]:
    """The truth with white errors, stated smaller by a factor; a way has those of both its ends."""
    rng, true = np.random.default_rng(7), truth.at(times_ns)
    out = []
    for k, t_ns in enumerate(times_ns):
        turn = true.turns[k].as_matrix()
        yaw = rng.normal(scale=SIGMA_YAW_RAD)
        north = np.array([[1, -yaw, 0], [yaw, 1, 0], [0, 0, 1]])
        place_m = true.places_m[k] + rng.normal(scale=SIGMA_M / 2**0.5, size=3)
        velocity = north @ true.velocities_m_s[k] + rng.normal(scale=SIGMA_M_S, size=3)
        out.append(
            PoseToSend(
                int(t_ns), Pose(north @ turn, place_m), velocity, SIGMA_M / inflation,
                SIGMA_M_S / inflation, 0.01, SIGMA_YAW_RAD / inflation, 90, 0,
            )
        )  # fmt: skip
    return out


@pytest.mark.parametrize("inflation", [1.0, 2.0])
def test_errors_as_stated_give_one_and_twice_as_large_ones_four(inflation: float) -> None:
    truth = Truth(SAMPLE)
    first_ns = int((SAMPLE / "frames.csv").read_text().splitlines()[1].split(",")[1])
    times_ns = first_ns + np.arange(0, 40_000_000_000, 20_000_000)
    found: dict[str, list[float]] = defaultdict(list)
    compare(sent_with_errors(truth, times_ns, inflation), truth, found)
    for kind in ("place", "velocity", "heading"):
        values = np.array(found[kind])
        assert np.mean(values) / (1 if kind == "heading" else 3) == pytest.approx(
            inflation**2, rel=0.12
        ), kind
    assert set(found) <= set(KINDS)
    assert len(found["place"]) < len(found["velocity"]) == len(times_ns)


def test_the_share_beyond_the_bound() -> None:
    assert told("velocity", [0.0] * 95 + [30.0] * 5) == "0.50 (5 %)"
    assert told("heading", [0.0] * 90 + [30.0] * 10) == "3.00 (10 %)"
    assert told("NIS flow", []) == "-"


def test_noise_of_a_seed_is_always_the_same_and_as_large_as_said() -> None:
    level = [
        ImuSample(k * 10_000_000, np.zeros(3), np.array([0.0, 0.0, -9.81])) for k in range(4000)
    ]
    attitudes = [AttitudeSample(k * 10_000_000, np.array([1.0, 0, 0, 0])) for k in range(4000)]
    noisy = [s for s in with_noise(level, 3) if isinstance(s, ImuSample)]
    off = np.stack([s.accel_m_s2 for s in noisy]) - level[0].accel_m_s2
    assert off.std(0) == pytest.approx(SIGMA_ACCEL_M_S2, rel=0.05)
    assert 0.0 < np.abs(off.mean(0)).max() < 4 * BIAS_ACCEL_M_S2
    again = [s for s in with_noise(level, 3) if isinstance(s, ImuSample)]
    assert all((a.accel_m_s2 == b.accel_m_s2).all() for a, b in zip(noisy, again, strict=True))
    turned = [s for s in with_noise(attitudes, 3) if isinstance(s, AttitudeSample)]
    tilts = np.degrees([2 * s.ned_from_body[1] for s in turned])
    assert 0.1 < tilts.std() < 0.4
    assert list(with_noise(level, 0)) == level
