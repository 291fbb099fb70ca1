"""sd_notify messages of the daemon: ready when its stages are, alive only while poses come."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from companion.daemon.health_watch import PATIENCE_NS
from companion.daemon.periodic_checks import NO_PROGRESS
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import N_FEATURES
from tests.support.waiting import PATIENCE_S, until

PATTERN = (
    "camera.source=pattern", "camera.width=320", "camera.height=240", "camera.rate_hz=10",
    "daemon.flight=always", "recorder.enabled=false", f"expert.features.n_features={N_FEATURES}",
)  # fmt: skip


class ServiceManager:
    """The socket that systemd would hold; notices by their arrival."""

    def __init__(self, path: Path) -> None:
        self.notices: list[tuple[float, str]] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._hear, name="service manager")
        self._thread.start()

    def _hear(self) -> None:
        while text := self._socket.recv(4096).decode():
            self.notices.append((time.monotonic(), text))

    def last_s(self, start: str) -> float | None:
        """When a notice came last."""
        return max((t_s for t_s, text in self.notices if text.startswith(start)), default=None)

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ServiceManager]:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    manager = ServiceManager(tmp_path / "notify")
    yield manager
    manager.close()


def test_it_is_ready_when_its_stages_are(tmp_path: Path, manager: ServiceManager) -> None:
    with Daemon(tmp_path, *PATTERN, "depth.enabled=false") as daemon:
        until(lambda: manager.last_s("READY=1") is not None)
        stages = {stage["name"]: stage for stage in daemon.status()["stages"]}
        assert all(stage["detail"] != "starting" for stage in stages.values()), stages
        daemon.stop()
        until(lambda: manager.last_s("STOPPING=1") is not None)


def test_without_a_camera_it_is_not_ready(tmp_path: Path, manager: ServiceManager) -> None:
    missing = ("camera.source=v4l2", f"camera.device={tmp_path / 'video0'}")
    with Daemon(tmp_path, *missing, "expert.daemon.missing_device_s=7") as daemon:
        assert daemon.ended(60).status == 1
        assert manager.last_s("EXTEND_TIMEOUT_USEC=") is not None
        assert manager.last_s("READY=1") is None


def test_a_pose_loop_that_hangs_for_good_is_left_to_the_watchdog(
    tmp_path: Path, manager: ServiceManager
) -> None:
    """Every localisation is stopped: the daemon starts others, then says no more that it lives."""
    with Daemon(tmp_path, *PATTERN, "depth.enabled=false") as daemon:
        daemon.until(lambda health: health["tracker"] == "tracking")
        began_s, stopped = time.monotonic(), set[int]()
        while not daemon.said(NO_PROGRESS):
            assert time.monotonic() < began_s + PATIENCE_S
            with contextlib.suppress(AssertionError, psutil.Error, ProcessLookupError):
                pid = daemon.stage("localisation")
                if pid not in stopped:
                    stopped.add(pid)
                    os.kill(pid, signal.SIGSTOP)
            time.sleep(0.02)
        silent_s = time.monotonic()
        assert silent_s - began_s > 0.9e-9 * PATIENCE_NS
        assert len(stopped) > 1  # it tried by itself first
        time.sleep(2.0)
        last_s = manager.last_s("WATCHDOG=1")
        assert last_s is not None and last_s < silent_s + 0.5
        for pid in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        daemon.until(lambda health: health["tracker"] == "tracking")
        until(lambda: (manager.last_s("WATCHDOG=1") or 0.0) > last_s)  # poses: it is alive
