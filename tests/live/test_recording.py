"""Recordings of live flights, however the daemon ends, and their replay."""

from __future__ import annotations

import signal
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from companion.config import CameraConfig
from companion.messages import Frame
from companion.telemetry import PositionSample
from drivers.camera.pattern_camera import world_from_body
from drivers.open_flight import open_flight
from drivers.recording.disk_writer import FAILED
from drivers.recording.flights_folder import recordings_in
from drivers.recording.mcap_file import McapFile
from drivers.recording.mcap_scan import summary
from drivers.recording.recording_as_flight import RecordedFlight
from drivers.recording.recording_reader import CUT
from drivers.telemetry.tlog_records import TlogRecords
from tests.support.autopilot.fake_autopilot import FakeAutopilot
from tests.support.autopilot.fake_flight import MadeUpFlight
from tests.support.autopilot.fake_wire import free_port
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import N_FEATURES
from tests.support.processes.program import replay, replay_here
from tests.support.processes.strain import Strain

SETTINGS = (
    "camera.source=pattern", "camera.rate_hz=15", "camera.width=320", "camera.height=240",
    "depth.enabled=false", "daemon.flight=always", "expert.recorder.least_free_mb=0",
    f"expert.features.n_features={N_FEATURES}",
)  # fmt: skip
OLDER_S = 1.0
"""What is older than this when all is killed is on the disk."""


def processes() -> list[psutil.Process]:
    """The daemon, and all that it has started."""
    (daemon,) = (p for p in psutil.Process().children() if "companion" in p.cmdline())
    return [daemon, *daemon.children(recursive=True)]


def kill(victims: list[psutil.Process]) -> None:
    for victim in victims:
        victim.send_signal(signal.SIGKILL)
    psutil.wait_procs(victims, 60)


def recorded(folder: Path) -> RecordedFlight:
    (flight,) = (folder / "flights").glob("[!.]*")
    opened = open_flight(flight, CameraConfig())
    assert isinstance(opened, RecordedFlight)
    return opened


def fly(folder: Path, seconds: float, *settings: str) -> Daemon:
    """A daemon that has recorded for so long."""
    daemon = Daemon(folder, *SETTINGS, *settings)
    daemon.__enter__()
    daemon.until(lambda health: health["tracker"] in ("tracking", "initialising"))
    daemon.until(partial(records, n_restarted=0), "it records")
    time.sleep(seconds)
    return daemon


@pytest.mark.parametrize("codec", ["mjpeg", "h264"])
def test_killed_at_once_with_all_that_it_started_it_loses_less_than_a_second(
    tmp_path: Path, codec: str
) -> None:
    with Strain() as strain, FakeAutopilot("px4", f"udpout:127.0.0.1:{free_port()}") as autopilot:
        daemon = fly(tmp_path, 5, f"link.url={autopilot.url}", f"recorder.codec={codec}")
        try:
            everything = processes()
            before_ns, killed_ns = time.monotonic_ns(), time.time_ns()
            kill(everything)
        finally:
            daemon.__exit__(None, None, None)
        allowed_s = strain.allowed_s(OLDER_S, before_ns - round(OLDER_S * 1e9))
    (flight,) = (tmp_path / "flights").glob("[!.]*")
    with McapFile(flight / "flight.mcap") as file:
        assert summary(file) is None
    opened = recorded(tmp_path)
    assert CUT in [warning.what for warning in opened.warnings]
    assert (killed_ns - opened.times_ns[-1]) * 1e-9 < allowed_s
    last_ns = max(sample.t_ns for sample in opened.telemetry().samples)
    assert (killed_ns - last_ns) * 1e-9 < allowed_s
    assert sum(isinstance(frame, Frame) for frame in opened.frames()) == opened.n_frames > 30
    tlog = TlogRecords((flight / "flight.tlog").read_bytes())
    assert (killed_ns // 1000 - list(tlog)[-1].unix_us) * 1e-6 < allowed_s


def test_without_its_daemon_the_recording_ends_whole(tmp_path: Path) -> None:
    daemon = fly(tmp_path, 2)
    try:
        whole, *children = processes()
        kill([whole])
        assert not psutil.wait_procs(children, 60)[1]
    finally:
        daemon.__exit__(None, None, None)
    (flight,) = (tmp_path / "flights").glob("[!.]*")
    with McapFile(flight / "flight.mcap") as file:
        assert summary(file) is not None
    assert recorded(tmp_path).warnings == ()


def test_two_replays_of_a_live_flight_give_the_same_bytes(tmp_path: Path) -> None:
    flight = MadeUpFlight(lambda t_s: world_from_body(round(t_s * 1e9)))
    with FakeAutopilot("ardupilot", f"udpout:127.0.0.1:{free_port()}", flight) as autopilot:
        autopilot.fly(at_monotonic_ns=0, arm=False)
        with Daemon(
            tmp_path, *SETTINGS, f"link.url={autopilot.url}", "recorder.codec=png"
        ) as daemon:
            seen = daemon.until(lambda health: health["tracker"] == "tracking")
            n_enough = done(seen) + 120
            daemon.until(lambda health: done(health) > n_enough, "eight seconds tracked")
            daemon.stop()
    (folder,) = (tmp_path / "flights").glob("[!.]*")
    opened = recorded(tmp_path)
    sources = {s.source for s in opened.telemetry().samples if isinstance(s, PositionSample)}
    assert opened.n_frames > 60 and len(sources) == 3
    for replayed, out in ((replay, "a"), (replay_here, "b")):
        run = replayed(folder, tmp_path / out, "--set", "depth.enabled=false")
        assert run.status == 0, run.stderr
    a, b = ((tmp_path / out / "trajectory.tum").read_bytes() for out in ("a", "b"))
    assert a == b
    tracked = np.loadtxt(a.decode().splitlines())
    assert len(tracked) > 0.6 * opened.n_frames


def test_a_recorder_that_dies_goes_on_in_another_part(tmp_path: Path) -> None:
    daemon = fly(tmp_path, 1)
    try:
        daemon.signal_stage("recorder", signal.SIGKILL)
        daemon.line("a stage has died and is started again: recorder")
        daemon.until(partial(records, n_restarted=1), "it records again")
        time.sleep(3)
        daemon.stop()
    finally:
        daemon.__exit__(None, None, None)
    (folder,) = (tmp_path / "flights").glob("[!.]*")
    parts = [open_flight(p, CameraConfig()) for p in recordings_in(folder)]
    assert [p.path.parent.name for p in parts] == [folder.name, "part-2"]
    assert parts[0].stop_ns < parts[1].start_ns and min(p.n_frames for p in parts) > 5
    assert parts[1].warnings == ()


def test_a_disk_that_takes_nothing_ends_the_recording_not_the_flight(tmp_path: Path) -> None:
    daemon = fly(tmp_path, 2)
    try:
        full_ns = daemon.fill_disk_of("recorder")
        daemon.line(FAILED, after_ns=full_ns)
        n_before = done(daemon.status())
        daemon.until(lambda health: done(health) > n_before + 15, "frames are tracked")
        assert not daemon.said("a stage has died")
        daemon.stop()
    finally:
        daemon.__exit__(None, None, None)
    opened = recorded(tmp_path)
    assert opened.n_frames > 10


def records(health: dict[str, Any], n_restarted: int) -> bool:
    """Whether the recorder is up, after so many restarts."""
    found = [stage for stage in health["stages"] if stage["name"] == "recorder"]
    return bool(
        found and found[0]["alive"] and found[0]["detail"] != "starting"
        and found[0]["n_restarted"] == n_restarted
    )  # fmt: skip


def done(health: dict[str, Any]) -> int:
    """Frames that localisation has worked on."""
    return sum(stage["n"] for stage in health["stages"] if stage["name"] == "localisation")
