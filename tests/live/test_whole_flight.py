"""A whole flight, from power on to the report, flown by the daemon as its users run it."""

from __future__ import annotations

import json
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import CameraConfig
from drivers.open_flight import open_flight
from drivers.recording.flights_folder import UNARMED
from tests.support.autopilot.fake_autopilot import FakeAutopilot, Received
from tests.support.autopilot.fake_flight import RecordedFlight
from tests.support.autopilot.fake_wire import free_port
from tests.support.autopilot.received_poses import Poses, TrueFlight, poses_of
from tests.support.processes.daemon_process import Daemon
from tests.support.processes.flying import STOP_S
from tests.support.processes.program import Run, refused
from tests.support.processes.strain import Strain
from tests.support.reference.scoring import Trajectory, read_ply, read_tum, score
from tests.support.waiting import until

SAMPLE = Path(__file__).parents[2] / "sample" / "survey"
TRUTH = read_tum(SAMPLE / "truth" / "world_from_camera.tum")
ARMS_S, DISARMS_S = 1.0, 42.0
"""After the first picture; the last comes four seconds later: time for the proof of poses after a
gap, on a busy machine."""


@dataclass
class Flown:
    """What was seen of a flight."""

    begins_unix_s: float = 0.0
    """When its first picture was due."""
    strain: Strain = field(default_factory=Strain)
    crowding: float = 1.0
    """So many times more wanted a processor, on average, than there are: it drops frames then."""
    first_pose_allowed_s: float = 0.0
    """After arming; what this machine is given for it."""
    armed_ns: int = 0
    disarmed_ns: int = 0
    before_arming: list[tuple[Path, bool]] = field(default_factory=list)
    """Folders, and whether they are marked as not armed."""
    folder: Path = Path()
    written: set[str] = field(default_factory=set)
    """Its files after disarming."""
    second: Run | None = None
    health: dict[str, Any] = field(default_factory=dict)
    health_after: dict[str, Any] = field(default_factory=dict)
    table: str = ""
    metrics: str = ""
    lines: list[str] = field(default_factory=list)
    stop_s: float = 0.0
    stop_allowed_s: float = 0.0
    """The time that this machine is given for it."""
    received: list[Received] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    @property
    def poses(self) -> Poses:
        return poses_of(self.received)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    folder, out = tmp_path_factory.mktemp("flight"), Flown()
    first_ns = open_flight(SAMPLE, CameraConfig()).start_ns
    udp_port, metrics_port = free_port(), free_port()
    out.begins_unix_s = time.time() + 10.0
    begins_ns = time.monotonic_ns() + round((out.begins_unix_s - time.time()) * 1e9)

    def wait_until(flight_s: float) -> None:
        time.sleep(max(0.0, begins_ns * 1e-9 + flight_s - time.monotonic()))

    settings = (
        "camera.source=file", f"camera.path={SAMPLE}", f"camera.calibration={SAMPLE}/camera.json",
        f"expert.camera.starts_at_unix_s={out.begins_unix_s}",
        f"link.url=udpin:127.0.0.1:{udp_port}", "feedback.mode=odometry",
        f"expert.daemon.prometheus_port={metrics_port}",
        # the IMU is a tenth of a core, here and in the daemon, that the dense map shall have
        "expert.link.imu_hz=0",
    )  # fmt: skip
    with out.strain as strain, Daemon(folder, *settings) as daemon:
        daemon.until(lambda health: True, "it answers")
        autopilot = FakeAutopilot(
            "ardupilot", f"udpout:127.0.0.1:{udp_port}", RecordedFlight(SAMPLE)
        )
        with autopilot:  # it is switched on after the daemon, and before there are pictures
            autopilot.fly(first_ns, begins_ns, arm=False)
            wait_until(ARMS_S)
            daemon.until(lambda _: daemon.flown(), "a flight")
            out.before_arming = [(each, (each / UNARMED).exists()) for each in daemon.flown()]
            autopilot.arm()
            out.armed_ns = time.monotonic_ns()
            wait_until(30)
            out.health = daemon.until(
                lambda health: health["tracker"] == "tracking" and health["feedback"]["sending"],
                "poses", timeout_s=DISARMS_S - 32,
            )  # fmt: skip
            out.table = subprocess.run(
                [sys.executable, "-m", "companion", "status",
                 "--set", f"expert.daemon.socket={daemon.socket}"],
                capture_output=True, text=True, check=True, timeout=20,
            ).stdout  # fmt: skip

            def is_sending() -> bool:
                with urllib.request.urlopen(f"http://127.0.0.1:{metrics_port}/metrics") as answer:
                    out.metrics = answer.read().decode()
                return "companion_feedback_sending 1.0" in out.metrics

            until(is_sending, "poses, by the metrics")  # a busy computer may be late for one
            with Daemon(folder, *settings) as second:  # with the socket of the first, and armed
                out.second = second.ended(60)
            wait_until(DISARMS_S)
            autopilot.disarm()
            out.disarmed_ns = time.monotonic_ns()
            daemon.line("results so far")
            (out.folder,) = daemon.flown()
            out.written = {path.name for path in out.folder.iterdir()}
            out.health_after = daemon.status()
            now_ns = time.monotonic_ns()
            out.crowding += strain.withheld_s(begins_ns, now_ns) / (1e-9 * (now_ns - begins_ns))
            # scale, and one second of proof
            out.first_pose_allowed_s = strain.allowed_s(12.0, out.armed_ns)
            told_ns = time.monotonic_ns()
            out.stop_s = daemon.stop()
            out.stop_allowed_s = strain.allowed_s(STOP_S, told_ns)
            out.received = list(autopilot.received)
            out.texts = autopilot.texts()
        out.lines = [line.text for line in daemon.lines]
    yield out


def test_arming_keeps_the_flight_and_disarming_stops_nothing(flown: Flown) -> None:
    assert flown.before_arming == [(flown.folder, True)]
    assert not (flown.folder / UNARMED).exists()
    assert "companion: armed" in flown.lines
    assert "companion: disarmed" in flown.lines
    (began,) = (line for line in flown.lines if "begins; its results go to" in line)
    assert flown.folder.name in began
    assert flown.health["flight"] == flown.folder.name
    assert flown.health_after["flight"] == flown.folder.name
    assert {"report.json", "report.html", "trajectory.tum", "cloud.ply"} <= flown.written
    n_after = len(flown.poses.between(flown.disarmed_ns + 300_000_000, 2**62))
    print(f"{n_after} poses after disarming")
    assert n_after > 10, "poses go on after disarming"


def test_odometry_is_as_autopilots_want_it(flown: Flown) -> None:
    messages = [each for each in flown.received if each.kind == "ODOMETRY"]
    assert {(each.system, each.component) for each in messages} == {(1, 197)}
    frames = {(each.message.frame_id, each.message.child_frame_id) for each in messages}
    assert frames == {(mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)}
    types = {each.message.estimator_type for each in messages}
    assert types == {mavlink.MAV_ESTIMATOR_TYPE_VIO}
    poses = flown.poses
    assert (np.diff(poses.stamp_us) > 0).all()
    assert poses.quality.min() >= 20 and poses.quality.max() <= 100
    assert poses.sigma_m.min() > 0 and poses.sigma_m.max() <= 1.0
    assert (np.diff(poses.resets) >= 0).all()


def test_odometry_comes_at_thirty_hertz(flown: Flown) -> None:
    """Of a camera that gives ten pictures a second: two poses in three are predicted."""
    came_s = flown.poses.came_s
    gaps_s = np.diff(came_s)
    assert np.median(gaps_s) < 0.04
    sent = gaps_s < 0.25
    sending_s = gaps_s[sent].sum()
    # that the machine gave the sender no processor makes an interval longer, and none shorter
    came_ns = np.round(1e9 * came_s).astype(int)
    withheld_s = [flown.strain.withheld_s(*each) for each in pairwise(came_ns)]
    paced_s = np.maximum(gaps_s - withheld_s, np.minimum(gaps_s, 1 / 30))
    rate_hz = sent.sum() / paced_s[sent].sum()
    print(f"{sent.sum() / sending_s:.1f} Hz, {rate_hz:.1f} Hz without what was withheld,"
          f" for {sending_s:.1f} s of {came_s[-1] - came_s[0]:.1f} s")  # fmt: skip
    assert rate_hz > 29.0
    assert came_s[0] - flown.armed_ns * 1e-9 < flown.first_pose_allowed_s
    assert sending_s > 0.75 / flown.crowding * (came_s[-1] - came_s[0])


def test_odometry_is_true(flown: Flown) -> None:
    poses, truth = flown.poses, TrueFlight(SAMPLE)
    t_s = np.float64(truth.begin_s - flown.begins_unix_s) + poses.stamp_us * np.float64(1e-6)
    error_m = np.linalg.norm(poses.place - truth.place(t_s), axis=1)
    true_turn = truth.rotations(t_s)
    cosine = (np.einsum("nij,nij->n", poses.rotations, true_turn) - 1) / 2
    error_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    velocity = np.einsum("nij,nj->ni", poses.rotations, poses.velocity_body)
    error_m_s = np.linalg.norm(velocity - truth.velocity(t_s), axis=1)
    for name, error in (("m", error_m), ("deg", error_deg), ("m/s", error_m_s)):
        print(f"error p50 {np.median(error):.2f} p95 {np.percentile(error, 95):.2f} {name}")
    assert np.percentile(error_m, 95) < 1.0
    assert np.percentile(error_deg, 95) < 4.0
    assert np.percentile(error_m_s, 95) < 1.0
    jumps_m = np.linalg.norm(np.diff(poses.place, axis=0), axis=1)
    same = (np.diff(poses.resets) == 0) & (np.diff(poses.stamp_us) < 250_000)
    assert jumps_m[same].max() < 1.5, "a jump without a reset"


def test_health_while_flying(flown: Flown) -> None:
    health = flown.health
    assert health["tracker"] == "tracking"
    assert health["quality"] >= 20
    assert health["feedback"]["sending"] and health["feedback"]["mode"] == "odometry"
    camera, autopilot = health["sources"]
    assert (camera["state"], autopilot["state"]) == ("running", "running")
    assert camera["rate_hz"] == pytest.approx(10, abs=1.0)
    assert {stage["name"]: stage["alive"] for stage in health["stages"]} == {
        "localisation": True, "depth": True, "results": True, "recorder": True,
    }  # fmt: skip
    assert "ArduPilot" in autopilot["detail"]
    for row in ("localisation", "camera", "autopilot", "event loop"):
        assert row in flown.table
    assert 'companion_source_state{source="camera",state="running"} 1.0' in flown.metrics


def test_the_pilot_is_told(flown: Flown) -> None:
    assert "Companion: vision position on" in flown.texts
    heartbeats = [each for each in flown.received if each.kind == "HEARTBEAT"]
    assert {each.message.type for each in heartbeats} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}
    assert {each.component for each in heartbeats} == {197}
    assert [each for each in flown.received if each.kind == "ONBOARD_COMPUTER_STATUS"]


def test_results_are_left(flown: Flown) -> None:
    names = {path.name for path in flown.folder.iterdir()}
    assert {"report.json", "report.html", "trajectory.tum", "cloud.ply", "flight.rrd"} <= names
    report = json.loads((flown.folder / "report.json").read_text())
    assert report["unit"] == "m"
    assert report["clock"]["method"] == "TIMESYNC"
    found = read_tum(flown.folder / "trajectory.tum")
    on_truth_clock = found.t_s - flown.begins_unix_s + TRUTH.t_s[0]
    result = score(Trajectory(on_truth_clock, found.centres, found.rotations), TRUTH)
    print(f"{result.n_common} frames, {result.ate_sim3_m:.2f} m, scale {result.scale_error:.1%}")
    assert result.n_common > 0.7 / flown.crowding * len(TRUTH.t_s)
    assert result.ate_sim3_m < 0.5
    assert result.scale_error < 0.03
    n_points = len(read_ply(flown.folder / "cloud.ply"))
    gave_way = [line for line in flown.lines if "dense map off" in line]
    print(f"{n_points} points", gave_way)
    # the dense map gives way to the pose where there is no processor for both, and says so
    assert n_points > 1000 or (flown.crowding > 2 and gave_way)


def test_only_one_daemon(flown: Flown) -> None:
    assert flown.second is not None
    assert "another companion runs here already" in refused(flown.second)


def test_it_ends_when_told(flown: Flown) -> None:
    assert flown.stop_s < flown.stop_allowed_s
    # a flight whose results took all the time that there is may say so at the same time
    assert "companion: stopped" in flown.lines[-2:]
    assert not [line for line in flown.lines if "Traceback" in line]
