"""One trial: a firmware in its simulator, a camera drawn live, the line between, and the daemon.

    with Trial(firmware, folder, Conditions(wind_m_s=3.0)) as trial:
        trial.start_daemon()
        trial.pilot.arm()

Everything that happened is left in the folder: truth.csv, ground.tlog (what a ground station
hears), cable.tlog (what passes between autopilot and companion), journal.txt, status.jsonl,
flights/, the firmware's own logs, and the camera's stamps.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import astuple, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from companion.errors import SourceError
from tests.firmware.child import child
from tests.firmware.ground import Ground
from tests.firmware.perfect_pose import PerfectPose
from tests.firmware.pilots import PILOTS, Pilot
from tests.firmware.sent_poses import POSES
from tests.firmware.simulators import ArduCopter, Ports, Px4, Simulator
from tests.support.autopilot.fake_wire import free_port
from tests.support.processes.daemon_process import PROGRAM, Daemon

CAMERA_HZ = 20.0
LATENCY_MS = 40.0
LENS_M = 0.1
"""Above the ground, while the vehicle stands on short legs."""
HEARD_S, READY_S, END_S = 30.0, 60.0, 20.0
PERFECT_S = 20.0
"""Until perfect poses count as sent: as long as a companion takes, and PX4 to find its heading."""
N_FEATURES = 720
"""Of each frame, instead of 1200: the firmware runs, and its camera is drawn, on the same cores."""
OWN_TO_EACH = "camera.", "mount.", "link."
RESTART_S = 2.0
"""RestartSec of the service."""


@dataclass(frozen=True)
class Conditions:
    """What differs from trial to trial."""

    seed: int = 1
    wind_m_s: float = 3.0
    pitch_deg: float = -45.0
    mount_roll_deg: float = 0.0
    """How the camera really sits, where that is not as it is said to."""
    lens_scale: float = 1.0
    """Focal length, really, over what the calibration says."""
    perfect: bool = False
    """The truth is sent, instead of the companion's poses."""
    look: str = "day"
    landmarks: str = ""
    """See `landmarks_of`."""
    has_gps: bool = False
    has_range: bool = True
    has_depth: bool = False
    pose_mode: str = "odometry"
    by_doctor: bool = False
    """Parameters of the pose are left as the firmware has them."""
    backend: str = "pymavlink"
    parameters: Mapping[str, float] = field(default_factory=dict)
    settings: tuple[str, ...] = ()
    camera_words: tuple[str, ...] = ()
    baud: int = 0
    """Of a serial line between autopilot and companion, ArduPilot's alone; 0: UDP."""
    nice: int = -5
    """Of everything that a real vehicle has a processor of its own for."""


class Trial:
    """See above. `with` powers the autopilot and the camera on; the daemon is started by hand."""

    def __init__(
        self, firmware: Path, folder: Path, conditions: Conditions, words: Sequence[str] = ()
    ) -> None:
        folder.mkdir(parents=True)
        self.folder, self.conditions, self.words = folder.resolve(), conditions, words
        kind = Px4 if firmware.name == "px4" else ArduCopter
        ground, cable = kind.FIXED if kind is Px4 else (free_port(), free_port())
        self._companion_port, self._camera_port = free_port(), free_port()
        self._second_port, self._video_port = free_port(), free_port()
        self._line = tuple(self.folder / f"{end}.tty" for end in ("autopilot", "companion"))
        line = f"{self._line[0]}:{conditions.baud}" if conditions.baud else ""
        ports = Ports(ground, line or cable, self._camera_port)
        self.firmware: Simulator = kind(firmware, self.folder, ports, self._parameters(kind))
        self.ground = Ground(ground, kind.home, self.folder / "ground.tlog")
        self.pilot: Pilot = PILOTS[kind.name](self.ground, self.firmware)
        self.daemon: Daemon | None = None
        self._perfect: PerfectPose | None = None
        self.status: dict[str, Any] = {}
        self.events: list[tuple[float, str]] = []
        self.began_s = time.time()
        self._over = threading.Event()
        self._open = ExitStack()

    def _parameters(self, kind: type[Simulator]) -> dict[str, float]:
        c = self.conditions
        own: dict[str, float]
        if kind is ArduCopter:
            own = {
                "SIM_WIND_SPD": c.wind_m_s, "SIM_WIND_DIR": 120, "SIM_WIND_TURB": 0.3,
                "FS_GCS_ENABLE": 0, "LOG_DISARMED": 1,
            }  # fmt: skip
            if c.has_range:
                own |= {"RNGFND1_TYPE": 100, "RNGFND1_MIN": 0.1, "RNGFND1_MAX": 40}
                own |= {"RNGFND1_ORIENT": 25}
        else:
            own = {
                "SIH_WIND_E": 0.87 * c.wind_m_s, "SIH_WIND_N": -0.5 * c.wind_m_s,
                "COM_RC_IN_MODE": 1, "NAV_DLL_ACT": 0, "COM_DL_LOSS_T": 60,
            }  # fmt: skip
        if not c.has_gps:
            own |= kind.without_gps
        if not c.by_doctor:
            own |= kind.on_our_pose
        return own | dict(c.parameters)

    def __enter__(self) -> Trial:
        with ExitStack() as entering:
            entering.callback(self._write)
            entering.enter_context(self.ground)
            self._cable = entering.enter_context(self._cable_between())
            self._camera = entering.enter_context(self._drawn_camera())
            entering.enter_context(self.firmware)
            entering.callback(self._stop_daemon)
            assert self.ground.until(lambda: self.ground.mode, HEARD_S), "no heartbeat"
            self.mark("power on")
            self.ground.ask_for_messages()
            assert self.ground.until(lambda: self.ground.true, HEARD_S), "no truth"
            self._open = entering.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        if error is not None:
            self.mark(f"failed: {error!r}")
        self._over.set()
        self._open.close()

    # -- its parts -------------------------------------------------------------------------------

    def start_daemon(self) -> None:
        """As its service does."""
        if self.conditions.perfect:
            self._perfect = self._open.enter_context(PerfectPose(
                self.ground, self._companion_port, self.firmware.home, CAMERA_HZ,
                "px4" if isinstance(self.firmware, Px4) else "ardupilot",
            ))  # fmt: skip
            time.sleep(PERFECT_S)
            self.status = {"feedback": {"sending": True}}
            return
        self.daemon = Daemon(self.folder, *self._settings(), program=(*PROGRAM,))
        self.daemon.__enter__()
        self.mark("companion started")
        threading.Thread(target=self._ask, args=(self.daemon,), daemon=True).start()

    @contextlib.contextmanager
    def second_companion(self) -> Iterator[Daemon]:
        """Another on the same vehicle, with a camera of its own."""
        settings = [word for word in self._settings() if not word.startswith(OWN_TO_EACH)]
        folder = self.folder / "second"
        folder.mkdir()
        daemon = Daemon(
            folder, *settings, f"link.url=udpin:127.0.0.1:{self._second_port}",
            "camera.source=pattern", program=(*PROGRAM,),
        )  # fmt: skip
        daemon.__enter__()
        try:
            yield daemon
        finally:
            with contextlib.redirect_stdout(io.StringIO()) as said:
                daemon.__exit__(None, None, None)
            (folder / "journal.txt").write_text(said.getvalue())

    def _settings(self) -> list[str]:
        home, c = self.firmware.home, self.conditions
        url = f"udpin:127.0.0.1:{self._companion_port}"
        if c.baud:
            url = f"serial:{self._line[1]}:{c.baud}"
        return [
            "camera.source=network", f"camera.url=tcp://127.0.0.1:{self._video_port}",
            f"camera.rate_hz={CAMERA_HZ:g}", f"expert.camera.stamp_offset_ms={-LATENCY_MS - 1:g}",
            f"camera.calibration={self.folder / 'lens.toml'}",
            "mount.known=true", f"mount.pitch_deg={c.pitch_deg:g}",
            f"link.url={url}", f"expert.link.backend={c.backend}",
            f"feedback.mode={c.pose_mode}", f"feedback.origin_latitude_deg={home.latitude_deg}",
            f"feedback.origin_longitude_deg={home.longitude_deg}",
            f"feedback.origin_altitude_m={home.altitude_m}",
            f"depth.enabled={str(c.has_depth).lower()}",
            f"expert.features.n_features={N_FEATURES}", *c.settings,
        ]  # fmt: skip

    def kill_daemon(self) -> None:
        """SIGKILL to all of its processes; started again as the service would be."""
        self._end_daemon()
        self.mark("companion killed")
        time.sleep(RESTART_S)
        self.start_daemon()

    def end_daemon(self) -> Path | None:
        """Stop the daemon as its service does; the map that the flight has left."""
        self._stop_daemon()
        self.mark("companion ended")
        return next(iter(sorted(self.folder.glob("flights/**/site.map"))), None)

    def run_companion(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Another of its commands, with the daemon's settings; kept in commands.txt."""
        settings = [word for each in self._settings() for word in ("--set", each)]
        done = subprocess.run(
            [sys.executable, *PROGRAM, *words, *settings], cwd=self.folder, check=False,
            capture_output=True, text=True, timeout=READY_S, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        with (self.folder / "commands.txt").open("a") as out:
            out.write(f"$ companion {' '.join(words)}\n{done.stdout}{done.stderr}")
            out.write(f"(status {done.returncode})\n")
        return done

    def tell_camera(self, order: str) -> None:
        """See `drawn_camera`; the truth, where that is sent, ceases for as long."""
        if self._perfect is not None:
            self._perfect.be_silent(float(order.split()[-1]))
        self._tell(self._camera, order)

    def tell_cable(self, order: str) -> None:
        """See `faulty_cable`."""
        self._tell(self._cable, order)

    # -- what is known ---------------------------------------------------------------------------

    def mark(self, text: str) -> None:
        """Note something that happened."""
        place = self.ground.place_m.round(2).tolist() if self.ground.true else ""
        self.events.append((time.time(), f"{text} {place}"))
        print(f"{time.time() - self.began_s:7.2f} {text} {place}", flush=True)

    @property
    def feedback(self) -> dict[str, Any]:
        """The daemon's word on its poses."""
        return dict(self.status.get("feedback") or {})

    @property
    def sending(self) -> bool:
        """Whether poses are sent."""
        return bool(self.feedback.get("sending"))

    def until(self, what: str, such: Callable[[], Any], timeout_s: float) -> float | None:
        """Wait; after how many seconds it was so, None if it did not become so."""
        began_s = time.time()
        while time.time() - began_s < timeout_s:
            if such():
                return round(time.time() - began_s, 2)
            time.sleep(0.05)
        self.mark(f"in vain: {what}")
        return None

    def said(self, text: str, since_s: float = 0.0) -> bool:
        """Whether the pilot has read it."""
        return any(text in each for each in self.ground.texts_since(since_s))

    def last_pose_s(self) -> float:
        """When the autopilot last passed one of our poses on to the ground, else was sent one."""
        return max(self.ground.came_s.get(f"COMPANION/{kind}", 0.0) for kind in POSES)

    # -- within ----------------------------------------------------------------------------------

    def _child(self, module: str, *words: object) -> contextlib.AbstractContextManager[Any]:
        return child(module, self.folder / f"{module}.txt", self.conditions.nice, *words)

    def _cable_between(self) -> contextlib.AbstractContextManager[Any]:
        log = self.folder / "cable.tlog"
        if self.conditions.baud:
            return self._child("serial_cable", self.conditions.baud, *self._line, log)
        companions = f"{self._companion_port},{self._second_port}"
        return self._child("faulty_cable", self.firmware.ports.companion, companions, log)

    def _drawn_camera(self) -> contextlib.AbstractContextManager[Any]:
        c = self.conditions
        origin = ",".join(str(each) for each in astuple(self.firmware.home))
        return self._child(
            "drawn_camera", "--state-port", self._camera_port, "--serve-port", self._video_port,
            "--rate-hz", CAMERA_HZ, "--latency-ms", LATENCY_MS, f"--pitch-deg={c.pitch_deg}",
            f"--roll-deg={c.mount_roll_deg}", "--lens-scale", c.lens_scale,
            "--above-m", LENS_M - self.firmware.stands_m,
            "--look", c.look, "--landmarks", c.landmarks, "--seed", c.seed, f"--origin={origin}",
            "--out", self.folder, *c.camera_words,
        )  # fmt: skip

    def _tell(self, process: subprocess.Popen[bytes], order: str) -> None:
        assert process.stdin is not None
        process.stdin.write(f"{order}\n".encode())
        process.stdin.flush()
        self.mark(order)

    def _ask(self, daemon: Daemon) -> None:
        with (self.folder / "status.jsonl").open("a") as log:
            while not self._over.wait(0.5) and daemon is self.daemon:
                try:
                    self.status = daemon.status()
                except SourceError:
                    self.status = {}
                log.write(json.dumps({"t_s": time.time(), **self.status}) + "\n")

    def _stop_daemon(self) -> None:
        if self.daemon is None:
            return
        with contextlib.suppress(Exception):
            self.daemon.stop(END_S)
        self._end_daemon()

    def _end_daemon(self) -> None:
        assert self.daemon is not None
        daemon, self.daemon, self.status = self.daemon, None, {}
        with contextlib.redirect_stdout(io.StringIO()):
            daemon.__exit__(None, None, None)
        with (self.folder / "journal.txt").open("a") as journal:
            for line in daemon.lines:
                at_s = (line.monotonic_ns - time.monotonic_ns()) * 1e-9 + time.time()
                journal.write(f"{at_s - self.began_s:8.2f} {line.text}\n")

    def _write(self) -> None:
        with (self.folder / "truth.csv").open("w", newline="") as out:
            rows = csv.writer(out)
            rows.writerow("t_s n e d vn ve vd qw qx qy qz".split())
            for each in self.ground.true:
                row = (each.t_s, *each.place_m, *each.velocity_m_s, *each.quaternion)
                rows.writerow([round(value, 6) for value in row])
        said = [(t_s, "event", text) for t_s, text in self.events]
        said += [(t_s, "pilot reads", text) for t_s, text in self.ground.texts]
        said += [(t_s, "mode", mode) for t_s, mode in self.ground.modes]
        with (self.folder / "events.txt").open("w") as out:
            for t_s, kind, text in sorted(said):
                out.write(f"{t_s - self.began_s:8.2f} {kind:12} {text}\n")
