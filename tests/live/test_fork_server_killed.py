"""The server from which stages are forked dies in flight."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import psutil

from tests.support.processes.flying import Flying

FORK_SERVER = "fork server"


def test_a_flight_outlives_the_fork_server(tmp_path: Path) -> None:
    with Flying(tmp_path) as flying:
        flying.until_source("camera", "running")
        flying.until_source("autopilot", "running")
        flying.take_off()
        flying.until_stage("results", lambda found: found["detail"] != "starting")
        daemon = psutil.Process(flying.daemon.pid)
        (server,) = (child for child in daemon.children() if child.name() == FORK_SERVER)
        stages = {child.name(): child for child in server.children()}
        assert {"localisation", "recorder", "results"} <= stages.keys()
        try:
            killed_ns = time.monotonic_ns()
            server.kill()
            stages.pop("results").kill()
            why = "ended, and the fork server does not say how"
            flying.daemon.line(f"started again: results: {why}", after_ns=killed_ns)
            flying.daemon.line("the fork server is gone", after_ns=killed_ns)
            flying.until_stage("results", lambda found: found["n_restarted"] == 1)
            flying.until_stage("results", lambda found: found["detail"] != "starting")
            assert psutil.Process(flying.daemon.stage("results")).ppid() == daemon.pid
            # of one that is a child of the daemon itself the end is known in full
            again_ns = flying.daemon.signal_stage("results", signal.SIGKILL)
            flying.daemon.line("started again: results: killed by SIGKILL", after_ns=again_ns)
            assert all(stage.is_running() for stage in stages.values())
            flying.assert_went_on(killed_ns)
            flying.assert_true_poses()
            flying.assert_stops()
            psutil.wait_procs(list(stages.values()), timeout=60)
            assert not [stage for stage in stages.values() if stage.is_running()]
            assert not flying.daemon.said("Traceback")
        finally:
            for stage in stages.values():  # which nobody else would find any more
                if stage.is_running():
                    stage.kill()
