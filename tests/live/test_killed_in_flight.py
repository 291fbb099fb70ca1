"""The daemon is killed in flight and restarted: the autopilot gets another reset counter."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np

from tests.support.autopilot.received_poses import poses_of
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import Flying


def test_the_next_process_counts_on(tmp_path: Path) -> None:
    with Flying(tmp_path, "daemon.flight=always", "recorder.enabled=false") as flying:
        flying.until_sending()
        assert flying.poses.resets[0] == 0
        os.kill(flying.daemon.pid, signal.SIGKILL)
        flying.daemon.ended(60)
        last_sent = int(flying.poses.resets[-1])
        kept = json.loads((tmp_path / "sent_poses.json").read_text())["reset_counter"]
        assert kept >= last_sent
        flying.autopilot.clear()
        with Daemon(tmp_path, *flying.daemon.settings) as again:
            again.until(lambda health: health["feedback"]["sending"], "poses")
            # what the first had sent may have been read late
            from_ns = again.started_ns + 500_000_000
            came = flying.autopilot.wait_for(
                "ODOMETRY", 15, 60, lambda got: got.monotonic_ns > from_ns
            )
            poses = poses_of(came)
            assert poses.resets[0] > kept
            assert again.status()["feedback"]["n_resets"] >= poses.resets[-1]
            # the autopilot is switched off and on: it has seen nothing yet
            flying.autopilot.clear()
            flying.autopilot.reboot(silent_s=1.0)
            again.line("autopilot rebooted")
            flying.autopilot.wait_for(
                "ODOMETRY", 15, 60, lambda got: got.message.reset_counter == 0
            )
            resets = poses_of(flying.autopilot.of("ODOMETRY")).resets
            assert not np.count_nonzero(np.diff(resets) > 0)
