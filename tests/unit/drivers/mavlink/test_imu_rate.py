"""The rate of the IMU by what came of it, and of the others."""

from __future__ import annotations

import random
from collections import Counter, defaultdict

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.doctor.imu_room import ImuRoom
from drivers.mavlink.imu_rate import FEWER, NO_IMU, ImuNews, ImuRate
from drivers.mavlink.message_rates import MessageRates
from drivers.telemetry.mavlink_samples import Wanted

ATTITUDE, PRESSURE, HIGHRES_IMU = 31, 29, 105
BYTES = {ATTITUDE: 44, PRESSURE: 28, HIGHRES_IMU: 75}
ALONE = {ATTITUDE: 1.0, PRESSURE: 0.98}
ROOM = ImuRoom("HIGHRES_IMU", 100.0)


class Simulated:
    """An autopilot and its messages, in time of their own; what finds no room is left out."""

    def __init__(self, most_hz: float = 400.0, bytes_per_s: float = 1e6) -> None:
        wants = [Wanted((31, 30), 50.0), Wanted((29,), 10.0), Wanted((32,), 10.0, always=False)]
        self.rates, self.imu = MessageRates(wants), ImuRate()
        self.most_hz, self.bytes_per_s = most_hz, bytes_per_s
        self.sent_hz: dict[int, float] = {}
        self.came: Counter[int] = Counter()
        self.asked: list[tuple[float, int, float]] = []
        self.news: list[ImuNews] = []
        self._t_ms, self._free, self._next_ms = 0, 0.0, defaultdict[int, float](float)

    def run(self, seconds: float) -> None:
        self.came.clear()
        for _ in range(round(seconds * 1000)):
            self._t_ms += 1
            self._send()
            now_ns = self._t_ms * 1_000_000
            if self._t_ms % 100 == 0 and (news := self.imu.step(self.rates, ROOM)) is not None:
                self.news.append(news)
            while self._t_ms % 100 == 0 and (due := self.rates.due(now_ns)) is not None:
                self.asked.append((self._t_ms * 1e-3, *due))
                self.sent_hz[due[0]] = due[1]
                self.rates.asked(due[0], False, now_ns)

    def reboot(self) -> None:
        self.sent_hz.clear()
        self.rates.restart()
        self.imu.restart(rebooted=True)

    def of_imu(self) -> list[float]:
        """Rates that were asked for."""
        return [rate_hz for _, kind, rate_hz in self.asked if kind == HIGHRES_IMU]

    def _send(self) -> None:
        self._free = min(self._free + self.bytes_per_s * 1e-3, 200.0)
        for kind, rate_hz in self.sent_hz.items():
            if rate_hz and self._t_ms >= self._next_ms[kind]:
                self._next_ms[kind] = max(self._t_ms, self._next_ms[kind]) + 1000 / min(
                    rate_hz, self.most_hz
                )
                if self._free > 0:
                    self._free -= BYTES.get(kind, 40)
                    self.came[kind] += 1
                    self.rates.came(kind)


def begun(room: ImuRoom = ROOM) -> ImuRate:
    rate = ImuRate()
    rate.begin(room, ALONE)
    return rate


def test_best_message_that_fits() -> None:
    assert (begun().ids, begun().asked_hz) == ((105, 26, 27), 100.0)
    assert begun(ImuRoom("RAW_IMU", 50.0)).ids == (26, 27)


def test_no_room_is_said_and_nothing_asked() -> None:
    rate = ImuRate()
    news = rate.begin(ImuRoom("HIGHRES_IMU", 0.0, "57600 baud have no room"), ALONE)
    assert news is not None and (news.what, news.detail) == (NO_IMU, "57600 baud have no room")
    assert rate.asked_hz == 0 and str(rate) == "no IMU: 57600 baud have no room"
    assert rate.judge(30.0, {}) is None and rate.asked_hz == 0


def test_what_comes_as_asked_stays() -> None:
    rate = begun()
    for came_hz in (97.0, 81.0, 100.0, 60.0, 99.0, 70.0, 101.0):  # never twice in a row
        assert rate.judge(came_hz, ALONE) is None
    assert rate.asked_hz == 100 and str(rate) == "IMU 101 of 100 Hz"


def test_less_that_came_is_asked_for() -> None:
    rate = begun()
    assert rate.judge(66.0, ALONE) is None
    news = rate.judge(67.0, ALONE)
    assert news is not None and news.what == FEWER
    assert news.detail == "67 of 100 Hz came: 67 Hz from now on"
    assert rate.asked_hz == pytest.approx(1000 / 15)  # in whole milliseconds


def test_under_50_hz_none_is_asked_for() -> None:
    rate = begun()
    rate.judge(40.0, ALONE)
    news = rate.judge(40.0, ALONE)
    assert news is not None and news.what == NO_IMU and "40 of 100 Hz came" in news.detail
    assert rate.asked_hz == rate.want.rate_hz == 0
    assert str(rate).startswith("no IMU: 40 of 100 Hz came")


def test_it_is_halved_where_others_suffer() -> None:
    rate = begun()
    rate.judge(99.0, {ATTITUDE: 0.7, PRESSURE: 1.0})
    news = rate.judge(99.0, {ATTITUDE: 0.79, PRESSURE: 1.0})
    assert news is not None and "other messages became fewer" in news.detail
    assert rate.asked_hz == 50
    for _ in range(4):
        assert rate.judge(50.0, {ATTITUDE: 0.9, PRESSURE: 0.81}) is None
    rate.judge(50.0, {ATTITUDE: 0.7})
    assert rate.judge(50.0, {ATTITUDE: 0.7}) is not None
    assert rate.asked_hz == 0


def test_others_that_were_few_before_are_no_reason() -> None:
    rate = ImuRate()
    rate.begin(ROOM, {ATTITUDE: 0.2, PRESSURE: 0.0})
    for _ in range(5):
        assert rate.judge(100.0, {ATTITUDE: 0.19, PRESSURE: 0.0}) is None
    assert rate.asked_hz == 100


def test_a_download_is_no_reason() -> None:
    rate = begun()
    for _ in range(10):
        for _ in range(30):
            rate.heard(mavlink.MAVLINK_MSG_ID_PARAM_VALUE)
        assert rate.judge(25.0, {ATTITUDE: 0.25}) is None
    assert rate.judge(25.0, {ATTITUDE: 0.25}) is None  # the first that counts
    rate.heard(mavlink.MAVLINK_MSG_ID_PARAM_VALUE)  # a single one
    assert rate.judge(25.0, {ATTITUDE: 0.25}) is not None


def test_nothing_at_all_is_a_lost_request() -> None:
    rate = begun()
    for _ in range(10):
        assert rate.judge(0.0, ALONE) is None
    assert rate.asked_hz == 100 and str(rate) == "IMU 0 of 100 Hz"


@pytest.mark.parametrize("seed", range(20))
def test_it_only_goes_down_and_few_times(seed: int) -> None:
    chance, rate = random.Random(seed), begun()
    asked, n_news = [rate.asked_hz], 0
    for _ in range(400):
        shares = {ATTITUDE: chance.uniform(0.5, 1.0), PRESSURE: chance.uniform(0.5, 1.0)}
        came_hz = rate.asked_hz * chance.uniform(0.3, 1.2)
        n_news += rate.judge(came_hz, shares) is not None
        asked.append(rate.asked_hz)
    assert asked == sorted(asked, reverse=True)
    assert n_news == len(set(asked)) - 1 <= 4


def test_the_last_refusal_is_the_end() -> None:
    rate = begun()
    assert rate.refused(105) is None and rate.refused(26) is None and rate.asked_hz == 100
    news = rate.refused(27)
    assert news is not None and news.what == NO_IMU and rate.asked_hz == 0
    assert str(rate) == "no IMU: it has no message for it"
    assert rate.judge(0.0, ALONE) is None


def test_silence_keeps_what_was_found_and_a_reboot_forgets_it() -> None:
    rate = begun()
    rate.judge(67.0, ALONE)
    rate.judge(67.0, ALONE)
    rate.restart(rebooted=False)
    assert not rate.begun and rate.asked_hz == 0 and str(rate) == ""
    assert rate.begin(ROOM, ALONE) is None
    assert rate.asked_hz == pytest.approx(1000 / 15)
    rate.restart(rebooted=True)
    rate.begin(ROOM, ALONE)
    assert rate.asked_hz == 100


def test_what_was_too_little_stays_so_after_silence() -> None:
    rate = begun()
    rate.judge(30.0, ALONE)
    rate.judge(30.0, ALONE)
    rate.restart(rebooted=False)
    news = rate.begin(ROOM, ALONE)
    assert news is not None and news.what == NO_IMU and rate.asked_hz == 0


def test_asked_for_after_the_others_were_measured_and_once() -> None:
    autopilot = Simulated()
    autopilot.run(60)
    assert autopilot.of_imu() == [100.0] and not autopilot.news
    assert next(t_s for t_s, kind, _ in autopilot.asked if kind == HIGHRES_IMU) >= 3.0
    assert str(autopilot.imu) == "IMU 100 of 100 Hz"


def test_after_a_reboot_it_is_asked_for_again() -> None:
    autopilot = Simulated()
    autopilot.run(10)
    autopilot.reboot()
    autopilot.run(10)
    assert autopilot.of_imu() == [100.0, 100.0] and autopilot.came[HIGHRES_IMU] > 500


def test_an_autopilot_that_sends_less() -> None:
    autopilot = Simulated(most_hz=66.0)
    autopilot.run(60)
    first, *_, last = autopilot.of_imu()
    assert first == 100 and last == pytest.approx(62.5, abs=5)
    assert [each.what for each in autopilot.news] == [FEWER]


def test_a_slow_loop_leaves_none() -> None:
    autopilot = Simulated(most_hz=40.0)
    autopilot.run(60)
    assert autopilot.of_imu()[-1] == 0 and [each.what for each in autopilot.news] == [NO_IMU]
    autopilot.run(60)
    assert autopilot.came[HIGHRES_IMU] == 0


@pytest.mark.parametrize("bytes_per_s", [3000.0, 4000.0, 6000.0, 8000.0])
def test_a_line_that_carries_less_settles_and_the_others_have_their_rates(
    bytes_per_s: float,
) -> None:
    autopilot = Simulated(bytes_per_s=bytes_per_s)
    autopilot.run(60)
    n_asked = len(autopilot.of_imu())
    autopilot.run(90)
    assert len(autopilot.of_imu()) == n_asked <= 6
    assert autopilot.came[ATTITUDE] >= 0.8 * 50 * 90
    assert autopilot.came[PRESSURE] >= 0.8 * 10 * 90
    assert autopilot.news and autopilot.imu.asked_hz < 100
    assert autopilot.imu.asked_hz == 0 or autopilot.came[HIGHRES_IMU] >= 0.8 * 50 * 90
