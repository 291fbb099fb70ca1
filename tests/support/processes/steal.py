"""Processor time that the host gives to others while this machine wants it: /proc/stat's `steal`.

A flight in real time is a measurement, and none of a machine that was away. What fails by a flight
in which the processors were taken is flown again with all that its module flew before it, three
times at most and not for longer than MOST_AGAIN_S in all; then it has no verdict. It says so, and
is skipped. On a machine that is not shared nothing is ever flown again.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from itertools import pairwise

import pytest
from _pytest.runner import runtestprotocol

EVERY_S = 0.5
SPAN_S, SHARE = 2.0, 0.2
"""A fifth of all processors taken for two seconds: poses are late, the dense map is shed."""
FLIGHTS = 3
MOST_AGAIN_S = 1200.0
FLOWN_AGAIN = "flown again"
"""A property of a report, which a worker of pytest-xdist sends with it."""


class Steal:
    """Share of the processors taken by the host, looked at twice a second in a thread."""

    def __init__(self) -> None:
        self._seen: list[tuple[float, float, float]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, name="steal", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()

    def worst(self, from_s: float) -> float:
        """The largest share of SPAN_S since a time by CLOCK_MONOTONIC, 0 to 1."""
        return worst_share([each for each in list(self._seen) if each[0] >= from_s])

    def _look(self) -> None:
        while not self._stop.wait(EVERY_S):
            with open("/proc/stat") as lines:
                ticks = [float(each) for each in lines.readline().split()[1:9]]
            self._seen.append((time.monotonic(), ticks[7], sum(ticks)))


def worst_share(seen: Sequence[tuple[float, float, float]]) -> float:
    """Of (time in s, ticks stolen, ticks in all), the largest stolen share of SPAN_S or, where the
    one who looks was away himself, of longer.
    """
    worst, first = 0.0, 0
    for at, (t_s, stolen, ticks) in enumerate(seen):
        while first + 1 < at and t_s - seen[first + 1][0] >= SPAN_S:
            first += 1
        began_s, stolen_before, ticks_before = seen[first]
        if t_s - began_s >= SPAN_S and ticks > ticks_before:
            worst = max(worst, (stolen - stolen_before) / (ticks - ticks_before))
    return worst


class FlownAgain:
    """The rule, as a plugin of pytest. For tests marked `real_time`."""

    def __init__(self, steal: Steal | None = None) -> None:
        self._steal = steal
        self._module: object = None
        self._begun_s = 0.0
        """When that which the module's tests share was begun."""
        self._before: list[pytest.Item] = []
        """The module's tests so far."""
        self._again_s = 0.0

    def pytest_unconfigure(self) -> None:
        if self._steal is not None:
            self._steal.close()

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        told = {
            f"FLOWN AGAIN {report.nodeid} - {text}": None
            for reports in terminalreporter.stats.values()
            for report in reports
            for name, text in getattr(report, "user_properties", ())
            if name == FLOWN_AGAIN
        }
        for line in told:
            terminalreporter.write_line(line)

    def pytest_runtest_protocol(
        self, item: pytest.Item, nextitem: pytest.Item | None
    ) -> bool | None:
        if item.get_closest_marker("real_time") is None:
            return None
        steal = self._steal = self._steal or Steal()
        module = item.getparent(pytest.Module)
        if module is not self._module:
            self._module, self._begun_s, self._before = module, time.monotonic(), []
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        shares: list[float] = []
        while any(each.failed for each in reports):
            shares.append(steal.worst(self._begun_s))
            if shares[-1] < SHARE:
                break
            if len(shares) == FLIGHTS or self._again_s > MOST_AGAIN_S:
                no_verdict(item, reports, shares)
                break
            taken = f"the host took {100 * shares[-1]:.0f} % of the processors"
            item.user_properties.append((FLOWN_AGAIN, f"{taken} ({len(shares)})"))
            item.session._setupstate.teardown_exact(None)  # what the module shares is flown again
            self._begun_s = time.monotonic()
            for flown, following in pairwise([*self._before, item]):
                runtestprotocol(flown, nextitem=following, log=False)
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
            self._again_s += time.monotonic() - self._begun_s
        self._before.append(item)
        for each in reports:
            item.ihook.pytest_runtest_logreport(report=each)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True


def no_verdict(
    item: pytest.Item, reports: list[pytest.TestReport], shares: Sequence[float]
) -> None:
    """Failed reports say instead that nothing was measured, and why."""
    taken = ", ".join(f"{100 * each:.0f} %" for each in shares)
    for each in reports:
        if each.failed:
            each.outcome = "skipped"
            reason = (
                f"no verdict: the host took {taken} of the processors; failed by {each.longrepr}"
            )
            each.longrepr = (str(item.path), (item.location[1] or 0) + 1, reason)
