"""A stage that dies or hangs in flight affects no other; nor does a viewer."""

from __future__ import annotations

import signal
import socket
import time
from collections.abc import Iterator

import psutil
import pytest

from tests.support.processes.flying import Flying

VIEWER = "companion.streaming.viewer.ground_process"
NO_SIGN_S = 10.0


@pytest.fixture(scope="module")
def viewer_url() -> Iterator[str]:
    """Of a viewer that accepts, and then neither reads nor answers."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        server.listen(50)
        yield f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"


@pytest.fixture(scope="module")
def flying(tmp_path_factory: pytest.TempPathFactory, viewer_url: str) -> Iterator[Flying]:
    folder = tmp_path_factory.mktemp("stages")
    with Flying(
        folder, "depth.enabled=true", "expert.depth.stride=8", f"daemon.viewer={viewer_url}",
        "video.listen=127.0.0.1:0", "landing.marker=apriltag_36h11", "landing.id=0",
        "landing.size_m=2",
    ) as begun:  # fmt: skip
        begun.until_source("camera", "running")
        begun.until_source("autopilot", "running")
        begun.take_off()
        yield begun


@pytest.mark.parametrize("kind", ["depth", "landing", "video", "results"])
def test_what_is_killed_begins_again(flying: Flying, kind: str) -> None:
    flying.until_sending()
    flying.until_stage(kind, lambda found: found["detail"] != "starting")
    killed_ns = flying.daemon.signal_stage(kind, signal.SIGKILL)
    # what only gets the time that is left over needs some of it to end, too
    named_ns = flying.daemon.line(
        f"started again: {kind}: killed by SIGKILL", after_ns=killed_ns
    ).monotonic_ns
    flying.until_stage(kind, lambda found: found["alive"] and found["n_restarted"] == 1)
    flying.assert_soon(named_ns, time.monotonic_ns())
    flying.until_stage(kind, lambda found: found["detail"] != "starting")
    flying.until_told(" restarted", killed_ns)
    flying.assert_went_on(killed_ns)
    flying.assert_true_poses()
    if kind == "results":  # what begins anew writes beside what was written before
        folder = flying.daemon.flown()[-1]
        files = [folder / part / "flight.rrd" for part in (".", "part-2")]
        flying.daemon.until(lambda _: all(file.exists() for file in files), "both are there")


def test_what_hangs_is_named_and_goes_on_when_it_can(flying: Flying) -> None:
    """Depth and results are stopped; what is meant for them waits, and frames give way."""
    flying.until_sending()
    kinds = ("depth", "results")
    stopped_ns = [flying.daemon.signal_stage(kind, signal.SIGSTOP) for kind in kinds]
    try:
        for kind in kinds:
            seen = flying.until_stage(kind, lambda found: not found["alive"], 3 * NO_SIGN_S)
            assert "no sign of it" in seen["detail"]
        flying.daemon.line("results down (no sign of it", after_ns=min(stopped_ns))
    finally:
        for kind in kinds:
            continued_ns = flying.daemon.signal_stage(kind, signal.SIGCONT)
    for kind in kinds:
        flying.until_stage(kind, lambda found: found["alive"] and found["n_dropped"] > 0)
    flying.assert_went_on(min(stopped_ns))
    flying.assert_soon(continued_ns, time.monotonic_ns(), 10.0)
    flying.assert_true_poses()


def viewer_of(flying: Flying) -> psutil.Process | None:
    """The newest process of a viewer."""
    found = [
        child for child in psutil.Process(flying.daemon.pid).children() if VIEWER in child.cmdline()
    ]
    # one of the last flight may still be ending
    return max(found, key=lambda child: child.create_time(), default=None)


def until_viewer(flying: Flying) -> psutil.Process:
    """Wait until there is one."""
    flying.daemon.until(lambda _: viewer_of(flying) is not None, "a viewer")
    found = viewer_of(flying)
    assert found is not None
    return found


def test_a_viewer_that_hangs_or_dies(flying: Flying) -> None:
    flying.until_sending()
    began_ns = time.monotonic_ns()
    viewer = until_viewer(flying)
    viewer.suspend()
    time.sleep(1.5)
    viewer.kill()
    flying.daemon.line("the viewer has gone", after_ns=began_ns)
    until_viewer(flying)
    flying.assert_went_on(began_ns)
    flying.assert_true_poses()


@pytest.mark.parametrize(
    ("number", "named", "within_s"),
    [
        (signal.SIGKILL, "killed by SIGKILL", 0.5),
        (signal.SIGSTOP, "localisation hangs and is ended", 5.0),
    ],
)
def test_another_localisation_takes_over(
    flying: Flying, number: signal.Signals, named: str, within_s: float
) -> None:
    flying.until_sending()
    folder, resets = flying.daemon.flown()[-1], flying.poses.resets[-1]
    lost_ns = flying.daemon.signal_stage("localisation", number)
    flying.assert_ceased(lost_ns)
    named_ns = flying.daemon.line(named, after_ns=lost_ns).monotonic_ns
    flying.assert_soon(lost_ns, named_ns, within_s)
    flying.daemon.line("localisation has died", after_ns=lost_ns)
    flying.until_stage("localisation", lambda found: found["detail"] != "starting")
    flying.assert_soon(named_ns, time.monotonic_ns())
    # nothing ties the new map to the old: the autopilot is told so
    flying.until_sending()
    assert flying.poses.resets[-1] > resets
    flying.daemon.line("its results go to", after_ns=lost_ns)
    flying.daemon.line(f"flight over: {folder}", after_ns=lost_ns)
    assert list(folder.rglob("report.json"))
    flying.assert_true_poses()


def test_it_still_ends_in_time_and_leaves_nothing_behind(flying: Flying) -> None:
    """Even where results and viewer hang."""
    flying.until_sending()
    children = psutil.Process(flying.daemon.pid).children(recursive=True)
    flying.daemon.signal_stage("results", signal.SIGSTOP)
    viewer = viewer_of(flying)
    if viewer is not None:
        viewer.suspend()
    flying.assert_stops()
    psutil.wait_procs(children, timeout=60)
    assert not [child for child in children if child.is_running()]
    assert not flying.daemon.said("Traceback")
