"""Stages that are forked: how they begin, how their end is told, and who dies with whom."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from companion.config import Config
from companion.geometry.camera import Camera
from companion.runtime import fork_server
from companion.runtime.fork_server import ForkServer
from companion.runtime.stage_process import StageProcess
from companion.runtime.stage_protocol import Finish, Setup
from companion.runtime.stages import stage_named
from tests.support.waiting import PATIENCE_S, until

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0)
DAEMON = """
import sys, time
from companion.runtime.fork_server import ForkServer
with ForkServer(sys.argv[1] == "copy") as server:
    from tests.unit.runtime.test_fork_server import Viewers
    viewers = Viewers(server)
    viewers.begin()
    print(server.pid, viewers.stage.pid, flush=True)
    time.sleep(600)
"""


class Viewers:
    """A process of the stage for viewers, and how it ended."""

    def __init__(self, server: ForkServer) -> None:
        self.ended: list[str] = []
        self.stage = StageProcess(
            stage_named("viewers"), server.start, lambda parcel: None, self.ended.append
        )

    def begin(self) -> psutil.Process:
        """Wait until it is ready; its process."""
        self.stage.begin(Setup(Config(), CAMERA, Path("flight")))
        until(lambda: self.stage.progress is not None)
        return psutil.Process(self.stage.pid)

    def end(self) -> str:
        """Wait for its end: the reason."""
        until(lambda: bool(self.ended))
        self.stage.kill()
        return self.ended[0]


@pytest.fixture
def server() -> Iterator[ForkServer]:
    with ForkServer() as begun:
        yield begun


def test_a_stage_is_a_child_of_the_server_under_its_name_and_finishes(server: ForkServer) -> None:
    viewers = Viewers(server)
    child = viewers.begin()
    assert child.ppid() == server.pid
    assert child.name() == "viewers"
    assert os.readlink(f"/proc/{child.pid}/fd/0") == os.readlink(f"/proc/{child.pid}/fd/1")
    viewers.stage.ask_to_finish(Finish(hurry=True))
    assert viewers.stage.wait(PATIENCE_S)
    assert viewers.end() == ""
    assert viewers.stage.has_finished and not viewers.stage.alive


def test_a_prepared_stage_is_the_process_that_waited(server: ForkServer) -> None:
    server.prepare("viewers")
    process = psutil.Process(server.pid)
    until(lambda: len(process.children()) == 1)
    (waiting,) = process.children()
    first, second = Viewers(server), Viewers(server)
    assert first.begin() == waiting and waiting.name() == "viewers"
    assert second.begin() != waiting
    waiting.kill()
    assert first.end() == "killed by SIGKILL"
    second.stage.ask_to_finish(Finish(hurry=True))
    assert second.stage.wait(PATIENCE_S) and second.end() == ""


def test_a_prepared_stage_that_has_died_is_started_anew(server: ForkServer) -> None:
    server.prepare("viewers")
    process = psutil.Process(server.pid)
    until(lambda: len(process.children()) == 1)
    (waiting,) = process.children()
    waiting.kill()
    until(lambda: waiting.status() == psutil.STATUS_ZOMBIE)
    viewers = Viewers(server)
    assert viewers.begin() != waiting
    viewers.stage.kill()


@pytest.mark.parametrize("end", ["ready", "dead"])
def test_other_stages_start_once_that_of_the_pose_is(
    server: ForkServer, end: str, tmp_path: Path
) -> None:
    server.prepare("localisation")
    process = psutil.Process(server.pid)
    until(lambda: len(process.children()) == 1)
    (waiting,) = process.children()
    waiting.suspend()  # in its imports
    pose = StageProcess(
        stage_named("localisation"), server.start, lambda parcel: None, lambda why: None
    )
    until(lambda: pose.pid == waiting.pid)
    viewers = Viewers(server)
    pose.begin(Setup(Config(), CAMERA, tmp_path))
    server.prepare("recorder")  # asked for after viewers, whose turn has thus come
    until(lambda: len(process.children()) == 2)
    assert viewers.stage.pid is None
    if end == "dead":
        waiting.kill()
    else:
        waiting.resume()
    viewers.begin()
    assert end == "dead" or pose.progress is not None
    for stage in (viewers.stage, pose):
        stage.kill()


def test_a_prepared_stage_that_nobody_starts_ends_with_the_server() -> None:
    with ForkServer() as server:
        server.prepare("viewers")
        process = psutil.Process(server.pid)
        until(lambda: len(process.children()) == 1)
        (waiting,) = process.children()
    until(lambda: not waiting.is_running() or waiting.status() == psutil.STATUS_ZOMBIE)


@pytest.mark.parametrize(
    ("number", "why"),
    [(signal.SIGKILL, "killed by SIGKILL"), (signal.SIGSEGV, "killed by SIGSEGV"),
     (signal.SIGALRM, "a driver does not come back")],
)  # fmt: skip
def test_a_signal_that_ends_it_is_told(
    server: ForkServer, number: signal.Signals, why: str
) -> None:
    viewers, others = Viewers(server), Viewers(server)
    child, _ = viewers.begin(), others.begin()
    child.send_signal(number)
    assert viewers.end() == why
    assert others.stage.alive and not others.ended
    others.stage.kill()


def test_stages_outlive_the_server_and_later_ones_start_alone(
    server: ForkServer, capfd: pytest.CaptureFixture[str]
) -> None:
    first = Viewers(server)
    child = first.begin()
    os.kill(server.pid, signal.SIGKILL)
    until(lambda: psutil.Process(server.pid).status() == psutil.STATUS_ZOMBIE)
    assert not capfd.readouterr().err
    for _ in range(2):
        later = Viewers(server)
        assert later.begin().ppid() == os.getpid()
        said = capfd.readouterr().err
        assert "the fork server is gone" in said and "viewers starts alone" in said
        psutil.Process(later.stage.pid).kill()
        assert later.end() == "killed by SIGKILL"
    assert child.is_running() and first.stage.alive and not first.ended
    first.stage.interrupt()
    assert first.end() == "ended, and the fork server does not say how"


def test_the_end_of_a_stage_is_told_where_the_server_is_stopped(
    server: ForkServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fork_server, "ANSWER_S", 0.5)
    first = Viewers(server)
    child = first.begin()
    os.kill(server.pid, signal.SIGSTOP)
    try:
        child.kill()
        assert first.end() == "ended, and the fork server does not say how"
        monkeypatch.setattr(fork_server, "ANSWER_S", 1e6)
        second = Viewers(server)  # for which it forks nothing
        second.stage.begin(Setup(Config(), CAMERA, Path("flight")))
        ending = threading.Thread(target=second.stage.interrupt, daemon=True)
        ending.start()
        ending.join(PATIENCE_S)
        assert not ending.is_alive(), "the event loop, which calls it, is not to wait"
        assert second.end() == "its process could not be started"
    finally:
        os.kill(server.pid, signal.SIGCONT)
    # a late start finds nobody to work for
    until(lambda: not psutil.Process(server.pid).children())


@pytest.mark.parametrize("copy", ["copy", "anew"])
def test_the_death_of_the_daemon_ends_all(copy: str) -> None:
    """Where the server is a copy of the daemon, too."""
    command = [sys.executable, "-c", DAEMON, copy]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    daemon = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    with daemon:
        assert daemon.stdout is not None
        pids = [int(pid) for pid in daemon.stdout.readline().split()]
        server, _ = map(psutil.Process, pids)
        is_copy = "companion.runtime.fork_server_process" not in server.cmdline()
        assert server.name() == "fork server" and is_copy == (copy == "copy")
        assert server.ppid() == daemon.pid
        daemon.kill()
    until(lambda: not any(psutil.pid_exists(pid) for pid in pids))
