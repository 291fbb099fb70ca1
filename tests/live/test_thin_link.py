"""The link table in short: one flight in a network namespace, watched from another."""

from __future__ import annotations

import os
import subprocess

import numpy as np
import pytest

from tests.support.flights import flown
from tests.support.flights.message_log import MessageLogWriter
from tests.support.processes.link_trial import Trial, fly
from tests.support.processes.two_namespaces import TwoNamespaces, why_not
from tests.unit.streaming.test_viewer_recording import CAMERA

pytestmark = pytest.mark.light
KBIT_S, DELAY_MS, LOSS, BUDGET_KBIT_S = 1000, 50, 0.02, 800
SECONDS, CUT_S, BACK_S = 22.0, 8.0, 12.0


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> Trial:
    reason = why_not()
    if reason and "namespaces" in os.environ.get("COMPANION_REQUIRE", ""):
        pytest.fail(reason)
    if reason:
        pytest.skip(reason)
    folder = tmp_path_factory.mktemp("link")
    with MessageLogWriter(folder / "log", CAMERA, None) as writer:
        writer.take(flown.update())
        for message in flown.messages()[:-1]:
            writer.take(message)

    def meanwhile(now_s: float, ground: subprocess.Popen[bytes]) -> None:
        air.cut(CUT_S <= now_s < BACK_S)

    with TwoNamespaces(KBIT_S, DELAY_MS, LOSS) as air:
        return fly(air, folder / "log", folder, SECONDS, BUDGET_KBIT_S, meanwhile)


def test_the_pose_is_fresh(trial: Trial) -> None:
    ages = trial.pose_age_s(trial.began_s + 2, trial.began_s + CUT_S)
    assert np.percentile(ages, 95) < 1.0


def test_after_an_outage_state_and_map_are_there_again(trial: Trial) -> None:
    back_s = trial.began_s + BACK_S
    first = min(at for at, t in trial.poses if t > back_s - 1.0)
    assert first - back_s < 4.0
    told = {k for k, t in trial.given.items() if t < trial.ended_s - 5}
    assert len(told) > 12 and told <= set(trial.coarse)
    late_s = max(trial.coarse[k] - back_s for k in told if trial.given[k] < back_s)
    assert late_s < 10


def test_no_more_is_sent_than_the_budget_allows(trial: Trial) -> None:
    rates = [n / 125 for at, n in trial.bytes_per_s if at > trial.began_s + 2]
    assert max(rates) < 1.1 * BUDGET_KBIT_S
    assert np.mean(rates) > 0.1 * BUDGET_KBIT_S


def test_the_flight_is_not_held_up_and_nothing_grows(trial: Trial) -> None:
    assert trial.dropped == 0 and trial.slowest_take_ms < 500
    settled = [m for at, m in trial.exporter_mib if at > trial.began_s + 5]
    assert max(settled) < settled[0] + 20


def test_the_viewer_says_what_it_sees(trial: Trial) -> None:
    assert trial.facts["state"] in ("Tracking", "Dead reckoning")
    assert trial.facts["budget_kbit_s"] == BUDGET_KBIT_S
